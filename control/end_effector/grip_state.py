"""What a gripper does, and what it was asked for."""

from dataclasses import dataclass
from enum import Enum


class GripState(Enum):
    """What the gripper does; the value is for people."""

    OFF = "drives off"
    HOLDING = "holds its opening"
    MOVING = "on its way"
    OPEN = "open"
    CLOSED = "closed, nothing held"
    GRIPPED = "holds something"
    STOPPED = "stopped before its goal"
    RELEASED = "without current"
    FAILED = "its board does not work"


@dataclass(frozen=True, slots=True)
class Goal:
    """An opening [m] (None: as far as it goes, in the direction of `sign`), and the force [N] with which to get there."""

    opening_m: float | None
    force_N: float
    sign: int  # 1 opens, -1 closes
