"""Dynamixel X servos (docs/dynamixel.md): how they are opened; `control.hardware.bought.smart_servo` drives them."""

from collections.abc import Sequence

from control.hardware.bought.smart_servo import line_s, open_servos
from control.hardware.opened import Opened
from control.hardware.words import OVER_CURRENT, OVER_TEMPERATURE, OWN_ENCODER, SUPPLY_LOW
from control.model.arm import Arm, Board
from firmware_iface.clock import Clock
from firmware_iface.dynamixel.servo import DynamixelLine, DynamixelServo

# Bits of the hardware error status (e-Manual), as the loop's faults.
FAULT_OF = ((0x01, SUPPLY_LOW), (0x04, OVER_TEMPERATURE), (0x08, OWN_ENCODER), (0x30, OVER_CURRENT))
# A cycle: a sync write of the goals (14 bytes and 5 a servo), one servo's state (14 + 46), a sync read of the values (14 and 1 a
# servo) and its answers (32 each).
LINE_BYTES, SERVO_BYTES = 14 + 60 + 14, 5 + 1 + 32


def cycle_s(servos: int, baud: int, delays_s: Sequence[float] = ()) -> float:
    """How long the packets of one cycle take on a line: the shortest period of the loop."""
    return line_s(servos, baud, LINE_BYTES, SERVO_BYTES, questions=2, delays_s=delays_s)


def open_boards(arm: Arm, boards: Sequence[Board], clock: Clock, period_s: float, opened: Opened) -> None:
    """Open the lines of these servos and identify every one."""
    open_servos(arm, boards, clock, period_s, opened, DynamixelLine, DynamixelServo, cycle_s, FAULT_OF)
