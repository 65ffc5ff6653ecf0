"""Feetech STS servos (docs/feetech.md): how they are opened; `control.hardware.bought.smart_servo` drives them."""

from collections.abc import Sequence

from control.hardware.bought.smart_servo import line_s, open_servos
from control.hardware.opened import Opened
from control.hardware.words import OVER_CURRENT, OVER_TEMPERATURE, OWN_ENCODER, SUPPLY_LOW
from control.model.arm import Arm, Board
from firmware_iface.clock import Clock
from firmware_iface.feetech.servo import FeetechLine, FeetechServo

# Bits of the servo status, as the loop's faults: voltage, angle sensor, heat, current, overload.
FAULT_OF = (
    (0x01, SUPPLY_LOW), (0x02, OWN_ENCODER), (0x04, OVER_TEMPERATURE), (0x28, OVER_CURRENT)
)  # fmt: skip
# A cycle: a sync write of the goals (8 bytes and 3 a servo), a sync read of the states (8 and 1 a servo), its answers (37 each).
LINE_BYTES, SERVO_BYTES = 8 + 8, 3 + 1 + 37


def cycle_s(servos: int, baud: int, delays_s: Sequence[float] = ()) -> float:
    """How long the packets of one cycle take on a line: the shortest period of the loop."""
    return line_s(servos, baud, LINE_BYTES, SERVO_BYTES, questions=1, delays_s=delays_s)


def open_boards(arm: Arm, boards: Sequence[Board], clock: Clock, period_s: float, opened: Opened) -> None:
    """Open the lines of these servos and identify every one."""
    open_servos(arm, boards, clock, period_s, opened, FeetechLine, FeetechServo, cycle_s, FAULT_OF)
