"""Error messages for targets that an arm cannot reach."""

import math
from collections.abc import Sequence

from control.errors import BadTarget, NearSingular, OutOfReach
from control.model.arm import Vector3
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


def near_singular(
    name: str, point: Sequence[float], which: str, margin: float, limit: float, unit: str, pose: str
) -> NearSingular:
    """Return the error for a point that needs a pose `margin` from singular."""
    message = (
        f"arm {name}: {spelled(point)} is near-singular: the {which} would be {margin:.4f} {unit} from {pose} "
        f"(least {limit} {unit}); choose a point further away from it"
    )
    return NearSingular(message, which, margin, limit, unit)


def most_telling(failures: list[OutOfReach | NearSingular]) -> OutOfReach | NearSingular:
    """Take the most useful of several failures: near-singular, else the least distance out of reach.

    The others are dropped: a frame that holds what it raises is garbage that only the collector finds.
    """
    failures.sort(key=lambda one: (0, one.margin) if isinstance(one, NearSingular) else (1, one.distance_m))
    found = failures[0]
    failures.clear()
    return found


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


def beyond_range(name: str, target: str, beyond_rad: float) -> OutOfReach:
    """Return the error for a target that only poses outside of the joints' ranges reach."""
    message = (
        f"arm {name}: {target} needs a joint {beyond_rad:.4f} rad beyond its range; choose another target"
    )
    return OutOfReach(message, 0.0)
