"""Inverse kinematics: from a tip position to joint angles, on a chosen branch, within the joint limits.

Three kinds of arm: the exact yaw - pitch - pitch structure has a closed form; one near it (a calibrated arm) uses
the closed form of the nearest ideal one as the seed of Newton's method; any other arm goes by damped least squares
and has no named branches.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import hypot, pi
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError, MissingModel, NearSingular, OutOfReach
from control.kinematics import pose_inverse
from control.kinematics import reach as errors
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.numeric_inverse import ACCURACY_M, Descent, Newton, can_move_freely, descend, seeds
from control.kinematics.reach import JointRange, travel_rad, turned_toward
from control.kinematics.tracing import Graph, Scalar, acos, atan2, compile_function, cos, sin, sqrt
from control.model.arm import Arm, Vector3

# Closed-form inverse kinematics of the structure yaw - pitch - pitch: axis 2 square to axis 1, axis 3 parallel
# to axis 2, any offsets, any tool (the reference arm; SpringerPlus 5:1771, Fig. 4).
#
# The axes are taken from the arm at q = 0, so DH convention, angle offsets and fixed links need no special cases.
# In the frame of axis 1 (z along it, y along axis 2), with complex numbers u + i z in the plane of the arm,
#
#     tip = a + exp(-i s2 q2) (l2 exp(i b2) + exp(-i s3 q3) l3 exp(i b3)),
#
# and the tip is offset from that plane by the constant w. For an arm near this structure the nearest ideal one is
# solved, and the solution is a seed.

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


BRANCHES = (Branch("front", "up"), Branch("front", "down"), Branch("back", "up"), Branch("back", "down"))


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

    def angles(self, point: Sequence[Scalar], branch: Branch, root: Function = sqrt, arc: Function = acos) -> tuple[Scalar, ...]:
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
        return (atan2(y, x) - atan2(w, u), self._s2 * (self._b2 - upper), self._s3 * (self._b3 - self._b2 - bend))

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
    ahead = 0 if kinematics.convention == "standard" else 1  # the axis is z of the previous frame, or of the link's own
    turning = [link + ahead for link, turns in enumerate(kinematics.joints) if turns]
    tip = frames[-1] @ np.array([*kinematics.tool_m, 1.0])
    facing = frames[turning[0] + 1 - ahead, :3, 0]
    return Axes(frames[turning, :3, 2], frames[turning, :3, 3], tip[:3], facing)


_LARGEST_FOLLOWED_RAD = 0.5  # between two cycles; more is a jump to another solution


@dataclass(frozen=True, slots=True)
class Solution:
    """One way to reach a point."""

    branch: Branch
    q: tuple[float, ...]
    within_limits: bool


class InverseKinematics:
    """Joint angles for tip positions of one arm, to 1e-9 m; to 0.1 mm where the tip moves on a surface (`moves_freely`)."""

    def __init__(self, arm: Arm) -> None:
        self.kinematics = ForwardKinematics(arm)
        self._name = arm.name
        self._range = JointRange(arm)
        self._rest = arm.rest_rad
        self._planar = planar_inverse(self.kinematics)
        self._followed_to: tuple[Sequence[float] | None, Branch] = (None, BRANCHES[0])
        if self._planar is not None:
            self._newton = Newton(self.kinematics)

    @cached_property
    def poses(self) -> PoseKinematics:
        """Position and orientation of this arm's tip."""
        return PoseKinematics(self.kinematics)

    @cached_property
    def held(self) -> pose_inverse.Task:
        """What the joints hold of the tip where its orientation matters; up to three joints hold the position only."""
        return pose_inverse.task_of(self.poses, self.poses.joint_count > 3)

    @cached_property
    def moves_freely(self) -> bool:
        """Whether the joints move the tip in all directions: not two joints, parallel axes only, or the tip on the third axis."""
        return self.has_branches or can_move_freely(self.kinematics)

    @property
    def follows_position(self) -> bool:
        """Whether a tip position alone fixes the joint angles, so that the loop can follow it: three joints that move freely."""
        return len(self._rest) == 3 and self.moves_freely

    def prepare(self) -> None:
        """Compile now what jogs and status need, and not between two cycles."""
        self.poses.at(*self._rest)
        self.held.freedom(len(self._rest))

    @property
    def has_branches(self) -> bool:
        """Whether the arm has the structure whose four branches have names."""
        return self._planar is not None

    def branch(self, q: Sequence[float]) -> Branch:
        """Return the branch of a pose; MissingModel if the arm has no branches."""
        self._range.check_pose(q)
        return self._structure().branch(q)

    def branches(self, point: Sequence[float]) -> list[Solution]:
        """Return every branch that reaches a point [m], ignoring joint limits.

        If none does, raises OutOfReach with the least distance, or NearSingular.
        """
        solutions: list[Solution] = []
        failures: list[OutOfReach | NearSingular] = []
        for branch in BRANCHES:
            try:
                q = self._on_branch(point, branch)
                solutions.append(Solution(branch, q, self._range.is_inside(q)))
            except (OutOfReach, NearSingular) as failure:
                failures.append(failure.with_traceback(None))  # else it would hold this frame, which holds it
        if not solutions:
            raise errors.most_telling(failures)
        return solutions

    def solve(self, point: Sequence[float], branch: Branch) -> tuple[float, ...]:
        """Return the joint angles for a point [m] on a branch.

        Raises:
            OutOfReach, NearSingular, JointLimitViolated: with the distance of the point.
            BadTarget: the point is not three finite numbers.
            MissingModel: the arm has no named branches; use `nearest`.
        """
        q = self._on_branch(point, branch)
        if not self._range.is_inside(q):
            self._range.check(q, f"to reach {errors.spelled(point)} with {branch}")
        return q

    def nearest(self, point: Sequence[float], q_near: Sequence[float]) -> tuple[float, ...]:
        """Return the joint angles within the limits near `q_near`: of the four branches, the one with the least largest travel;
        on other arms, where short steps from `q_near` lead, or else another start.

        Raises as `solve`; works for every arm.
        """
        self._range.check_pose(q_near)
        if self._planar is None:
            return self._nearest_numeric(errors.checked_point(point), q_near)
        solutions = self.branches(point)
        inside = [self._range.toward(s.q, q_near) for s in solutions if s.within_limits]
        if not inside:
            least = min(solutions, key=lambda s: self._range.farthest_rad(s.q))
            purpose = f"to reach {errors.spelled(point)} in any way ({least.branch} comes closest)"
            self._range.check(least.q, purpose)
        return min(inside, key=lambda q: travel_rad(q, q_near))

    def follow(self, point: Sequence[float], q_previous: Sequence[float]) -> tuple[float, ...]:
        """Return the joint angles for a point [m] near the last one, on the branch of the last pose.

        For the control cycle: the closed form, or a few Newton steps from the last pose. Raises as `solve`, and
        NearSingular if the pose would have to jump.
        """
        planar = self._planar
        if planar is None:
            return self._follow_numeric(point, q_previous)
        previous, branch = self._followed_to
        if q_previous is not previous:  # the pose that was given last has been checked to be on its branch
            branch = planar.branch(q_previous)
        q = self._followed(planar, point, q_previous, branch)
        if not travel_rad(q, q_previous) <= _LARGEST_FOLLOWED_RAD:  # NaN comes here, too
            self._range.check_pose(q_previous)
            target = errors.checked_point(point)
            raise errors.jump(self._name, target, travel_rad(q, q_previous), _LARGEST_FOLLOWED_RAD)
        self._check_margins(planar, point, q, branch)
        if not self._range.is_inside(q):
            self._range.check(q, f"to follow the path to {errors.spelled(point)}")
        self._followed_to = q, branch
        return q

    def _followed(
        self, planar: PlanarInverse, point: Sequence[float], q_previous: Sequence[float], branch: Branch
    ) -> tuple[float, ...]:
        if not planar.is_exact:
            q = self._newton.solve(point, q_previous)
            return q if q is not None else turned_toward(self._on_branch(point, branch), q_previous)
        try:
            return turned_toward(planar.closed_form[branch](point[0], point[1], point[2]), q_previous)
        except ValueError:
            target = errors.checked_point(point)
            raise errors.out_of_reach(self._name, target, planar.out_of_reach_m(target, branch)) from None

    def _structure(self) -> PlanarInverse:
        if self._planar is None:
            needs = "named branches need the structure yaw - pitch - pitch"
            raise MissingModel(f"arm {self._name}: {needs}; use nearest() for this arm")
        return self._planar

    def _on_branch(self, point: Sequence[float], branch: Branch) -> tuple[float, ...]:
        """Solve on a branch and bring every angle into its limits where whole turns can."""
        planar = self._structure()
        target = errors.checked_point(point)
        if branch not in planar.closed_form:
            choices = "; ".join(map(str, BRANCHES))
            raise ArmError(f"branch: expected one of {choices}, got {branch}")
        if planar.is_exact:
            distance_m = planar.out_of_reach_m(target, branch)
            if distance_m > 0.0:
                raise errors.out_of_reach(self._name, target, distance_m)
        q: Sequence[float] = planar.solve(target, branch)
        if not planar.is_exact:
            q = self._newton.solve(target, q) or self._descended(target, q)
        self._check_margins(planar, target, q, branch)
        return self._range.inside_by_turns(q)

    def _descended(self, target: Vector3, seed: Sequence[float]) -> tuple[float, ...]:
        """Damped least squares, if Newton's method fails; OutOfReach with the remaining distance."""
        end = descend(self.kinematics, target, seed, np.array([(-math.inf, math.inf)] * 3))
        if end.distance_m > ACCURACY_M:
            raise errors.out_of_reach(self._name, target, end.distance_m)
        return end.q

    def _check_margins(self, planar: PlanarInverse, point: Sequence[float], q: Sequence[float], branch: Branch) -> None:
        """Raise NearSingular if q is too close to a singular pose, or has left its branch through one."""
        shoulder_m, elbow_rad = planar.margins(q)
        if branch.shoulder == "back":
            shoulder_m = -shoulder_m
        if branch.elbow == "down":
            elbow_rad = -elbow_rad
        for singularity, margin in (
            (errors.ABOVE_AXIS_1, shoulder_m),
            (errors.STRETCHED, elbow_rad),
            (errors.FOLDED, pi - elbow_rad),
        ):
            if not margin >= singularity.least:
                raise errors.near_singular(self._name, point, singularity, margin)

    def _nearest_numeric(self, target: Vector3, q_near: Sequence[float]) -> tuple[float, ...]:
        limits = np.array(self._range.limits)
        enough_m = ACCURACY_M if self.moves_freely else pose_inverse.POSITION_TOLERANCE_M
        best = Descent(tuple(q_near), math.inf)
        for start in seeds(limits, [q_near, self._rest]):
            end = descend(self.kinematics, target, start, limits)
            is_first = best.distance_m == math.inf and self.moves_freely
            if is_first and travel_rad(end.q, q_near) > pose_inverse.LONGEST_STEP_RAD:  # long steps may lead far away, or nowhere
                ends = (self._by_short_steps(target, q_near), end)
                end = min(ends, key=lambda e: (max(e.distance_m, enough_m), travel_rad(e.q, q_near)))
            best = min(best, end, key=lambda descent: descent.distance_m)
            if best.distance_m <= enough_m:
                self._check_weakest(target, best.q)
                return best.q
        raise errors.out_of_reach(self._name, target, best.distance_m)

    def _by_short_steps(self, target: Vector3, q_near: Sequence[float]) -> Descent:
        """The pose that the arm comes to in short steps, each with the least motion of its joints."""
        aim, near = pose_inverse.Targets(np.array([target]), None), np.array([q_near])
        q = tuple(pose_inverse.solve(self.poses, self._of_position, aim, near).q_rad[0].tolist())
        is_fit = self._range.is_inside(q)
        return Descent(q, math.dist(self.kinematics.tip(*q), target) if is_fit else math.inf)

    @cached_property
    def _of_position(self) -> pose_inverse.Task:
        return pose_inverse.task_of(self.poses, False)

    def _follow_numeric(self, point: Sequence[float], q_previous: Sequence[float]) -> tuple[float, ...]:
        self._range.check_pose(q_previous)
        target = errors.checked_point(point)
        end = descend(self.kinematics, target, q_previous, np.array(self._range.limits))
        if end.distance_m > ACCURACY_M:
            raise errors.out_of_reach(self._name, target, end.distance_m)
        travel = travel_rad(end.q, q_previous)
        if travel > _LARGEST_FOLLOWED_RAD:
            raise errors.jump(self._name, target, travel, _LARGEST_FOLLOWED_RAD)
        return end.q

    def _check_weakest(self, target: Vector3, q: Sequence[float]) -> None:
        """Raise NearSingular if the tip cannot be moved in every direction, and could in other poses."""
        if not self.moves_freely:
            return
        weakest = float(np.linalg.svd(self.kinematics.tip_jacobian(*q)[1], compute_uv=False)[-1])
        if weakest < errors.LOSES_A_DIRECTION.least:
            raise errors.near_singular(self._name, target, errors.LOSES_A_DIRECTION, weakest)
