"""The reference arm on each kind of board, and the period at which its loop runs."""

from dataclasses import dataclass, replace
from typing import Literal

from control.model.arm import Arm
from procedures.on_boards import on_boards
from tests.cell import RIGHT, with_drives


@dataclass(frozen=True, slots=True)
class OnBoards:
    """An arm, the loop's period, and what the mock calls the boards of joints 1 and 3."""

    arm: Arm
    period_s: float
    first: str
    last: str
    firmware: Literal["python", "c"] = "python"  # of the mock's reference boards


def _on(kind: str, first: str, last: str) -> OnBoards:
    arm = on_boards(RIGHT, kind)
    return OnBoards(arm, 1.0 / arm.usual_rate_Hz, first, last)


def beside_reference_boards() -> Arm:
    """Joints 1 and 2 on a RoboClaw, joint 3 on reference boards."""
    claws = on_boards(RIGHT, "roboclaw")
    drives = (*claws.drives[:2], RIGHT.drives[2])
    return replace(claws, boards=claws.boards[:1], drives=drives, encoder_boards=RIGHT.encoder_boards, can=RIGHT.can)


def _in_mode(kind: str, mode: str, first: str, last: str) -> OnBoards:
    on_them = _on(kind, first, last)
    arm = with_drives(on_them.arm, pid=replace(on_them.arm.drives[0].pid, mode=mode))
    return replace(on_them, arm=arm)


ON_BOARDS = {
    "reference": OnBoards(RIGHT, 0.002, "motor1", "motor3"),
    "reference, firmware in C": OnBoards(RIGHT, 0.002, "motor1", "motor3", "c"),
    "cia402": _on("cia402", "drive1", "drive3"),
    "cia402 torque": _in_mode("cia402", "current", "drive1", "drive3"),
    "dynamixel": _on("dynamixel", "servo1", "servo3"),
    "feetech": _on("feetech", "feetech1", "feetech3"),
    "beside reference boards": OnBoards(beside_reference_boards(), 0.01, "roboclaw1", "motor3"),
    "mixed": _on("mixed", "roboclaw1", "servo1"),
    "moteus": _on("moteus", "moteus1", "moteus3"),
    "odrive": _on("odrive", "odrive1", "odrive3"),
    "odrive torque": _in_mode("odrive", "current", "odrive1", "odrive3"),
    "roboclaw": _on("roboclaw", "roboclaw1", "roboclaw2"),
    "vesc": _on("vesc", "vesc1", "vesc3"),
    "vesc current": _in_mode("vesc", "current", "vesc1", "vesc3"),
}
