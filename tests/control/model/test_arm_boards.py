"""What arm.toml may say of bought boards: each kind's row of control.model.board_kinds is kept."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from control.errors import ArmError
from control.model.arm import Arm, Home
from control.model.description import load_arm, save_arm
from procedures.mock.on_boards import on_boards
from tests.cell import RIGHT, with_drive


def _absolute(arm: Arm) -> Arm:
    return replace(arm, boards=tuple(replace(board, absolute=True) for board in arm.boards))


def _homed_by_a_switch(arm: Arm) -> Arm:
    return with_drive(arm, 1, home=Home(switch_rad=0.1, index_rad=0.2))


def _counted_elsewhere(arm: Arm) -> Arm:
    return with_drive(
        replace(arm, encoder_boards=RIGHT.encoder_boards), 1, encoder_board=0, encoder_channel=0
    )


def _beside_a_reference_board(arm: Arm) -> Arm:
    return replace(arm, drives=(*arm.drives[:2], RIGHT.drives[2]), encoder_boards=RIGHT.encoder_boards)


def _beside_a_cia402_drive(arm: Arm) -> Arm:
    other = on_boards(RIGHT, "cia402")
    return replace(arm, boards=(*arm.boards[:2], other.boards[2]), drives=(*arm.drives[:2], other.drives[2]))


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        (
            "vesc",
            _absolute,
            r"absolute of \[\[board\]\] 1: expected true only for moteus, odrive, got true for a vesc",
        ),
        (
            "odrive",
            _homed_by_a_switch,
            r"home of \[\[drive\]\] 1: expected none: its board reads no home switch",
        ),
        (
            "odrive",
            _counted_elsewhere,
            r"encoder_board of \[\[drive\]\] 1: expected none: such a drive closes its own loop",
        ),
        (
            "cia402",
            _counted_elsewhere,
            r"encoder_board of \[\[drive\]\] 1: expected none: such a drive closes its own loop",
        ),
        ("odrive", _beside_a_cia402_drive, "boards of one kind on .can. of cia402 and odrive"),
        ("odrive", _beside_a_reference_board, "no reference motor board beside odrive"),
    ],
)
def test_what_a_kind_of_board_cannot_do_is_refused_with_the_place(
    kind: str, change: Callable[[Arm], Arm], said: str, tmp_path: Path
) -> None:
    save_arm(change(on_boards(RIGHT, kind)), tmp_path / "arm.toml")
    with pytest.raises(ArmError, match=said):
        load_arm(tmp_path / "arm.toml")


def test_an_odrive_in_current_mode_may_leave_counting_and_homing_to_an_encoder_board(tmp_path: Path) -> None:
    arm = _counted_elsewhere(on_boards(RIGHT, "odrive"))
    by_torque = with_drive(arm, 1, pid=replace(arm.drives[0].pid, mode="current"), home=RIGHT.drives[0].home)
    save_arm(by_torque, tmp_path / "arm.toml")
    assert load_arm(tmp_path / "arm.toml").can_home
