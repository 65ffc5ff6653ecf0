"""A Cartesian path planned for an arm: checked as a whole before anything moves, slowed where a limit asks
for it.

Slowing is local. Where a section asks for more than a limit allows, the speeds at its two way-points and its
own pace fall by the factor that the limit asks for (speed goes with 1/k, acceleration with 1/k^2, jerk with
1/k^3), the section times follow, and the path stays continuous in velocity; sections that ask for nothing
keep their speed. What is left after some rounds, a few per mille, is taken from the whole path.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from control.errors import ArmError, BadTarget
from control.model.arm import Arm
from control.model.inverse import InverseKinematics
from control.model.kinematics import Kinematics
from control.motion import checks
from control.motion.errors import PathError
from control.motion.joint_limits import JointLimits
from control.motion.path import CartesianPath
from control.motion.samples import Array, JointSamples, TipSamples, interpolated, sample_tip, solve_joints
from control.motion.spline import DEFAULT_PACE_M_S, CartesianSpline, TimedWaypoints, timed
from control.motion.waypoints import Waypoints

_CHECK_RATE_HZ = 500.0
_LEAST_SAMPLES = 12  # of a section, however short
_SEEDS = 4  # of a section: scalar solutions between which the batch starts
_ROUNDS = 8
_MARGIN = 1.002  # the rounds aim a little below the limit, so that they end


@dataclass(frozen=True, slots=True)
class Slowdown:
    """A section that takes `factor` times as long as asked, because of `limit` at `waypoint` (1-based)."""

    factor: float
    waypoint: int
    limit: str

    def __str__(self) -> str:
        return f"slowed {self.factor:.2f} times at way-point {self.waypoint}: {self.limit}"


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """A path that this arm can run. Poses are those at the spline's times, on one branch throughout."""

    spline: CartesianSpline
    q_waypoints_rad: tuple[tuple[float, ...], ...]
    branch: str
    slowdowns: tuple[Slowdown, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time of the whole path."""
        return self.spline.duration_s

    @property
    def q_start_rad(self) -> tuple[float, ...]:
        """Joint angles at the first way-point: where the approach has to end."""
        return self.q_waypoints_rad[0]

    def motion(self, inverse: InverseKinematics, kinematics: Kinematics) -> CartesianPath:
        """The motion that the loop runs."""
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
        """Inverse of `to_message`; PathError where it is none. The loop still guards every set-point."""
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
        path. q_near_rad: of the branches that can run the whole path, the one whose start is nearest; the
        arm's rest pose
            by default.
        setup: how the calibration board is tilted, for clearance.
        pace_m_s: speed where none is given.
        inverse, kinematics: of this arm, where the caller has them already.

    Raises:
        ArmError: what stands in the way, with the way-point and by how much; nothing is planned by half.
    """
    kinematics = kinematics or Kinematics(arm)
    inverse = inverse or InverseKinematics(arm)
    if arm.joint_count != 3:
        raise PathError(
            f"arm {arm.name}: Cartesian paths need 3 joints, it has {arm.joint_count}; use joint moves"
        )
    named = waypoints if isinstance(waypoints, Waypoints) else Waypoints(_points(waypoints), None)
    recipe = timed(named.points, named.speeds_m_s if speeds is None else speeds, pace_m_s=pace_m_s)
    planner = _Planner(arm, kinematics, inverse, named, setup)
    problems: list[ArmError] = []
    for branch in _starts(arm, inverse, named, q_near_rad):
        try:
            return planner.plan(recipe, branch)
        except ArmError as problem:
            problems.append(problem)
    raise problems[0]


class _Planner:
    """One arm, one set of way-points: tries the path on a branch."""

    def __init__(
        self, arm: Arm, kinematics: Kinematics, inverse: InverseKinematics, waypoints: Waypoints, setup: str
    ) -> None:
        self._arm, self._kinematics, self._inverse = arm, kinematics, inverse
        self._waypoints, self._setup = waypoints, setup
        self._limits = JointLimits.of(arm)

    def plan(self, recipe: TimedWaypoints, branch: Any) -> PlannedPath:
        """Check, slow, check again; PathError where the path cannot be run on `branch`."""
        poses = self._waypoint_poses(branch)
        asked = np.diff(recipe.spline().times_s)
        causes: dict[int, tuple[float, int, str]] = {}
        for _ in range(_ROUNDS):
            spline = recipe.spline()
            tip, joints = self._sampled(spline, poses, 0.0)
            factors = self._factors(spline, tip, joints, causes)
            if (factors <= 1.0).all():
                break
            recipe = recipe.slowed(np.where(factors > 1.0, factors * _MARGIN, 1.0).tolist())
        spline = recipe.spline()
        tip, joints = self._sampled(spline, poses, _CHECK_RATE_HZ)
        self._check(spline, tip, joints)
        rest = float(self._factors(spline, tip, joints, causes).max())
        spline = spline.stretched(rest) if rest > 1.0 else spline
        taken = np.diff(spline.times_s) / asked
        slowdowns = [
            Slowdown(float(taken[i]), number, limit) for i, (_, number, limit) in sorted(causes.items())
        ]
        return PlannedPath(spline, poses, str(branch), tuple(slowdowns))

    def _waypoint_poses(self, branch: Any) -> tuple[tuple[float, ...], ...]:
        """Joint angles at every way-point; an error says which one is the trouble."""
        poses = []
        for number, point in enumerate(self._waypoints.points, 1):
            try:
                poses.append(tuple(self._inverse.solve(point, branch)))
            except ArmError as problem:
                raise PathError(
                    f"{self._waypoints.name(number)}: {problem}; nothing was moved", number
                ) from problem
        return tuple(poses)

    def _sampled(
        self, spline: CartesianSpline, poses: Sequence[Sequence[float]], rate_Hz: float
    ) -> tuple[TipSamples, JointSamples]:
        """Tip and joints all along the path."""
        tip = sample_tip(spline, rate_Hz, _LEAST_SAMPLES)
        return tip, solve_joints(self._kinematics, tip, self._seeds(spline, poses, tip))

    def _seeds(self, spline: CartesianSpline, poses: Sequence[Sequence[float]], tip: TipSamples) -> Array:
        """Poses near the branch at all samples: scalar solutions at a few points a section, linear
        between.
        """
        times, known = [spline.times_s[0]], [tuple(poses[0])]
        for i, (start, end) in enumerate(zip(spline.times_s, spline.times_s[1:], strict=False)):
            for k in range(1, _SEEDS):
                time = start + (end - start) * k / _SEEDS
                times.append(time)
                known.append(self._followed(spline, time, known[-1]))
            times.append(end)
            known.append(tuple(poses[i + 1]))
        return interpolated(tip.times_s, times, known)

    def _followed(self, spline: CartesianSpline, time_s: float, near: Sequence[float]) -> tuple[float, ...]:
        try:
            return tuple(self._inverse.follow(spline.at(time_s)[0], near))
        except ArmError as problem:
            where, number = checks.place(self._waypoints, spline.times_s, time_s)
            raise PathError(f"{where}: {problem}; nothing was moved", number) from problem

    def _check(self, spline: CartesianSpline, tip: TipSamples, joints: JointSamples) -> None:
        """Everything that slowing does not cure."""
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
        """How much slower each section has to be (n,); notes in `causes` who asked for the most, and
        where.
        """
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


def _points(waypoints: Sequence[Sequence[float]]) -> tuple[tuple[float, float, float], ...]:
    """Plain points as tuples; what is no point is left for `timed` to refuse."""
    return tuple(tuple(float(value) for value in point) for point in waypoints)  # type: ignore[misc]


def _starts(
    arm: Arm, inverse: InverseKinematics, waypoints: Waypoints, q_near_rad: Sequence[float] | None
) -> list[Any]:
    """Branches that reach the first way-point, nearest first."""
    try:
        solutions = inverse.branches(waypoints.points[0])
    except ArmError as problem:
        raise PathError(f"{waypoints.name(1)}: {problem}; nothing was moved", 1) from problem
    near = (
        q_near_rad if q_near_rad is not None else (arm.rest.q_rad if arm.rest else (0.0,) * arm.joint_count)
    )
    if len(near) != arm.joint_count:
        raise BadTarget(f"q_near_rad: expected {arm.joint_count} angles, got {len(near)}")

    def distance(solution: Any) -> tuple[bool, float]:
        return not solution.within_limits, max(abs(a - b) for a, b in zip(solution.q, near, strict=True))

    return [solution.branch for solution in sorted(solutions, key=distance)]
