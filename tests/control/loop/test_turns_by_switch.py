"""Absolute encoders of one turn behind a gear, on an arm of four joints on the rig: the home switch tells which turn it is."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from console.main import main
from control.model.arm import Arm, Home
from control.model.arm_checks import check_arm
from control.model.description import load_arm
from control.model.reader import Rejected
from control.safety.modes import Mode
from control.server.client import ArmFaulted
from procedures.on_boards import on_boards
from tests.cell import RIGHT, Cell, open_cell, restarted, scenario, with_drive

START = (0.1, -0.2, -0.1, 1.1)  # ten, three, two turns of the encoders and one before their switches

pytestmark = pytest.mark.usefixtures("nobody_below")


@cache
def arm_on_moteus() -> Arm:
    """Each encoder is on a motor, and knows its place within one turn of that."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "four.toml"
        assert main(["new", "--out", str(file), "--joints", "4", "--boards", "moteus", "--yes"]) == 0
        arm = load_arm(file)
    boards = tuple(replace(board, absolute=True, absolute_turns=1.0) for board in arm.boards)
    return replace(arm, boards=boards)


def with_switches_off(arm: Arm, share: float) -> Arm:
    """Its file has every home switch off by a share of the encoder's turn."""
    drives = []
    for drive in arm.drives:
        assert drive.home is not None
        off_rad = share * drive.encoder_turn_rad
        home = replace(drive.home, switch_rad=drive.home.switch_rad + off_rad, index_rad=drive.home.index_rad + off_rad)
        drives.append(replace(drive, home=home))
    return replace(arm, drives=tuple(drives))


def error_rad(cell: Cell) -> float:
    return float(np.abs(np.subtract(cell.runtime.parts.measurement.q_rad, cell.rig.joint_rad())).max())


def test_homing_finds_the_turn_and_the_encoder_the_place_in_it() -> None:
    arm = arm_on_moteus()
    period_s = 1.0 / arm.usual_rate_Hz
    believed = with_switches_off(arm, 0.25)
    assert all(drive.encoder_turn_rad < 0.15 < 3.0 < drive.joint_upper_rad - drive.joint_lower_rad for drive in arm.drives)
    with open_cell(scenario(START, homed=False), arm, believed=believed, period_s=period_s) as cell:
        cell.client.enable()
        assert not cell.runtime.monitor.is_homed
        assert error_rad(cell) > 0.1  # whole turns
        cell.client.home()
        cell.run(0.5)
        assert error_rad(cell) < 1e-3  # of the switch alone it would be a quarter of a turn
        cell.client.off()
        with restarted(cell, believed, period_s) as again:
            again.client.enable()
            assert not again.runtime.monitor.is_homed  # the board does not keep the turn


def test_a_switch_between_two_turns_stops_the_homing() -> None:
    arm = arm_on_moteus()
    believed = with_switches_off(arm, 0.45)
    with open_cell(scenario(START, homed=False), arm, believed=believed, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        with pytest.raises(ArmFaulted, match=r"joint 1: its home switch and its absolute encoder differ by"):
            cell.client.home()
        assert (cell.mode, cell.runtime.monitor.is_homed) == (Mode.FAULT, False)


def test_without_a_home_switch_a_range_of_several_turns_is_refused() -> None:
    arm = arm_on_moteus()
    check_arm(arm)
    assert math.isinf(arm.unique_rad(arm.drives[0]))
    first = replace(arm.drives[0], home=None)
    with pytest.raises(Rejected, match="the encoder knows its place within one turn"):
        check_arm(replace(arm, drives=(first, *arm.drives[1:])))


def test_a_smart_servo_reads_no_switch_that_could_tell_its_turn() -> None:
    servos = on_boards(RIGHT, "dynamixel")
    wide = with_drive(servos, 1, joint_lower_rad=-4.0, joint_upper_rad=4.0, home=Home(0.1, 0.1))
    with pytest.raises(Rejected, match="the encoder knows its place within one turn"):
        check_arm(wide)
