"""What an arm reaches: its joints' ranges, and the errors for targets beyond them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from operator import le
from typing import Final

from control.errors import BadTarget, JointLimitViolated, NearSingular, OutOfReach
from control.model.arm import Arm, Vector3
from control.model.rules import POSITION


def checked_point(point: Sequence[float]) -> Vector3:
    """Return a point as three finite floats, or raise BadTarget."""
    if len(point) != 3 or not all(map(math.isfinite, point)):
        raise BadTarget(f"target: expected three finite coordinates in m, got {list(point)}")
    x, y, z = map(float, point)
    return x, y, z


def spelled(point: Sequence[float]) -> str:
    """Format a point for messages."""
    return f"({', '.join(f'{coordinate:.4f}' for coordinate in point)}) m"


def out_of_reach(name: str, point: Sequence[float], distance_m: float) -> OutOfReach:
    """Return the error for a point that lies `distance_m` outside."""
    off = f"{distance_m:.4f}" if distance_m >= 1e-4 else f"{distance_m:.1g}"
    remedy = POSITION.doubt(tuple(point)) or "; choose a point nearer to the arm"
    message = f"arm {name}: {spelled(point)} is out of reach by {off} m{remedy}"
    return OutOfReach(message, distance_m)


@dataclass(frozen=True, slots=True)
class Singularity:
    """Which part of the arm is singular in which pose, and the margin that is kept: an angle, a way, tip travel per radian."""

    which: str
    pose: str
    least: float
    unit: str


ELBOW_MARGIN_rad: Final = 0.05
STRETCHED: Final = Singularity("elbow", "stretched", ELBOW_MARGIN_rad, "rad")
FOLDED: Final = Singularity("elbow", "folded", ELBOW_MARGIN_rad, "rad")
ABOVE_AXIS_1: Final = Singularity("shoulder", "having the tip on axis 1", 0.01, "m")
LOSES_A_DIRECTION: Final = Singularity("arm", "losing a direction of motion", 0.005, "m/rad")  # for arms of any structure


def near_singular(name: str, point: Sequence[float], singularity: Singularity, margin: float) -> NearSingular:
    """Return the error for a point that needs a pose `margin` from singular."""
    which, least, unit = singularity.which, singularity.least, singularity.unit
    message = (
        f"arm {name}: {spelled(point)} is near-singular: the {which} would be {margin:.4f} {unit} from {singularity.pose} "
        f"(least {least} {unit}); choose a point further away from it"
    )
    return NearSingular(message, which, margin, least, unit)


def most_telling(failures: list[OutOfReach | NearSingular]) -> OutOfReach | NearSingular:
    """Take the most useful of several failures: near-singular, else the least distance out of reach.

    The others are dropped: a frame that holds what it raises is garbage that only the collector finds.
    """
    failures.sort(key=lambda one: (0, one.margin) if isinstance(one, NearSingular) else (1, one.distance_m))
    telling = failures[0]
    failures.clear()
    return telling


def jump(name: str, point: Sequence[float], travel_rad: float, limit_rad: float) -> NearSingular:
    """Return the error for a path step that would need a jump of the joints."""
    message = (
        f"arm {name}: to follow the path to {spelled(point)} a joint would jump by {travel_rad:.2f} rad (limit "
        f"{limit_rad} rad): the path passes a singular pose, or its points are too far apart"
    )
    return NearSingular(message, "arm", travel_rad, limit_rad, "rad")


def not_turned(name: str, target: str, joint_count: int, off_rad: float) -> OutOfReach:
    """Return the error for an orientation that the joints cannot give at a position."""
    message = (
        f"arm {name}: its {joint_count} joints cannot turn the tip to {target}: {off_rad:.4f} rad off at best; choose another"
        " orientation, or leave it out"
    )
    return OutOfReach(message, 0.0)


def beyond_range(name: str, target: str, joint: int, beyond_rad: float) -> OutOfReach:
    """Return the error for a target that only poses outside of the joints' ranges reach."""
    message = f"arm {name}: {target} needs joint {joint} {beyond_rad:.4f} rad beyond its range; choose another target"
    return OutOfReach(message, 0.0)


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

    def farthest_rad(self, q: Sequence[float]) -> tuple[float, int]:
        """Return how far the worst joint is beyond its limit, negative inside, and its number (1-based)."""
        joints = zip(q, self.limits, strict=True)
        return max((max(lower - a, a - upper), joint) for joint, (a, (lower, upper)) in enumerate(joints, start=1))

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
    return tuple([a if -pi < a - b <= pi else a - _whole_turns_rad(a - b) for a, b in zip(q, q_near, strict=True)])


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
