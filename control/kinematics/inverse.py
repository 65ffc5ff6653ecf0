"""Inverse kinematics: from a tip position to joint angles, on a chosen branch, within the joint limits.

Three kinds of arm: the exact yaw - pitch - pitch structure has a closed form; one near it (a calibrated arm) uses
the closed form of the nearest ideal one as the seed of Newton's method; any other arm goes by damped least squares
and has no named branches.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import pi

import numpy as np

from control.errors import ArmError, MissingModel, NearSingular, OutOfReach
from control.kinematics import inverse_errors as errors
from control.kinematics.joint_range import JointRange, travel_rad, turned_toward
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.newton import ACCURACY_M, Newton
from control.kinematics.numeric_inverse import Descent, can_move_freely, descend, seeds
from control.kinematics.planar_inverse import BRANCHES, Branch, PlanarInverse, planar_inverse
from control.kinematics.pose_kinematics import PoseKinematics
from control.kinematics.pose_solver import POSITION_TOLERANCE_M, Task, task_of
from control.model.arm import Arm, Vector3

__all__ = ["BRANCHES", "Branch", "InverseKinematics", "Solution"]

_LARGEST_FOLLOWED_RAD = 0.5  # between two cycles; more is a jump to another solution


@dataclass(frozen=True, slots=True)
class Solution:
    """One way to reach a point."""

    branch: Branch
    q: tuple[float, ...]
    within_limits: bool


class InverseKinematics:
    """Joint angles for tip positions of one arm, to 1e-9 m; to 0.1 mm where the tip moves on a surface (`moves_freely`).

    `elbow_margin_rad` and `shoulder_margin_m` are the required distances from singular poses; for arms
    of another structure, `singular_margin_m` is the least tip travel per radian in the weakest direction.
    """

    def __init__(
        self,
        arm: Arm,
        elbow_margin_rad: float = 0.05,
        shoulder_margin_m: float = 0.01,
        singular_margin_m: float = 0.005,
    ) -> None:
        self.kinematics = ForwardKinematics(arm)
        self._name = arm.name
        self._range = JointRange(arm)
        self._rest = arm.rest.q_rad if arm.rest is not None else (0.0,) * arm.joint_count
        self._elbow_margin_rad = elbow_margin_rad
        self._shoulder_margin_m = shoulder_margin_m
        self._singular_margin_m = singular_margin_m
        self._planar = planar_inverse(self.kinematics)
        self._followed_to: tuple[Sequence[float] | None, Branch] = (None, BRANCHES[0])
        if self._planar is not None:
            self._newton = Newton(self.kinematics)

    @cached_property
    def poses(self) -> PoseKinematics:
        """Position and orientation of this arm's tip."""
        return PoseKinematics(self.kinematics)

    @cached_property
    def held(self) -> Task:
        """What the joints hold of the tip where its orientation matters; up to three joints hold the position only."""
        return task_of(self.poses, self.poses.joint_count > 3)

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
        found: list[Solution] = []
        failures: list[OutOfReach | NearSingular] = []
        for branch in BRANCHES:
            try:
                q = self._on_branch(point, branch)
                found.append(Solution(branch, q, self._range.is_inside(q)))
            except (OutOfReach, NearSingular) as failure:
                failures.append(failure.with_traceback(None))  # else it would hold this frame, which holds it
        if not found:
            failures.sort(key=_telling)
            raise failures.pop(0)
        return found

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
        """Return the joint angles within the limits that minimise the largest joint travel from `q_near`.

        Raises as `solve`; works for every arm.
        """
        self._range.check_pose(q_near)
        if self._planar is None:
            return self._nearest_numeric(errors.checked_point(point), q_near)
        solutions = self.branches(point)
        inside = [self._range.toward(s.q, q_near) for s in solutions if s.within_limits]
        if not inside:
            least = min(solutions, key=lambda s: self._range.excess_rad(s.q))
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

    def _check_margins(
        self, planar: PlanarInverse, point: Sequence[float], q: Sequence[float], branch: Branch
    ) -> None:
        """Raise NearSingular if q is too close to a singular pose, or has left its branch through one."""
        shoulder_m, elbow_rad = planar.margins(q)
        if branch.shoulder == "back":
            shoulder_m = -shoulder_m
        if branch.elbow == "down":
            elbow_rad = -elbow_rad
        if not shoulder_m >= self._shoulder_margin_m:
            limit, pose = self._shoulder_margin_m, "having the tip on axis 1"
            raise errors.near_singular(self._name, point, "shoulder", shoulder_m, limit, "m", pose)
        limit = self._elbow_margin_rad
        if not elbow_rad >= limit:
            raise errors.near_singular(self._name, point, "elbow", elbow_rad, limit, "rad", "stretched")
        if not pi - elbow_rad >= limit:
            raise errors.near_singular(self._name, point, "elbow", pi - elbow_rad, limit, "rad", "folded")

    def _nearest_numeric(self, target: Vector3, q_near: Sequence[float]) -> tuple[float, ...]:
        limits = np.array(self._range.limits)
        enough_m = ACCURACY_M if self.moves_freely else POSITION_TOLERANCE_M
        best = Descent(tuple(q_near), math.inf)
        for start in seeds(limits, [q_near, self._rest]):
            end = descend(self.kinematics, target, start, limits)
            best = min(best, end, key=lambda descent: descent.distance_m)
            if best.distance_m <= enough_m:
                self._check_weakest(target, best.q)
                return best.q
        raise errors.out_of_reach(self._name, target, best.distance_m)

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
        limit, pose = self._singular_margin_m, "losing a direction of motion"
        if weakest < limit:
            raise errors.near_singular(self._name, target, "arm", weakest, limit, "m/rad", pose)


def _telling(failure: OutOfReach | NearSingular) -> tuple[int, float]:
    """The most useful of several failures: near-singular, else the least distance out of reach."""
    return (0, failure.margin) if isinstance(failure, NearSingular) else (1, failure.distance_m)
