"""Joints whose encoders are absolute within a turn: none is moved by an angle that may be a turn off, or beyond stored limits."""

from __future__ import annotations

import math
import re
import struct
from dataclasses import replace

import pytest

from control.hardware.connect import connect
from control.model.arm import Arm
from control.safety.modes import Mode
from firmware_iface.errors import ConnectionFailed
from hil_mocks.rig import SteppedRig
from procedures.on_boards import on_boards
from tests.cell import RIGHT, Cell, open_cell, scenario, wired_to, with_drive

PERIOD_S = 0.01


def a_turn_on(arm: Arm, joint_rad: float = 2.0 * math.pi) -> Arm:
    """The arm whose first encoder reads more than its file says."""
    drive = arm.drives[0]
    counts = joint_rad * drive.encoder_counts_per_rev * drive.gear_ratio / (2.0 * math.pi)
    return with_drive(arm, 1, zero_count=drive.zero_count + round(counts))


def refusals(cell: Cell) -> list[str]:
    """What `enable` and `home` are answered, and what `status` warns of."""
    warnings = cell.channel.request({"do": "status"})["warnings"]
    return [cell.refusal(do="enable"), cell.refusal(do="home"), *warnings]


@pytest.mark.parametrize("kind", ["dynamixel", "odrive"])
def test_a_joint_that_reads_a_turn_too_much_is_neither_enabled_nor_homed(kind: str) -> None:
    arm = on_boards(RIGHT, kind)
    with open_cell(scenario(), a_turn_on(arm), believed=arm, period_s=PERIOD_S) as cell:
        before_rad = cell.rig.joint_rad()
        cell.run(0.1)
        refused = refusals(cell)
        assert re.match(r"joint 1 reads 6.38\d rad, 3.78\d rad outside its limits \(-2.600 to 2.600 rad\)", refused[0])
        assert all("its encoder may be a turn off (6.283 rad)" in one for one in refused[:3])
        cell.run(0.5)
        assert (cell.mode, cell.runtime.monitor.is_homed) == (Mode.OFF, False)
        assert cell.rig.joint_rad()[0] == pytest.approx(before_rad[0], abs=0.01)  # it is free, and coasts


def test_a_joint_that_stands_a_little_outside_of_its_range_is_enabled() -> None:
    arm = on_boards(RIGHT, "dynamixel")
    narrower = with_drive(arm, 1, joint_lower_rad=0.13)  # it stands at 0.1
    with open_cell(scenario(), arm, believed=narrower, period_s=PERIOD_S) as cell:
        cell.client.enable()
        assert (cell.mode, cell.runtime.monitor.is_homed) == (Mode.HOLDING, True)


def test_an_encoder_behind_a_gear_is_a_turn_off_by_a_part_of_the_joints_turn() -> None:
    odrives = on_boards(with_drive(RIGHT, 1, joint_lower_rad=-0.5, joint_upper_rad=0.5), "odrive")
    boards = (replace(odrives.boards[0], absolute_turns=20.0), *odrives.boards[1:])  # of 100: 1.257 rad
    arm = replace(odrives, boards=boards)
    with open_cell(scenario(), a_turn_on(arm, 0.4 * math.pi), believed=arm, period_s=PERIOD_S) as cell:
        cell.run(0.1)
        assert "0.858 rad outside its limits" in cell.refusal(do="enable")


@pytest.mark.parametrize(
    ("kind", "at", "limits", "said"),
    [
        ("feetech", 9, struct.pack("<HH", 1500, 2600), r"353 to 3743, within the position limits .* got 1500 to 2600"),
        ("dynamixel", 48, struct.pack("<ii", 2600, 1500), r"353 to 3743, within the position limits .* -0.841 to 0.847"),
        ("dynamixel", 20, struct.pack("<i", 700), r"353 to 3743, within the turn that it knows .* got 700 to 4795"),
    ],
)
def test_what_is_stored_in_a_servo_is_compared_with_the_range_when_it_is_connected(
    kind: str, at: int, limits: bytes, said: str
) -> None:
    arm = on_boards(RIGHT, kind)
    with SteppedRig(arm, scenario()) as rig:
        table = rig.robot.bought.lines[0].servos[1].table
        table[at : at + len(limits)] = limits
        with pytest.raises(ConnectionFailed, match=said):
            connect(wired_to(arm, rig), rig.clock, PERIOD_S)
