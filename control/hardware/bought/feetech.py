"""Feetech STS servos (docs/feetech.md): how they are opened; `control.hardware.bought.smart_servo` drives them."""

from collections.abc import Sequence

from control.hardware.bought.serial_line import TURN_AROUND_S
from control.hardware.bought.smart_servo import open_servos
from control.hardware.opened import Opened
from control.hardware.words import OVER_CURRENT, OVER_TEMPERATURE, OWN_ENCODER, SUPPLY_LOW
from control.model.arm import Arm, Board
from firmware_iface.clock import Clock
from firmware_iface.feetech.servo import FeetechLine, FeetechServo

# Bits of the servo status, as the loop's faults: voltage, angle sensor, heat, current, overload.
FAULT_OF = (
    (0x01, SUPPLY_LOW), (0x02, OWN_ENCODER), (0x04, OVER_TEMPERATURE), (0x28, OVER_CURRENT)
)  # fmt: skip
# A cycle: a sync write (8 bytes and 3 a servo), and for each servo its state (8 + 37); one of them is asked twice.
STATE_BYTES, GOAL_BYTES, SYNC_BYTES = 45, 3, 8


def cycle_s(servos: int, baud: int) -> float:
    """How long the questions of one cycle take on a line: the shortest period of the loop."""
    line_bytes = SYNC_BYTES + servos * GOAL_BYTES + (servos + 1) * STATE_BYTES
    return line_bytes * 10 / baud + (servos + 1) * TURN_AROUND_S


def open_boards(arm: Arm, boards: Sequence[Board], clock: Clock, period_s: float, opened: Opened) -> None:
    """Open the lines of these servos and identify every one."""
    open_servos(arm, boards, clock, period_s, opened, FeetechLine, FeetechServo, cycle_s, FAULT_OF)
