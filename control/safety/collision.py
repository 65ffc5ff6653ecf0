"""Distances between capsules in plain floats, fast enough for every cycle. Pure functions of positions.

A capsule is a segment with a radius. Nearest points of two segments: Ericson, Real-Time Collision Detection, 5.1.9.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

Point = Sequence[float]
NOTHING_m2 = 1e-12  # squared length of a segment that is a point
PARALLEL = 1e-9  # of the squared lengths' product: below it every point of a segment is as near


class Capsule(NamedTuple):
    """A segment from x, y, z along dx, dy, dz (squared length `dd`), how thick it is, and a sphere about all of it."""

    x: float
    y: float
    z: float
    dx: float
    dy: float
    dz: float
    dd: float
    radius_m: float
    cx: float
    cy: float
    cz: float
    around_m: float


class Nearest(NamedTuple):
    """The least gap [m] between two bodies, negative where they overlap, and the capsules that it is between."""

    gap_m: float
    one: int
    other: int


FAR = Nearest(math.inf, -1, -1)


def capsule(start_m: Point, end_m: Point, radius_m: float) -> Capsule:
    """The capsule between two points."""
    x, y, z = start_m
    dx, dy, dz = end_m[0] - x, end_m[1] - y, end_m[2] - z
    dd = dx * dx + dy * dy + dz * dz + NOTHING_m2
    around_m = 0.5 * math.sqrt(dd) + radius_m
    return Capsule(x, y, z, dx, dy, dz, dd, radius_m, x + 0.5 * dx, y + 0.5 * dy, z + 0.5 * dz, around_m)


def least_gap(
    one: Sequence[Capsule], other: Sequence[Capsule], pairs: Sequence[tuple[int, int]], within_m: float
) -> Nearest:
    """The least gap among `pairs` of capsules, if it is less than `within_m`; else FAR, without looking closely."""
    least, at = within_m, (-1, -1)
    for pair in pairs:
        px, py, pz, ux, uy, uz, a, r1, gx, gy, gz, g = one[pair[0]]
        qx, qy, qz, vx, vy, vz, e, r2, hx, hy, hz, h = other[pair[1]]
        cx, cy, cz, near = gx - hx, gy - hy, gz - hz, least + g + h
        if near < 0.0 or cx * cx + cy * cy + cz * cz > near * near:
            continue  # the spheres about them are not nearer than the nearest so far
        wx, wy, wz, reach = px - qx, py - qy, pz - qz, least + r1 + r2
        b = ux * vx + uy * vy + uz * vz
        c = ux * wx + uy * wy + uz * wz
        f = vx * wx + vy * wy + vz * wz
        ae = a * e
        d = ae - b * b
        s = (b * f - c * e) / d if d > PARALLEL * ae else 0.0
        s = 0.0 if s < 0.0 else 1.0 if s > 1.0 else s
        t = (b * s + f) / e
        if t < 0.0:
            t, s = 0.0, -c / a
            s = 0.0 if s < 0.0 else 1.0 if s > 1.0 else s
        elif t > 1.0:
            t, s = 1.0, (b - c) / a
            s = 0.0 if s < 0.0 else 1.0 if s > 1.0 else s
        x, y, z = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
        square = x * x + y * y + z * z
        if reach > 0.0 and square < reach * reach:
            least, at = square**0.5 - r1 - r2, pair
    return FAR if at[0] < 0 else Nearest(least, *at)


def middle(one: Capsule, other: Capsule) -> tuple[float, float, float]:
    """The point halfway between the axes of two capsules, where they are nearest; for messages."""
    px, py, pz, ux, uy, uz, a, *_ = one
    qx, qy, qz, vx, vy, vz, e, *_ = other
    wx, wy, wz = px - qx, py - qy, pz - qz
    b = ux * vx + uy * vy + uz * vz
    c = ux * wx + uy * wy + uz * wz
    f = vx * wx + vy * wy + vz * wz
    d = a * e - b * b
    s = min(max((b * f - c * e) / d, 0.0), 1.0) if d > PARALLEL * a * e else 0.0
    t = min(max((b * s + f) / e, 0.0), 1.0)
    s = min(max((b * t - c) / a, 0.0), 1.0)
    return (
        0.5 * (px + s * ux + qx + t * vx),
        0.5 * (py + s * uy + qy + t * vy),
        0.5 * (pz + s * uz + qz + t * vz),
    )
