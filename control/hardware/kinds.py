"""How the boards of each kind are opened; what they offer is in `control.model.board_kinds`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

from control.hardware.bought import cia402, moteus, odrive, roboclaw, vesc
from control.hardware.bought.smart_servo import DYNAMIXEL, FEETECH
from control.hardware.opened import Opened
from control.model.arm import Arm, Board
from firmware_iface.clock import Clock

Opener = Callable[[Arm, Sequence[Board], Clock, float, Opened], None]
"""Opens all boards of one kind for a cycle of so many seconds; failures are collected, not raised."""

OPENERS: Final[Mapping[str, Opener]] = {
    "roboclaw": roboclaw.open_boards,
    "cia402": cia402.open_boards,
    "dynamixel": DYNAMIXEL.open_boards,
    "feetech": FEETECH.open_boards,
    "moteus": moteus.open_boards,
    "odrive": odrive.open_boards,
    "vesc": vesc.open_boards,
}


def open_boards(arm: Arm, clock: Clock, period_s: float, opened: Opened) -> None:
    """Open every [[board]] that drives a joint, or the gripper as one joint more."""
    arm = replace(arm, drives=arm.motors)
    named = {drive.board for drive in arm.drives}
    for kind, opener in OPENERS.items():
        boards = [board for board in arm.boards if board.kind == kind and board.name in named]
        if boards:
            opener(arm, boards, clock, period_s, opened)
