"""Arms of three joints, whose tip position fixes the joint angles on a branch."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics, Solution
from control.kinematics.kinematics import ForwardKinematics
from control.motion import checks
from control.motion.errors import PathError
from control.motion.following.follower import LEAST_SAMPLES, SEED_STEP_M, Followed, PathStart, Pose
from control.motion.samples import interpolated, sample_tip, solve_joints
from control.motion.spline import CartesianSpline, TimedWaypoints
from control.motion.waypoints import Waypoints


class BranchFollower:
    """Implements Follower with the inverse kinematics of positions."""

    def __init__(
        self, inverse: InverseKinematics, kinematics: ForwardKinematics, waypoints: Waypoints
    ) -> None:
        self._inverse, self._kinematics, self._waypoints = inverse, kinematics, waypoints

    def starts(self, q_near: Sequence[float]) -> Iterator[PathStart]:
        """Branches that reach the first way-point and their poses, within limits first, then nearest first."""
        first = self._waypoints.points[0]
        try:
            if not self._inverse.has_branches:
                yield PathStart(self._inverse.nearest(first, q_near))
                return
            solutions = self._inverse.branches(first)
        except ArmError as problem:
            raise PathError(f"{self._waypoints.name(1)}: {problem}; nothing was moved", 1) from problem

        def distance(solution: Solution) -> tuple[bool, float]:
            return not solution.within_limits, max(
                abs(a - b) for a, b in zip(solution.q, q_near, strict=True)
            )

        yield from (PathStart(solution.q, solution.branch) for solution in sorted(solutions, key=distance))

    def check(self, start: PathStart) -> None:
        """PathError for the first way-point that the branch does not reach."""
        if start.branch is None:
            return
        for number, point in enumerate(self._waypoints.points, 1):
            try:
                self._inverse.solve(point, start.branch)
            except ArmError as problem:
                raise PathError(
                    f"{self._waypoints.name(number)}: {problem}; nothing was moved", number
                ) from problem

    def follow(
        self, recipe: TimedWaypoints, spline: CartesianSpline, start: PathStart, rate_Hz: float
    ) -> Followed:
        """Newton from scalar solutions, at most SEED_STEP_M apart."""
        tip = sample_tip(spline, rate_Hz, LEAST_SAMPLES)
        times, poses, at_waypoints = self._seeds(recipe, spline, start.q_rad)
        seeds = interpolated(tip.times_s, times, poses)
        return Followed(tip, solve_joints(self._kinematics, tip, seeds), at_waypoints)

    def _seeds(
        self, recipe: TimedWaypoints, spline: CartesianSpline, q_start: Pose
    ) -> tuple[list[float], list[Pose], tuple[Pose, ...]]:
        """Times and poses followed along the path in small steps from `q_start`, and at the way-points."""
        times, poses, at_waypoints = [0.0], [q_start], [q_start]
        for length, (start, end) in zip(recipe.lengths_m, pairwise(spline.times_s), strict=True):
            steps = 2 + int(length / SEED_STEP_M)
            for k in range(1, steps + 1):
                time = end if k == steps else start + (end - start) * k / steps
                try:
                    poses.append(tuple(self._inverse.follow(spline.at(time)[0], poses[-1])))
                except ArmError as problem:
                    where, number = checks.place(self._waypoints, spline.times_s, time)
                    raise PathError(f"{where}: {problem}; nothing was moved", number) from problem
                times.append(time)
            at_waypoints.append(poses[-1])
        return times, poses, tuple(at_waypoints)
