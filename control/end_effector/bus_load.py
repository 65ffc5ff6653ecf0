"""The load of the CAN bus: what gripper and pins add to it, and what several arms on one bus make of it."""

import math

from control.end_effector import gripper, outputs
from control.model.arm import Arm
from control.model.cell import Cell

GRIPPER_FRAMES = 4  # a COMMAND, a question for the count, and their answers
FRAME_bits = 135  # 8 bytes with worst stuffing (docs/motor_board.md)
USUAL_LOAD = 0.7  # of a CAN bus, at most; `doctor` expects it
RATE_STEP_Hz = 50.0
PIN_FRAMES = 2  # a DIGITAL_COMMAND and its reply, for each board with pins


def end_frames_Hz(arm: Arm) -> float:
    """Frames a second, whatever the rate of the loop."""
    is_on_node = arm.gripper is not None and not arm.gripper.board
    grips = GRIPPER_FRAMES / gripper.PERIOD_s if is_on_node else 0.0
    return grips + PIN_FRAMES * len({pin.board for pin in arm.digital}) / outputs.PERIOD_s


def bus_load(cell: Cell, rate_Hz: float) -> float:
    """Worst-case share of the busiest CAN bus, for commands and replies of all motor boards that are on it."""
    loads: dict[tuple[str, str], float] = {}
    for placed in cell.arms:
        arm = placed.arm
        if arm.can is not None:
            bus = (arm.can.interface, arm.can.channel)
            frames_Hz = 2 * sum(not drive.board for drive in arm.drives) * rate_Hz + end_frames_Hz(arm)
            loads[bus] = loads.get(bus, 0.0) + frames_Hz * FRAME_bits / arm.can.bitrate
    return max(loads.values(), default=0.0)


def usual_rate_Hz(cell: Cell) -> float:
    """The loop's rate if none is asked for: what the slowest boards of all arms carry, and a bus that arms share."""
    rate_Hz = min(placed.arm.usual_rate_Hz for placed in cell.arms)
    while len(cell.arms) > 1 and bus_load(cell, rate_Hz) > USUAL_LOAD and rate_Hz > RATE_STEP_Hz:
        rate_Hz = max(RATE_STEP_Hz, RATE_STEP_Hz * math.ceil(rate_Hz / RATE_STEP_Hz - 1.0))
    return rate_Hz
