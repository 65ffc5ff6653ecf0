"""Where the work stands: shifts of the way-points, and of the table under them, from coarse to fine."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import Final, TypeVar

from control.model.arm import Arm, Vector3
from control.motion.waypoints import Waypoints

HALVINGS: Final = 2  # of the step: the error is smooth, an eighth of the area is near enough
NOWHERE: Final = (0.0, 0.0, 0.0)
Found = TypeVar("Found")


def shifted(arm: Arm, waypoints: Waypoints, shift_m: Vector3) -> tuple[Arm, Waypoints]:
    """The way-points and the arm's table, both moved."""
    points = tuple(_moved(point, shift_m) for point in waypoints.points)
    table = arm.table
    if table is not None and table.origin_m is not None and table.known_pose:
        arm = dataclasses.replace(
            arm, table=dataclasses.replace(table, origin_m=_moved(table.origin_m, shift_m))
        )
    return arm, dataclasses.replace(waypoints, points=points)


def best_place(
    area_m: Vector3, at: Callable[[Vector3], Found | None], is_better: Callable[[Found, Found], bool]
) -> tuple[Vector3, Found] | None:
    """The best shift within +- area_m: on a grid of three for each axis, then on finer ones around the best so far.

    `at` gives what a shift leads to, or None if the task cannot be done there.
    """
    seen: dict[Vector3, Found | None] = {}
    best: tuple[Vector3, Found] | None = None
    for halving in range(HALVINGS + 1):
        middle = NOWHERE if best is None else best[0]
        for shift in _around(middle, area_m, 0.5**halving):
            if shift in seen:
                continue
            seen[shift] = found = at(shift)
            if found is not None and (best is None or is_better(found, best[1])):
                best = (shift, found)
    return best


def places_count(area_m: Vector3) -> int:
    """How many places `best_place` looks at, at most."""
    grid: int = 3 ** sum(half > 0.0 for half in area_m)
    return grid + HALVINGS * (grid - 1)


def _around(middle: Vector3, area_m: Vector3, step: float) -> Iterator[Vector3]:
    """The middle first, so that of equal places the nearer one stays."""
    axes = [(0.0,) if half == 0.0 else (0.0, -step * half, step * half) for half in area_m]
    for offset in itertools.product(*axes):
        x, y, z = (min(half, max(-half, m + o)) for m, o, half in zip(middle, offset, area_m, strict=True))
        yield (x, y, z)


def _moved(point: Vector3, by: Vector3) -> Vector3:
    x, y, z = (a + b for a, b in zip(point, by, strict=True))
    return (x, y, z)
