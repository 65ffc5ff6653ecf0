"""Approach directions to a point that reveal backlash in the joints.

With two approaches, a point is reached by two straight paths that turn as many joints as possible in opposite directions.
Every path ends downwards (a tip cannot come up through the board), so geometry allows two of three joints on
most of a board.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from calib.session.moves.ports import Geometry, Vector
from control.errors import ArmError

SLANTS_RAD = (
    0.6,
    0.95,
)  # of a slanted path against the normal: beyond 1 rad the tip would touch neighbouring cavities
SIDES = 8


def above_points(
    geometry: Geometry, tip_m: Vector, normal: Vector, height_m: float, q_near: Sequence[float], count: int
) -> tuple[Vector, ...]:
    """Start points of `count` (1 or 2) approaches to tip_m, each height_m above the board (base frame).

    A single approach comes straight down. ArmError if the arm cannot reach the point.
    """
    straight = _start(tip_m, normal, (0.0, 0.0, 0.0), height_m)
    if count == 1:
        return (straight,)
    at_point = geometry.nearest(tip_m, q_near)
    turns = {straight: _turns(geometry, straight, at_point)}
    for across in _across(normal):
        start = _start(tip_m, normal, across, height_m)
        try:
            turns[start] = _turns(geometry, start, at_point)
        except ArmError:
            continue  # not from this side
    if len(turns) == 1:
        return (straight, straight)
    return max(combinations(turns, 2), key=lambda pair: _opposition(turns[pair[0]], turns[pair[1]]))


def _across(normal: Vector) -> list[Vector]:
    """Horizontal offsets per unit of height: all sides, slightly and strongly slanted."""
    nx, ny, nz = normal
    norm = math.hypot(nx, nz)
    u = (nz / norm, 0.0, -nx / norm)
    v = (ny * u[2] - nz * u[1], nz * u[0] - nx * u[2], nx * u[1] - ny * u[0])
    ways = []
    for slant in SLANTS_RAD:
        for side in range(SIDES):
            angle = 2.0 * math.pi * side / SIDES
            c, s = math.tan(slant) * math.cos(angle), math.tan(slant) * math.sin(angle)
            ways.append((c * u[0] + s * v[0], c * u[1] + s * v[1], c * u[2] + s * v[2]))
    return ways


def _start(tip_m: Vector, normal: Vector, across: Vector, height_m: float) -> Vector:
    x, y, z = (p + height_m * (n + a) for p, n, a in zip(tip_m, normal, across, strict=True))
    return x, y, z


def _turns(geometry: Geometry, start: Vector, at_point: Sequence[float]) -> tuple[float, ...]:
    """Travel of each joint from start to the point [rad]."""
    return tuple(b - a for a, b in zip(geometry.nearest(start, at_point), at_point, strict=True))


def _opposition(first: Sequence[float], second: Sequence[float]) -> tuple[int, float]:
    """Number of joints that turn in opposite directions, and their smallest travel [rad]: more is better."""
    opposite = [min(abs(a), abs(b)) for a, b in zip(first, second, strict=True) if a * b < 0.0]
    return len(opposite), min(opposite, default=0.0)
