"""An arm's body as capsules, and distances between capsules in plain floats, fast enough for every cycle. Pure functions.

A capsule is a segment with a radius. Nearest points of two segments: Ericson, Real-Time Collision Detection, 5.1.9.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from control.kinematics.kinematics import Corners
from control.model.cell import Placed

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


def least_gap(first: Sequence[Capsule], second: Sequence[Capsule], pairs: Sequence[tuple[int, int]], within_m: float) -> Nearest:
    """The least gap among `pairs` of capsules, if it is less than `within_m`; else FAR, without looking closely."""
    least, at = within_m, (-1, -1)
    for pair in pairs:
        px, py, pz, ux, uy, uz, a, r1, gx, gy, gz, g = first[pair[0]]
        qx, qy, qz, vx, vy, vz, e, r2, hx, hy, hz, h = second[pair[1]]
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


def middle(first: Capsule, second: Capsule) -> tuple[float, float, float]:
    """The point halfway between the axes of two capsules, where they are nearest; for messages."""
    px, py, pz, ux, uy, uz, a, *_ = first
    qx, qy, qz, vx, vy, vz, e, *_ = second
    wx, wy, wz = px - qx, py - qy, pz - qz
    b = ux * vx + uy * vy + uz * vz
    c = ux * wx + uy * wy + uz * wz
    f = vx * wx + vy * wy + vz * wz
    d = a * e - b * b
    s = min(max((b * f - c * e) / d, 0.0), 1.0) if d > PARALLEL * a * e else 0.0
    t = min(max((b * s + f) / e, 0.0), 1.0)
    s = min(max((b * t - c) / a, 0.0), 1.0)
    return (0.5 * (px + s * ux + qx + t * vx), 0.5 * (py + s * uy + qy + t * vy), 0.5 * (pz + s * uz + qz + t * vz))


Capsules = tuple[Capsule, ...]
BASE, TOOL = "base", "tool"
LEAST_m = 1e-9  # a shorter link has no direction


class ArmBody:
    """Capsules of one arm with one of its tools: [[link]] radius_m is how thick the links are, [limits] base_radius_m the base.

    `names` of the capsules: base, link by number, tool. The tool is the last `tool_length_m` before the tip, a line.
    """

    def __init__(self, placed: Placed, tool_length_m: float) -> None:
        arm = placed.arm
        corners = Corners(arm)
        self._at, self._start_m = corners.at, corners.start_m
        self._origin_m, self._rotation = placed.origin_m, placed.rotation
        self._radii_m = corners.radii_m
        self._tool_m = tool_length_m
        top_m = (0.0, 0.0, max(arm.links[0].d_m, 0.0))
        self._base = capsule(placed.in_cell((0.0, 0.0, 0.0)), placed.in_cell(top_m), arm.limits.base_radius_m)
        self.names = (BASE, *(f"link {number}" for number in corners.joints), TOOL)
        self.joints = (0, *corners.joints, corners.joints[-1])
        rest = arm.rest.q_rad if arm.rest is not None else _middles(arm.limits_rad)
        self.own_pairs = self._meeting_pairs(self.at(rest))

    def at(self, q_rad: Sequence[float]) -> Capsules:
        """The capsules of a pose (joint angles) in the frame of the cell."""
        (ox, oy, oz), ((a, b, c), (d, e, f), (g, h, i)) = self._origin_m, self._rotation
        x, y, z = self._start_m
        last = ox + a * x + b * y + c * z, oy + d * x + e * y + f * z, oz + g * x + h * y + i * z
        capsules = [self._base]
        corners, radii_m = self._at(*q_rad), self._radii_m
        tip = len(corners) - 1
        for k, (x, y, z) in enumerate(corners):
            here = ox + a * x + b * y + c * z, oy + d * x + e * y + f * z, oz + g * x + h * y + i * z
            if k == tip:
                # The last link ends where the tool begins.
                share = min(1.0, self._tool_m / max(math.dist(last, here), self._tool_m, LEAST_m))
                (px, py, pz), (qx, qy, qz) = last, here
                neck = qx + share * (px - qx), qy + share * (py - qy), qz + share * (pz - qz)
                capsules.append(capsule(last, neck, radii_m[k]))
                last = neck
            capsules.append(capsule(last, here, radii_m[k] if k < tip else 0.0))
            last = here
        return tuple(capsules)

    def _meeting_pairs(self, rest: Capsules) -> tuple[tuple[int, int], ...]:
        """Pairs of the arm's own capsules that may meet: at least two joints between them, and apart in the rest pose.

        The base is left to control.safety.workspace, which knows its axis. Neighbours in the chain always touch.
        """
        pairs = [(i, j) for i in range(1, len(rest)) for j in range(i + 2, len(rest)) if self.joints[j] - self.joints[i] >= 2]
        return tuple(pair for pair in pairs if not least_gap(rest, rest, (pair,), 0.0).gap_m < 0.0)


def pairs_between(body: ArmBody, neighbour: ArmBody) -> tuple[tuple[int, int], ...]:
    """Pairs of capsules of two arms that must not meet: all but base and base, and the tools, which may touch."""
    return tuple(
        (i, j)
        for i, first in enumerate(body.names)
        for j, second in enumerate(neighbour.names)
        if not (first == second == BASE or first == second == TOOL)
    )


def _middles(limits_rad: Sequence[tuple[float, float]]) -> tuple[float, ...]:
    return tuple(0.5 * (lower + upper) if math.isfinite(lower + upper) else 0.0 for lower, upper in limits_rad)
