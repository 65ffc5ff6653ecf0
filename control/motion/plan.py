"""Plans a Cartesian path for an arm: checks all of it before anything moves, and slows it where a limit
requires.

Slowing is local. If a section exceeds a limit, the speeds at its two way-points and its own pace are divided
by the required factor k (speed scales with 1/k, acceleration with 1/k^2, jerk with 1/k^3). The section times
follow, and the velocity stays continuous. Other sections keep their speed. After some rounds, the remaining
excess of a few per mille is removed by slowing the whole path.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from control.errors import ArmError
from control.kinematics.inverse import Branch, InverseKinematics, Solution
from control.kinematics.kinematics import Kinematics
from control.model.arm import Arm
from control.motion import checks
from control.motion.errors import PathError
from control.motion.joint_limits import JointLimits
from control.motion.path import CartesianPath
from control.motion.samples import Array, JointSamples, TipSamples, interpolated, sample_tip, solve_joints
from control.motion.spline import DEFAULT_PACE_M_S, CartesianSpline, TimedWaypoints, checked_points, timed
from control.motion.waypoints import Waypoints

Pose = tuple[float, ...]
_CHECK_RATE_HZ = 500.0
_LEAST_SAMPLES = 12  # of a section, however short
_SEED_STEP_M = 0.02  # the batch starts from scalar solutions at most this far apart
# A round applies only this power of the required factor: neighbouring sections slow each other, and full
# steps end up to twice as slow as needed. Measured on fast circles and lines: 0.4 comes within a tenth of
# the slow optimum.
_CAUTION = 0.4
_ROUNDS = 20
_NEAR_ENOUGH = 1.003  # the rest is removed by slowing the whole path


@dataclass(frozen=True, slots=True)
class Slowdown:
    """A section that takes `factor` times as long as requested, because of `limit` at `waypoint` (1-based)."""

    factor: float
    waypoint: int
    limit: str

    def __str__(self) -> str:
        return f"slowed {self.factor:.2f} times at way-point {self.waypoint}: {self.limit}"


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """A path that this arm can run. Poses are at the spline's times, all on one branch."""

    spline: CartesianSpline
    q_waypoints_rad: tuple[Pose, ...]
    branch: str
    slowdowns: tuple[Slowdown, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time of the whole path."""
        return self.spline.duration_s

    @property
    def q_start_rad(self) -> tuple[float, ...]:
        """Joint angles at the first way-point, where the approach ends."""
        return self.q_waypoints_rad[0]

    def motion(self, inverse: InverseKinematics, kinematics: Kinematics) -> CartesianPath:
        """The motion for the loop."""
        return CartesianPath(self.spline, inverse, kinematics, self.q_waypoints_rad)

    def to_message(self) -> dict[str, Any]:
        """Plain lists and strings, for JSON."""
        return {
            "spline": self.spline.to_message(),
            "q_waypoints_rad": [list(q) for q in self.q_waypoints_rad],
            "branch": self.branch,
            "slowdowns": [[s.factor, s.waypoint, s.limit] for s in self.slowdowns],
        }

    @staticmethod
    def from_message(message: Mapping[str, Any]) -> "PlannedPath":
        """Inverse of `to_message`; PathError if it is invalid. The loop still limits every set-point."""
        try:
            spline = CartesianSpline.from_message(message["spline"])
            poses = tuple(tuple(float(angle) for angle in q) for q in message["q_waypoints_rad"])
            slowdowns = tuple(Slowdown(float(f), int(w), str(limit)) for f, w, limit in message["slowdowns"])
            branch = str(message["branch"])
        except (KeyError, TypeError, ValueError) as error:
            raise PathError(
                f"path message: expected what PlannedPath.to_message() gives ({error!r})"
            ) from None
        if len(poses) != len(spline.times_s) or not np.isfinite(np.array(poses, dtype=np.float64)).all():
            raise PathError(f"path message: expected {len(spline.times_s)} finite poses, got {len(poses)}")
        return PlannedPath(spline, poses, branch, slowdowns)


def require_paths(arm: Arm) -> None:
    """PathError if this arm cannot run Cartesian paths: to be called before anything moves or is recorded."""
    if arm.joint_count != 3:
        raise PathError(
            f"arm {arm.name}: Cartesian paths need 3 joints, it has {arm.joint_count}; use joint moves"
        )


def plan_path(
    arm: Arm,
    waypoints: Waypoints | Sequence[Sequence[float]],
    speeds: float | Sequence[float] | None = None,
    *,
    q_near_rad: Sequence[float] | None = None,
    setup: str = "normal",
    pace_m_s: float = DEFAULT_PACE_M_S,
    inverse: InverseKinematics | None = None,
    kinematics: Kinematics | None = None,
) -> PlannedPath:
    """Plan the path through `waypoints` (m, 3) [m] in the base frame.

    Args:
        arm: its limits, geometry and table.
        waypoints: from a file or a table, or plain points.
        speeds: [m/s] one for all, one each, or None: those of `waypoints`, else an acceleration-continuous
            path.
        q_near_rad: the branch whose start is nearest to this pose is used; by default the rest pose.
        setup: how the calibration board is tilted, for clearance.
        pace_m_s: speed if none is given.
        inverse, kinematics: of this arm, if the caller has them already.

    Raises:
        ArmError: the path cannot be run; names the obstacle, the way-point and the amount.
    """
    kinematics = kinematics or Kinematics(arm)
    inverse = inverse or InverseKinematics(arm)
    require_paths(arm)
    named = (
        waypoints if isinstance(waypoints, Waypoints) else Waypoints(tuple(checked_points(waypoints)), None)
    )
    recipe = timed(named.points, named.speeds_m_s if speeds is None else speeds, pace_m_s=pace_m_s)
    planner = _Planner(arm, kinematics, inverse, named, setup)
    problems: list[ArmError] = []
    for branch, q_start in _starts(arm, inverse, named, q_near_rad):
        try:
            return planner.plan(recipe, branch, q_start)
        except ArmError as problem:
            problems.append(problem)
    raise problems[0]


class _Planner:
    """Tries the path of one arm through one set of way-points on a branch."""

    def __init__(
        self, arm: Arm, kinematics: Kinematics, inverse: InverseKinematics, waypoints: Waypoints, setup: str
    ) -> None:
        self._arm, self._kinematics, self._inverse = arm, kinematics, inverse
        self._waypoints, self._setup = waypoints, setup
        self._limits = JointLimits.of(arm)

    def plan(self, recipe: TimedWaypoints, branch: Branch | None, q_start: Pose) -> PlannedPath:
        """Check, slow, check again; PathError if the path cannot be run from `q_start`."""
        if branch is not None:
            self._check_waypoints(branch)
        asked = np.diff(recipe.spline().times_s)
        causes: dict[int, tuple[float, int, str]] = {}
        for _ in range(_ROUNDS):
            spline = recipe.spline()
            tip, joints, _ = self._sampled(recipe, spline, q_start, 0.0)
            factors = self._factors(spline, tip, joints, causes)
            if (factors <= _NEAR_ENOUGH).all():
                break
            recipe = recipe.slowed((np.maximum(factors, 1.0) ** _CAUTION).tolist())
        spline = recipe.spline()
        tip, joints, poses = self._sampled(recipe, spline, q_start, _CHECK_RATE_HZ)
        self._check(spline, tip, joints)
        rest = float(self._factors(spline, tip, joints, causes).max())
        spline = spline.stretched(rest) if rest > 1.0 else spline
        taken = np.diff(spline.times_s) / asked
        slowdowns = [
            Slowdown(float(taken[i]), number, limit) for i, (_, number, limit) in sorted(causes.items())
        ]
        return PlannedPath(spline, poses, str(branch or ""), tuple(slowdowns))

    def _check_waypoints(self, branch: Branch) -> None:
        """Raise PathError for the first way-point that the branch does not reach."""
        for number, point in enumerate(self._waypoints.points, 1):
            try:
                self._inverse.solve(point, branch)
            except ArmError as problem:
                raise PathError(
                    f"{self._waypoints.name(number)}: {problem}; nothing was moved", number
                ) from problem

    def _sampled(
        self, recipe: TimedWaypoints, spline: CartesianSpline, q_start: Pose, rate_Hz: float
    ) -> tuple[TipSamples, JointSamples, tuple[Pose, ...]]:
        """Tip and joints all along the path, and the poses at the way-points."""
        tip = sample_tip(spline, rate_Hz, _LEAST_SAMPLES)
        times, poses, at_waypoints = self._followed(recipe, spline, q_start)
        return tip, solve_joints(self._kinematics, tip, interpolated(tip.times_s, times, poses)), at_waypoints

    def _followed(
        self, recipe: TimedWaypoints, spline: CartesianSpline, q_start: Pose
    ) -> tuple[list[float], list[Pose], tuple[Pose, ...]]:
        """Times and poses followed along the path in small steps from `q_start`, and at the way-points."""
        times, poses, at_waypoints = [0.0], [q_start], [q_start]
        for length, (start, end) in zip(recipe.lengths_m, pairwise(spline.times_s), strict=True):
            steps = 2 + int(length / _SEED_STEP_M)
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

    def _check(self, spline: CartesianSpline, tip: TipSamples, joints: JointSamples) -> None:
        """Checks that do not depend on speed."""
        checks.check_poses(self._waypoints, spline.times_s, tip, joints, self._limits)
        checks.check_clearance(
            self._arm, self._kinematics, self._setup, self._waypoints, spline.times_s, tip, joints.q_rad
        )

    def _factors(
        self,
        spline: CartesianSpline,
        tip: TipSamples,
        joints: JointSamples,
        causes: dict[int, tuple[float, int, str]],
    ) -> Array:
        """How much slower each section has to be (n,); `causes` gets the decisive limit and its place."""
        found = checks.demands(tip, joints, self._limits, self._arm.limits.tip_speed_m_s)
        stacked = np.stack([demand.factors for demand in found])
        worst, limit = stacked.max(axis=0), stacked.argmax(axis=0)
        factors = np.zeros(len(spline.times_s) - 1)
        np.maximum.at(factors, tip.section, worst)
        for section in np.flatnonzero(factors > 1.0):
            sample = int(np.where(tip.section == section, worst, -1.0).argmax())
            _, number = checks.place(self._waypoints, spline.times_s, float(tip.times_s[sample]))
            if factors[section] > causes.get(int(section), (1.0, 0, ""))[0]:
                causes[int(section)] = (float(factors[section]), number, found[limit[sample]].limit)
        return factors


def _starts(
    arm: Arm, inverse: InverseKinematics, waypoints: Waypoints, q_near_rad: Sequence[float] | None
) -> list[tuple[Branch | None, Pose]]:
    """Branches that reach the first way-point and their poses, within limits first, then nearest first."""
    near = (
        q_near_rad if q_near_rad is not None else (arm.rest.q_rad if arm.rest else (0.0,) * arm.joint_count)
    )
    try:
        if not inverse.has_branches:
            return [(None, inverse.nearest(waypoints.points[0], near))]
        solutions = inverse.branches(waypoints.points[0])
    except ArmError as problem:
        raise PathError(f"{waypoints.name(1)}: {problem}; nothing was moved", 1) from problem

    def distance(solution: Solution) -> tuple[bool, float]:
        return not solution.within_limits, max(abs(a - b) for a, b in zip(solution.q, near, strict=True))

    return [(solution.branch, solution.q) for solution in sorted(solutions, key=distance)]
