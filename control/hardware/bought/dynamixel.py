"""Dynamixel X servos (docs/dynamixel.md): how they are opened; `control.hardware.bought.smart_servo` drives them."""

from collections.abc import Sequence

from control.hardware.bought.serial_line import TURN_AROUND_S
from control.hardware.bought.smart_servo import open_servos
from control.hardware.opened import Opened
from control.hardware.words import OVER_CURRENT, OVER_TEMPERATURE, OWN_ENCODER, SUPPLY_LOW
from control.model.arm import Arm, Board
from firmware_iface.clock import Clock
from firmware_iface.dynamixel.servo import DynamixelLine, DynamixelServo

# Bits of the hardware error status (e-Manual), as the loop's faults.
FAULT_OF = ((0x01, SUPPLY_LOW), (0x04, OVER_TEMPERATURE), (0x08, OWN_ENCODER), (0x30, OVER_CURRENT))
# A cycle: a sync write (14 bytes and 5 a servo), one state (14 + 46), and for each servo its values (14 + 32).
STATE_BYTES, VALUE_BYTES, GOAL_BYTES, SYNC_BYTES = 60, 46, 5, 14


def cycle_s(servos: int, baud: int) -> float:
    """How long the questions of one cycle take on a line: the shortest period of the loop."""
    line_bytes = SYNC_BYTES + STATE_BYTES + servos * (GOAL_BYTES + VALUE_BYTES)
    return line_bytes * 10 / baud + (servos + 1) * TURN_AROUND_S


def open_boards(arm: Arm, boards: Sequence[Board], clock: Clock, period_s: float, opened: Opened) -> None:
    """Open the lines of these servos and identify every one."""
    open_servos(arm, boards, clock, period_s, opened, DynamixelLine, DynamixelServo, cycle_s, FAULT_OF)
