"""Arms that are built wrongly: what the boards then say and do."""

from __future__ import annotations

import pytest

from hil_mocks.devices.motor_inputs import Output
from hil_mocks.errors import ScenarioError
from hil_mocks.rig import SteppedRig
from hil_mocks.scenario import FaultTable, Scenario
from hil_mocks.wiring import LooseCoupling, as_built
from tests.cell import RIGHT

TURN_rad = 0.0628


def built(*faults: FaultTable) -> Scenario:
    return Scenario(fault=faults)


def driven(rig: SteppedRig, joint: int, volts: float, duration_s: float = 0.2) -> float:
    """How far a true joint turned under a voltage at its motor."""
    before = rig.joint_rad()[joint]
    rig.robot.plant.drive_voltage(joint, volts)
    rig.clock.wait_until_s(rig.clock.now_s() + duration_s)
    return rig.joint_rad()[joint] - before


def test_motors_that_are_swapped_turn_each_others_joints() -> None:
    arm = as_built(RIGHT, built(FaultTable("swapped_motors", "motor1", value=3.0)))
    assert [drive.motor_node for drive in arm.drives] == [3, 2, 1]


def test_motors_cannot_be_swapped_with_one_that_is_not_there() -> None:
    with pytest.raises(ScenarioError, match="no motor board with node 9"):
        as_built(RIGHT, built(FaultTable("swapped_motors", "motor1", value=9.0)))


def test_a_reversed_encoder_is_that_of_its_channel_alone() -> None:
    arm = as_built(RIGHT, built(FaultTable("reversed_encoder", "encoder", channel=1)))
    assert [drive.encoder_direction for drive in arm.drives] == [1, -1, 1]


def test_another_gear_turns_the_joint_by_less_for_the_same_counts() -> None:
    with SteppedRig(RIGHT, built(FaultTable("wrong_gear", "motor1", value=200.0))) as rig:
        driven(rig, 0, 3.0)
        counts = rig.robot.encoder_boards[0].count(0)
        # 200 motor turns of 2048 counts a joint turn; one count is 1.5e-5 rad.
        assert counts / (200.0 * 2048.0) * 6.283185307 == pytest.approx(rig.joint_rad()[0], abs=2e-5)


def test_an_encoder_that_its_board_does_not_know_counts_and_indexes_by_its_own_lines() -> None:
    with SteppedRig(RIGHT, built(FaultTable("wrong_encoder", "encoder", channel=0, value=4096.0))) as rig:
        board = rig.robot.encoder_boards[0]
        assert board.setup.counts_per_turn[0] == 2048
        driven(rig, 0, 3.0)
        assert board.count(0) / (100.0 * 4096.0) * 6.283185307 == pytest.approx(rig.joint_rad()[0], abs=2e-5)


def test_a_dead_motor_draws_no_current_and_a_jammed_joint_all_that_there_is() -> None:
    faults = (FaultTable("dead_motor", "motor1"), FaultTable("stuck_joint", "motor3"))
    with SteppedRig(RIGHT, built(*faults)) as rig:
        assert abs(driven(rig, 2, 0.6)) < 1e-5
        assert rig.robot.plant.current_A(2) == pytest.approx(0.6 / 0.299, rel=0.01)
        rig.robot.motor_boards[0].output = Output("voltage", 0.6)
        rig.clock.wait_until_s(rig.clock.now_s() + 0.1)
        assert abs(rig.robot.plant.current_A(0)) < 1e-9


def test_a_loose_coupling_loses_its_part_on_average_and_differs_from_turn_to_turn() -> None:
    coupling = LooseCoupling(0.05, TURN_rad, "test")
    readings = [coupling.reading_rad(0.0002 * step) for step in range(100_001)]
    # Some 1000 slips of on average 5 %, uniform from 0 to 10 %: 0.2 % of scatter.
    assert readings[-1] == pytest.approx(0.95 * 20.0, abs=0.004 * 20.0)
    steps = [b - a for a, b in zip(readings[:-1:500], readings[500::500], strict=False)]
    assert max(steps) - min(steps) > 0.002


def test_a_coupling_that_holds_reads_what_the_shaft_does() -> None:
    coupling = LooseCoupling(0.0, TURN_rad, "test")
    assert [coupling.reading_rad(0.1 * step) for step in range(50)] == [0.1 * step for step in range(50)]
