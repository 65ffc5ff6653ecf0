"""Joint limits: shifting angles inside by whole turns, and how far a pose is outside."""

import math
from collections.abc import Sequence
from math import pi
from operator import le

from control.errors import BadTarget, JointLimitViolated
from control.model.arm import Arm

_SLACK_RAD = 1e-9  # rounding errors of a pose on its limit are not a violation
_TURN = 2.0 * pi


class JointRange:
    """The ranges of an arm's joints; infinite if its file gives none."""

    __slots__ = ("_lower", "_name", "_upper", "limits")

    def __init__(self, arm: Arm) -> None:
        self._name = arm.name
        self.limits = arm.limits_rad
        self._lower = tuple(lower - _SLACK_RAD for lower, _ in self.limits)
        self._upper = tuple(upper + _SLACK_RAD for _, upper in self.limits)

    def excess_rad(self, q: Sequence[float]) -> float:
        """Return how far the worst joint is beyond its limit; negative inside."""
        return max(max(lower - a, a - upper) for a, (lower, upper) in zip(q, self.limits, strict=True))

    def is_inside(self, q: Sequence[float]) -> bool:
        """Whether every joint is within its limits."""
        return all(map(le, self._lower, q)) and all(map(le, q, self._upper))

    def check(self, q: Sequence[float], purpose: str) -> None:
        """Raise JointLimitViolated for the first joint outside; `purpose` is part of the message."""
        if self.is_inside(q):
            return
        for joint, (angle, (lower, upper)) in enumerate(zip(q, self.limits, strict=True), start=1):
            excess_rad = max(lower - angle, angle - upper)
            if excess_rad > _SLACK_RAD:
                message = (
                    f"arm {self._name}: joint {joint} would have to be at {angle:.4f} rad {purpose}: "
                    f"{excess_rad:.4f} rad beyond its limits, {lower} to {upper} rad"
                )
                raise JointLimitViolated(message, joint, excess_rad)

    def check_pose(self, q: Sequence[float]) -> None:
        """Raise BadTarget unless q is a finite angle for every joint."""
        if len(q) != len(self.limits) or not all(map(math.isfinite, q)):
            expected = f"expected {len(self.limits)} finite joint angles"
            raise BadTarget(f"arm {self._name}: {expected}, got {list(q)}")

    def inside_by_turns(self, q: Sequence[float]) -> tuple[float, ...]:
        """Return q shifted by whole turns, each angle as near as possible to the middle of its range."""
        return tuple(_centred(a, *limits) for a, limits in zip(q, self.limits, strict=True))

    def toward(self, q: Sequence[float], q_near: Sequence[float]) -> tuple[float, ...]:
        """Return q shifted by whole turns as near as possible to `q_near`, within the limits."""
        turned = turned_toward(q, q_near)
        return tuple(
            near if lower <= near <= upper else given
            for near, given, lower, upper in zip(turned, q, self._lower, self._upper, strict=True)
        )


def turned_toward(q: Sequence[float], q_near: Sequence[float]) -> tuple[float, ...]:
    """Return q shifted by whole turns, each angle as near as possible to that of `q_near`."""
    return tuple(
        [a if -pi < a - b <= pi else a - _whole_turns_rad(a - b) for a, b in zip(q, q_near, strict=True)]
    )


def _whole_turns_rad(difference: float) -> float:
    return _TURN * round(difference / _TURN) if math.isfinite(difference) else 0.0


def travel_rad(q: Sequence[float], q_from: Sequence[float]) -> float:
    """Return the largest joint travel between two poses."""
    return max([abs(a - b) for a, b in zip(q, q_from, strict=True)])


def _centred(angle: float, lower: float, upper: float) -> float:
    if lower <= angle <= upper and upper - lower < _TURN:
        return angle
    is_bounded = math.isfinite(lower) and math.isfinite(upper)
    middle = 0.5 * (lower + upper) if is_bounded else min(max(0.0, lower), upper)
    return angle - _TURN * round((angle - middle) / _TURN)
