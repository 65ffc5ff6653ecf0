"""An arm on bought boards is a whole arm.toml, and runs on the mock at its own rate."""

from pathlib import Path

import pytest

from control.errors import ArmError
from control.model.board_kinds import KINDS
from control.model.description import load_arm, save_arm
from control.safety.modes import Mode
from procedures.on_boards import NAMES, on_boards
from tests.cell import RIGHT, holding_cell, scenario

NEAR_HOME = (-0.1, 0.0, 0.6)  # just below the switches: a short search


@pytest.mark.parametrize("kind", NAMES)
def test_an_arm_on_boards_of_any_kind_is_written_and_read_back(kind: str, tmp_path: Path) -> None:
    arm = on_boards(RIGHT, kind)
    save_arm(arm, tmp_path / "arm.toml")
    read = load_arm(tmp_path / "arm.toml")
    assert (read.boards, read.drives) == (arm.boards, arm.drives)
    assert read.can_home
    assert read.usual_rate_Hz == min(KINDS[board.kind].usual_rate_Hz for board in arm.boards)


def test_an_unknown_kind_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ArmError, match=r"roboclaw, .*mixed, got plc"):
        on_boards(RIGHT, "plc")


def test_where_a_switch_is_the_zero_its_edge_is_approached_so_slowly_that_it_is_true_to_a_milliradian() -> None:
    arm = on_boards(RIGHT, "roboclaw")
    assert [drive.home.speed_rad_s for drive in arm.drives if drive.home] == [0.1, 0.1, 0.1]
    with holding_cell(scenario(NEAR_HOME, homed=False), arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        assert cell.client.home()
        assert cell.client.status()["q_rad"] == pytest.approx(cell.rig.joint_rad(), abs=1e-3)


def test_on_mixed_boards_only_joints_without_an_absolute_encoder_home() -> None:
    arm = on_boards(RIGHT, "mixed")
    with holding_cell(scenario(NEAR_HOME, homed=False), arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        assert cell.runtime.parts.servo.modes[0] is not cell.runtime.parts.servo.modes[2]
        before_rad = cell.rig.joint_rad()[2]
        assert cell.client.home()
        assert cell.rig.joint_rad()[2] == pytest.approx(before_rad, abs=5e-3)
        assert cell.mode is Mode.HOLDING
        assert cell.client.status()["q_rad"] == pytest.approx(cell.rig.joint_rad(), abs=5e-3)
