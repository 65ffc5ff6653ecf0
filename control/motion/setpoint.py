"""The set-point of all joints; the protocol of a motion, which gives one for every time; and the look at its poses ahead.

Motions are checked before they begin, but only at knots. What lies between them is seen by `Lookout`, while the arm can still
stop on the motion's own path.
"""

from collections.abc import Sequence
from copy import copy
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


AHEAD_s = 0.25  # of the motion's time: a stop along the path takes 0.15 from full pace, and more where joints are at their limits
STEP_s = 0.01  # between poses; at 10 m/s^2 the tip departs from their chord by 0.1 mm
_AT_ONCE = 2  # poses a cycle, so that the way to AHEAD_s is made up in 30 ms, before the arm has got up speed


class Lookout:
    """The poses of one motion, each given once, in the order of time."""

    __slots__ = ("_motion", "_seen_s")

    def __init__(self, motion: Motion) -> None:
        self._motion = copy(motion)  # a path continues from the pose that it gave last, so the arm's own is left alone
        self._seen_s = 0.0

    def poses(self, time_s: float) -> list[SetPoint]:
        """The next poses up to AHEAD_s after `time_s` of the motion; empty once all were given. Raises what the motion does."""
        end_s = min(time_s + AHEAD_s, self._motion.duration_s)
        set_points: list[SetPoint] = []
        while self._seen_s < end_s and len(set_points) < _AT_ONCE:
            self._seen_s = min(self._seen_s + STEP_s, self._motion.duration_s)
            set_points.append(self._motion.at(self._seen_s))
        return set_points
