"""The gripper's motor on a bought board: a spare channel of a joint's RoboClaw, a VESC or a smart servo of its own."""

from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import pytest

from control.model import arm_checks
from control.model.arm import Arm, Board
from control.model.arm_checks import check_arm
from control.model.board_kinds import KINDS
from control.model.description import load_arm
from control.model.reader import Rejected
from hil_mocks.scenario import GripperTable
from procedures.on_boards import on_boards
from tests.cell import RIGHT, Cell, holding_cell, scenario
from tests.control.loop.test_gripper import GRIPPER, END_m
from tests.thirds import third_of

ON_CLAW = replace(GRIPPER, motor_node=-1, board="roboclaw2", board_channel=2, motor_direction=-1)
ON_VESC = replace(GRIPPER, motor_node=-1, board="hand", encoder_counts_per_rev=18_000)
CLAWS = on_boards(RIGHT, "roboclaw")
VESCS = on_boards(RIGHT, "vesc")
VESCS = replace(VESCS, boards=(*VESCS.boards, Board("hand", "vesc", 9)))
ON_SERVO = replace(
    GRIPPER,
    motor_node=-1,
    board="hand",
    encoder_counts_per_rev=4096,
    travel_per_turn_m=0.2,
    torque_constant_Nm_A=1.0,
    resistance_ohm=4.0,
    supply_V=12.0,
    current_limit_A=1.5,
    rotor_inertia_kg_m2=1e-3,
)


def on_servos(kind: str) -> Arm:
    arm = on_boards(RIGHT, kind)
    hand = replace(arm.boards[0], name="hand", address=9)
    return replace(arm, boards=(*arm.boards, hand), gripper=ON_SERVO)


def on_can(kind: str) -> Arm:
    arm = on_boards(RIGHT, kind)
    gripper = replace(ON_VESC, encoder_counts_per_rev=4096)
    return replace(arm, boards=(*arm.boards, Board("hand", kind, 9)), gripper=gripper)


ARMS = {
    "roboclaw": replace(CLAWS, gripper=ON_CLAW),
    "vesc": replace(VESCS, gripper=ON_VESC),
    "dynamixel": on_servos("dynamixel"),
    "feetech": on_servos("feetech"),
    "cia402": on_can("cia402"),
    "moteus": on_can("moteus"),
    "odrive": on_can("odrive"),
}


def holding(arm: Arm) -> AbstractContextManager[Cell]:
    return holding_cell(scenario(None, gripper=GripperTable(start=0.9)), arm, period_s=1.0 / arm.usual_rate_Hz)


def state(cell: Cell) -> str:
    return str(cell.client.status()["gripper"]["state"])


@pytest.mark.parametrize("kind", third_of(ARMS))
def test_it_goes_where_it_is_told_and_holds_with_the_force(kind: str) -> None:
    with holding(ARMS[kind]) as cell:
        before_m = cell.rig.gripper()[0]
        cell.run(0.1)
        assert (state(cell), cell.rig.gripper()[0]) == ("HOLDING", before_m)
        assert cell.client.grip("open")["state"] == "OPEN"
        assert cell.client.grip("move", 0.06)["opening_m"] == pytest.approx(0.06, abs=0.3e-3)
        assert cell.rig.gripper()[0] == pytest.approx(0.06, abs=0.3e-3 + END_m)
        cell.rig.set_object(0.055)
        assert cell.client.grip("close", force_N=20.0)["state"] == "GRIPPED"
        cell.run(0.3)
        assert cell.rig.gripper()[1] == pytest.approx(20.0, abs=2.0)
        assert cell.faults == []


def test_a_board_of_its_own_that_fails_stops_the_arm_and_a_restart_loses_its_zero() -> None:
    with holding(ARMS["vesc"]) as cell:
        cell.client.grip("open")
        cell.inject("board_reset", "vesc9")
        cell.until_fault(0.3)
        cell.until(lambda: cell.client.status()["gripper"]["opening_m"] is None, 2.0)
        cell.client.ask("acknowledge")
        cell.client.enable()
        assert "gripper open" in cell.refusal(do="gripper", action="move", opening_m=0.03)
        cell.inject("silent", "vesc9")
        cell.until_fault(0.3)
        assert ("gripper_silent", "gripper") in cell.faults


def test_the_emergency_stop_takes_the_gripper_along_until_it_is_acknowledged() -> None:
    with holding(ARMS["roboclaw"]) as cell:
        cell.client.ask("gripper", action="open")
        cell.run(0.1)
        cell.runtime.parts.hardware.emergency_stop()
        cell.until_fault(0.1)
        at_m = cell.rig.gripper()[0]
        cell.run(0.2)
        assert cell.rig.gripper()[0] == pytest.approx(at_m, abs=1e-3)
        cell.client.ask("acknowledge")
        cell.client.enable()
        cell.run(0.1)
        assert state(cell) == "HOLDING"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"board": "claw"}, r"roboclaw1, roboclaw2.*claw"),
        ({"board_channel": 1}, r"that of joint 3"),
        ({"board_channel": 3}, r"1 to 2"),
        ({"motor_node": 4}, r"motor_node or board.*both"),
        ({"board": ""}, r"reference motor board"),
        ({"on_fault": "release"}, r"cannot open"),
    ],
)
def test_what_a_board_cannot_do_for_it_is_said_when_the_file_is_read(change: dict[str, Any], says: str) -> None:
    with pytest.raises(Rejected, match=says):
        check_arm(replace(CLAWS, gripper=replace(ON_CLAW, **change)))


def test_boards_that_cannot_keep_a_force_are_refused_by_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    weak = {name: replace(kind, limits_force=False) for name, kind in KINDS.items()}
    monkeypatch.setattr(arm_checks, "KINDS", weak)
    with pytest.raises(Rejected, match=r"\(roboclaw, vesc\).*a dynamixel"):
        check_arm(ARMS["dynamixel"])


def test_light_fingers_rest_at_the_end_of_their_travel() -> None:
    arm = load_arm("so101")
    assert arm.gripper is not None
    with holding_cell(scenario(None), arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        assert cell.client.grip("open")["state"] == "OPEN"
        assert cell.rig.gripper()[0] == pytest.approx(arm.gripper.travel_m, abs=1e-3)
