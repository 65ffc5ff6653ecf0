"""The set-point of all joints, and the protocol of a motion, which gives one for every time."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

Vector = tuple[float, float, float]


class SetPoint(NamedTuple):
    """Joint angles, speeds and accelerations, one float per joint; a NamedTuple, created every cycle."""

    q_rad: tuple[float, ...]
    speed_rad_s: tuple[float, ...]
    acceleration_rad_s2: tuple[float, ...]


class JointState(Protocol):
    """Angles and speeds of the joints, measured or set: what the loop compares and controls."""

    @property
    def q_rad(self) -> Sequence[float]: ...
    @property
    def speed_rad_s(self) -> Sequence[float]: ...


class Motion(Protocol):
    """A motion of `duration_s`; `at` clamps times outside of 0 .. duration_s."""

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        ...

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start; at the end at rest unless the motion says otherwise."""
        ...


def at_rest(q_rad: tuple[float, ...]) -> SetPoint:
    """Set-point at rest at `q_rad`."""
    zeros = (0.0,) * len(q_rad)
    return SetPoint(tuple(q_rad), zeros, zeros)
