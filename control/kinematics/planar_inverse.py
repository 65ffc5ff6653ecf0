"""Closed-form inverse kinematics of the structure yaw - pitch - pitch: axis 2 square to axis 1, axis 3 parallel
to axis 2, any offsets, any tool (the reference arm; SpringerPlus 5:1771, Fig. 4).

The axes are taken from the arm at q = 0, so DH convention, angle offsets and fixed links need no special cases.
In the frame of axis 1 (z along it, y along axis 2), with complex numbers u + i z in the plane of the arm,

    tip = a + exp(-i s2 q2) (l2 exp(i b2) + exp(-i s3 q3) l3 exp(i b3)),

and the tip is offset from that plane by the constant w. For an arm near this structure the nearest ideal one is
solved, and the solution is a seed.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import hypot, pi
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.straight_line import compile_function
from control.kinematics.tracing import Graph, Scalar, acos, atan2, cos, sin, sqrt

Array = NDArray[np.float64]
Shoulder = Literal["front", "back"]
Elbow = Literal["up", "down"]
Joints = tuple[float, float, float]
Function = Callable[[Scalar], Scalar]
_EXACT = 1e-12  # ideal to within the precision of the parameters
_NEAREST = 0.2  # rad: a larger deviation of an axis is another structure
_SHORTEST_M = 1e-3  # a link shorter than this has no elbow


class Branch(NamedTuple):
    """One branch of the inverse kinematics.

    Shoulder "front": the arm's plane faces the point, "back": the arm reaches over its shoulder. Elbow "up":
    above the line from shoulder to tip, as seen with the point to the front.
    """

    shoulder: Shoulder
    elbow: Elbow

    def __str__(self) -> str:
        return f"shoulder {self.shoulder}, elbow {self.elbow}"


BRANCHES = (
    Branch("front", "up"),
    Branch("front", "down"),
    Branch("back", "up"),
    Branch("back", "down"),
)


class SingularityMargins(NamedTuple):
    """Distance of a pose from its singularities.

    `shoulder_m`: distance of the tip from axis 1 within the arm's plane, negative in the branch "back";
    `elbow_rad`: bend of the elbow away from stretched (0) or folded (+-pi), negative in the branch "down".
    """

    shoulder_m: float
    elbow_rad: float


def planar_inverse(kinematics: ForwardKinematics) -> "PlanarInverse | None":
    """Return the closed form of the nearest ideal structure, or None if the arm's structure is different."""
    if kinematics.joint_count != 3:
        return None
    axes = _axes_at_zero(kinematics)
    z, y = axes.directions[0], axes.directions[1]
    if abs(y @ z) > _NEAREST or np.linalg.norm(np.cross(axes.directions[2], y)) > _NEAREST:
        return None
    planar = PlanarInverse(axes)
    return planar if min(planar.l2, planar.l3) > _SHORTEST_M else None


class PlanarInverse:
    """The closed form for one arm; `is_exact` is False if the arm deviates from the ideal structure."""

    def __init__(self, axes: "Axes") -> None:
        z = axes.directions[0]
        y = axes.directions[1] - z * (axes.directions[1] @ z)
        y /= np.linalg.norm(y)
        self._s2 = 1.0 if np.cross(z, axes.facing) @ y >= 0 else -1.0  # y is turned so that x faces forwards
        y = self._s2 * y
        self._s3 = 1.0 if axes.directions[2] @ y >= 0 else -1.0
        frame = np.array([np.cross(y, z), y, z])
        self._rows, self._origin = frame.tolist(), axes.points[0].tolist()
        shoulder, elbow, end = ((frame @ (p - axes.points[0])).tolist() for p in (*axes.points[1:], axes.tip))
        self._a_u, self._a_z = shoulder[0], shoulder[2]
        self._w: float = end[1]
        self.l2, self._b2 = _polar(elbow[0] - shoulder[0], elbow[2] - shoulder[2])
        self.l3, self._b3 = _polar(end[0] - elbow[0], end[2] - elbow[2])
        deviation = max(abs(axes.directions[1] @ z), np.linalg.norm(np.cross(axes.directions[2], y)))
        self.is_exact = bool(deviation < _EXACT)

    @cached_property
    def closed_form(self) -> dict[Branch, Callable[..., Joints]]:
        """For each branch `f(x, y, z) -> (q1, q2, q3)`, not wrapped; ValueError if out of reach."""
        return {branch: self._compiled(branch) for branch in BRANCHES}

    def local(self, point: Sequence[Scalar]) -> tuple[Scalar, Scalar, Scalar]:
        """Return a point of the base frame in the frame of axis 1."""
        x, y, z = point[0] - self._origin[0], point[1] - self._origin[1], point[2] - self._origin[2]
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = self._rows
        return ax * x + ay * y + az * z, bx * x + by * y + bz * z, cx * x + cy * y + cz * z

    def angles(
        self, point: Sequence[Scalar], branch: Branch, root: Function = sqrt, arc: Function = acos
    ) -> tuple[Scalar, ...]:
        """Return joint angles, not wrapped, for a point [m]; `root` and `arc` decide what happens out of reach."""
        x, y, z = self.local(point)
        w, l2, l3 = self._w, self.l2, self.l3
        u = root(x * x + y * y - w * w)
        if branch.shoulder == "back":
            u = -u
        du, dz = u - self._a_u, z - self._a_z
        bend = arc((du * du + dz * dz - (l2 * l2 + l3 * l3)) / (2.0 * l2 * l3))
        if (branch.elbow == "up") == (branch.shoulder == "front"):
            bend = -bend
        upper = atan2(dz, du) - atan2(l3 * sin(bend), l2 + l3 * cos(bend))
        return (
            atan2(y, x) - atan2(w, u),
            self._s2 * (self._b2 - upper),
            self._s3 * (self._b3 - self._b2 - bend),
        )

    def _compiled(self, branch: Branch) -> Callable[..., Joints]:
        graph = Graph()
        point = [graph.variable(name) for name in ("x", "y", "z")]
        return compile_function("closed_form", point, self.angles(point, branch))

    def solve(self, point: Sequence[float], branch: Branch) -> Joints:
        """Return joint angles in (-pi, pi]; out of reach, those of the nearest pose in the arm's plane."""
        try:
            q1, q2, q3 = self.closed_form[branch](point[0], point[1], point[2])
        except ValueError:
            q1, q2, q3 = self.angles(point, branch, _root_or_zero, _arc_or_end)
        return wrapped(q1), wrapped(q2), wrapped(q3)

    def out_of_reach_m(self, point: Sequence[float], branch: Branch) -> float:
        """Return the distance of a point from the branch's reach within the arm's plane; 0 inside."""
        x, y, z = self.local(point)
        from_axis = hypot(x, y)
        if from_axis < abs(self._w):
            return abs(self._w) - from_axis
        u = math.sqrt(from_axis * from_axis - self._w * self._w)
        from_shoulder = hypot((u if branch.shoulder == "front" else -u) - self._a_u, z - self._a_z)
        return max(from_shoulder - (self.l2 + self.l3), abs(self.l2 - self.l3) - from_shoulder, 0.0)

    def margins(self, q: Sequence[float]) -> SingularityMargins:
        """Return the distances of a pose of the (nearest) ideal structure from its singularities."""
        bend = wrapped(self._b3 - self._b2 - self._s3 * q[2])
        upper = self._b2 - self._s2 * q[1]
        u = self._a_u + self.l2 * math.cos(upper) + self.l3 * math.cos(upper + bend)
        return SingularityMargins(u, -bend if u >= 0.0 else bend)

    def branch(self, q: Sequence[float]) -> Branch:
        """Return the branch of a pose."""
        margins = self.margins(q)
        shoulder: Shoulder = "front" if margins.shoulder_m >= 0.0 else "back"
        return Branch(shoulder, "up" if margins.elbow_rad >= 0.0 else "down")


def _root_or_zero(square: float) -> float:
    return math.sqrt(square) if square > 0.0 else 0.0


def _arc_or_end(cosine: float) -> float:
    return math.acos(min(max(cosine, -1.0), 1.0))


def wrapped(angle_rad: float) -> float:
    """Return the angle within (-pi, pi]."""
    if -pi < angle_rad <= pi:
        return angle_rad
    wrapped = math.remainder(angle_rad, 2.0 * pi)
    return pi if wrapped == -pi else wrapped


def _polar(u: float, z: float) -> tuple[float, float]:
    return hypot(u, z), math.atan2(z, u)


@dataclass(frozen=True, slots=True)
class Axes:
    """The joint axes of an arm at q = 0 in the base frame: unit vectors (n, 3), a point on each (n, 3), the tip, and
    the direction in which the first link's x axis faces.
    """

    directions: Array
    points: Array
    tip: Array
    facing: Array


def _axes_at_zero(kinematics: ForwardKinematics) -> Axes:
    frames = kinematics.link_transforms(np.zeros((1, kinematics.joint_count)))[0]
    ahead = (
        0 if kinematics.convention == "standard" else 1
    )  # the axis is z of the previous frame, or of the link's own
    turning = [link + ahead for link, turns in enumerate(kinematics.joints) if turns]
    tip = frames[-1] @ np.array([*kinematics.tool_m, 1.0])
    facing = frames[turning[0] + 1 - ahead, :3, 0]
    return Axes(frames[turning, :3, 2], frames[turning, :3, 3], tip[:3], facing)
