"""Plans a Cartesian path for an arm: checks all of it before anything moves, and slows it where a limit
requires.

Slowing is local. If a section exceeds a limit, the speeds at its two way-points and its own pace are divided
by the required factor k (speed scales with 1/k, acceleration with 1/k^2, jerk with 1/k^3). The section times
follow, and the velocity stays continuous. Other sections keep their speed. After some rounds, the remaining
excess of a few per mille is removed by slowing the whole path.

A tip path relative to the tip of another arm that moves meanwhile: one time for both, so that neither leads.

    p(t) = R' (P(t) + o(t) - b),  0 <= t <= T

P: the other tip, o: the offset along the axes of the cell, R and b: this arm's base in the cell. P moves as planned, and o takes
as long; the whole is slowed until every limit of this arm is kept, too. The loop follows cubics through p and its speed every
STEP_S, which are 1e-6 m off at most where the other's jerk steps.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any, TypeVar

import numpy as np

from control.errors import ArmError, PathError
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.pose_inverse import PoseInverse
from control.model.arm import Arm
from control.model.cell import Placed
from control.motion import checks, following
from control.motion.checks import Array, JointSamples, TipSamples
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.pace import Stretched
from control.motion.setpoint import Motion, Vector
from control.motion.spline import DEFAULT_PACE_M_S, CartesianSpline, TimedWaypoints, checked_points, hermite, timed
from control.motion.waypoints import Waypoints

T = TypeVar("T")
_CHECK_RATE_HZ = 500.0
# A round applies only this power of the required factor: neighbouring sections slow each other, and full
# steps end up to twice as slow as needed. Measured on fast circles and lines: 0.4 comes within a tenth of
# the slow optimum.
_CAUTION = 0.4
_ROUNDS = 20
_STARTS = 4  # poses at the first way-point that are tried: the branches of a three-joint arm
_NEAR_ENOUGH = 1.003  # the rest is removed by slowing the whole path


@dataclass(frozen=True, slots=True)
class Slowdown:
    """A section that takes `factor` times as long as requested, because of `limit` at `waypoint` (1-based)."""

    factor: float
    waypoint: int
    limit: str

    def __str__(self) -> str:
        return f"{self.factor:.2f} times as long as asked at way-point {self.waypoint}: {self.limit}"


@dataclass(frozen=True, slots=True)
class PlannedPath:
    """A path that this arm can run: of the tip, and the joints' own, which the loop runs. Poses are at the spline's times."""

    spline: CartesianSpline
    q_waypoints_rad: tuple[following.Pose, ...]
    joints: JointPath
    branch: str = ""
    slowdowns: tuple[Slowdown, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time of the whole path."""
        return self.spline.duration_s

    @property
    def q_start_rad(self) -> tuple[float, ...]:
        """Joint angles at the first way-point, where the approach ends."""
        return self.q_waypoints_rad[0]

    def to_message(self) -> dict[str, Any]:
        """The joints' path, for JSON."""
        return self.joints.to_message()


def plan_path(
    arm: Arm,
    waypoints: Waypoints | Sequence[Sequence[float]],
    speeds: float | Sequence[float] | None = None,
    *,
    q_near_rad: Sequence[float] | None = None,
    setup: str = "normal",
    pace_m_s: float = DEFAULT_PACE_M_S,
    inverse: InverseKinematics | None = None,
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
        inverse: of this arm, if the caller has it already.

    Raises:
        ArmError: the path cannot be run; names the obstacle, the way-point and the amount.
    """
    named = _named(waypoints)
    planner = _Planner(arm, named, setup, inverse)
    recipe = planner.recipe(named.speeds_m_s if speeds is None else speeds, pace_m_s)
    return next(_each(planner.starts(q_near_rad), lambda start: planner.plan(recipe, start)))


def plan_paths(arm: Arm, waypoints: Waypoints) -> Iterator[PlannedPath]:
    """A plan from each start that can be run, on each branch of an arm that has some; the first is that of `plan_path`.

    Raises:
        ArmError: none can be run; the first start's.
    """
    planner = _Planner(arm, waypoints, "normal")
    recipe = planner.recipe(waypoints.speeds_m_s, DEFAULT_PACE_M_S)
    return _each(planner.starts(None), lambda start: planner.plan(recipe, start))


def _named(waypoints: Waypoints | Sequence[Sequence[float]]) -> Waypoints:
    if isinstance(waypoints, Waypoints):
        return waypoints
    return Waypoints(tuple(checked_points(waypoints)), None)


def _each(starts: Iterable[following.PathStart], plan: Callable[[following.PathStart], T]) -> Iterator[T]:
    """The plan from each start that can be run. If there is none, the first start's error."""
    problems: list[ArmError] = []
    is_any = False
    for start in starts:
        try:
            planned = plan(start)
        except ArmError as problem:
            problems.append(problem.with_traceback(None))
            continue
        is_any = True
        yield planned
    if not is_any:
        raise problems.pop(0)


class _Planner:
    """Tries the path of one arm through one set of way-points on a branch."""

    def __init__(self, arm: Arm, waypoints: Waypoints, setup: str, inverse: InverseKinematics | None = None) -> None:
        self._arm, self._waypoints, self._setup = arm, waypoints, setup
        self._limits = JointLimits.of(arm)
        self._inverse = inverse or InverseKinematics(arm)
        # Positions of three joints have branches or scalar solutions; everything else follows a posture.
        self._follower: following.Follower
        if waypoints.orientations is None and self._inverse.follows_position:
            self._follower = following.BranchFollower(self._inverse, waypoints)
        else:
            self._follower = following.PostureFollower(arm, PoseInverse(arm, self._inverse.poses), waypoints)

    def starts(self, q_near_rad: Sequence[float] | None) -> Iterator[following.PathStart]:
        """Poses to begin in, the nearest first; by default those near the rest pose."""
        return islice(self._follower.starts(self._arm.rest_rad if q_near_rad is None else q_near_rad), _STARTS)

    def recipe(self, speeds: float | Sequence[float] | None, pace_m_s: float) -> TimedWaypoints:
        """The way-points with their times, as asked for. PathError with the place in the file, where they come from one."""
        turned, places = self._waypoints.orientations, self._waypoints.places
        turns = following.turns_rad(turned) if turned is not None else ()
        try:
            return timed(self._waypoints.points, speeds, pace_m_s=pace_m_s, turns_rad=turns)
        except PathError as problem:
            if problem.waypoint is None or not places:
                raise
            raise PathError(f"{places[problem.waypoint - 1]}: {problem}", problem.waypoint) from problem

    def plan(self, recipe: TimedWaypoints, start: following.PathStart) -> PlannedPath:
        """Check, slow, check again; PathError if the path cannot be run from `start`."""
        self._follower.check(start)
        asked = np.diff(recipe.spline().times_s)
        causes: dict[int, tuple[float, int, str]] = {}
        for _ in range(_ROUNDS):
            spline = recipe.spline()
            seen = self._follower.follow(recipe, spline, start, 0.0)
            factors = self._factors(spline, seen.tip, seen.joints, causes)
            if (factors <= _NEAR_ENOUGH).all():
                break
            recipe = recipe.slowed((np.maximum(factors, 1.0) ** _CAUTION).tolist())
        seen, rest = self._checked(recipe, recipe.spline(), start, causes)
        spline = recipe.spline().stretched(rest) if rest > 1.0 else recipe.spline()
        taken = np.diff(spline.times_s) / asked
        slowdowns = tuple(Slowdown(float(taken[i]), number, limit) for i, (_, number, limit) in sorted(causes.items()))
        joints = self._joint_path(seen, rest)
        return PlannedPath(spline, seen.at_waypoints, joints, str(start.branch or ""), slowdowns)

    def as_timed(
        self, recipe: TimedWaypoints, spline: CartesianSpline, start: following.PathStart
    ) -> tuple[PlannedPath, float, str]:
        """Check, and slow the whole path by one factor; with the factor and the limit. PathError if it cannot be run."""
        self._follower.check(start)
        causes: dict[int, tuple[float, int, str]] = {}
        seen, rest = self._checked(recipe, spline, start, causes)
        limit = max(causes.values())[2] if causes else ""
        joints = self._joint_path(seen, rest)
        path = PlannedPath(spline.stretched(rest), seen.at_waypoints, joints, str(start.branch or ""))
        return path, rest, limit

    def _checked(
        self,
        recipe: TimedWaypoints,
        spline: CartesianSpline,
        start: following.PathStart,
        causes: dict[int, tuple[float, int, str]],
    ) -> tuple[following.Followed, float]:
        """The whole path followed and checked, and how many times slower it must be, at least 1."""
        seen = self._follower.follow(recipe, spline, start, _CHECK_RATE_HZ)
        self._check(spline, seen.tip, seen.joints)
        return seen, max(float(self._factors(spline, seen.tip, seen.joints, causes).max()), 1.0)

    def _joint_path(self, seen: following.Followed, stretch: float) -> JointPath:
        """The joints' own path."""
        sections = following.joint_sections(seen.tip, seen.joints, stretch)
        if sections.off_m > following.BOUND_M or sections.off_rad > following.BOUND_RAD:
            raise PathError(
                f"the path turns so sharply that joint sections miss it by {sections.off_m:.2g} m and {sections.off_rad:.2g} rad"
                f" (at most {following.BOUND_M:g} m and {following.BOUND_RAD:g} rad): run it slower; nothing was moved"
            )
        return sections.path

    def _check(self, spline: CartesianSpline, tip: TipSamples, joints: JointSamples) -> None:
        """Checks that do not depend on speed."""
        way = checks.Passage(self._waypoints, spline.times_s)
        checks.check_poses(way, tip, joints, self._limits)
        checks.check_clearance(self._arm, self._setup, way, tip, joints.q_rad)
        checks.check_room(self._arm, way, tip, joints.q_rad)

    def _factors(
        self, spline: CartesianSpline, tip: TipSamples, joints: JointSamples, causes: dict[int, tuple[float, int, str]]
    ) -> Array:
        """How much slower each section has to be (n,); `causes` gets the decisive limit and its place."""
        demands = checks.demands(tip, joints, self._limits, self._arm.limits)
        stacked = np.stack([demand.factors for demand in demands])
        worst, limit = stacked.max(axis=0), stacked.argmax(axis=0)
        factors = np.zeros(len(spline.times_s) - 1)
        np.maximum.at(factors, tip.section, worst)
        for section in np.flatnonzero(factors > 1.0):
            sample = int(np.where(tip.section == section, worst, -1.0).argmax())
            number = checks.Passage(self._waypoints, spline.times_s).nearest(float(tip.times_s[sample]))
            if factors[section] > causes.get(int(section), (1.0, 0, ""))[0]:
                causes[int(section)] = (float(factors[section]), number, demands[limit[sample]].limit)
        return factors


def plan_in_time(
    arm: Arm, spline: CartesianSpline, names: Sequence[str], q_near_rad: Sequence[float]
) -> tuple[PlannedPath, float, str]:
    """Plan a tip path whose time is given, as of one that another arm takes part in: it can only be slowed as a whole.

    Args:
        arm: its limits, geometry and table.
        spline: positions [m] in the base frame, at rest at both ends.
        names: of the spline's knots, for errors.
        q_near_rad: the branch whose start is nearest to this pose is used.

    Returns:
        The path, how many times slower it is than asked (at least 1), and the limit that made it slower, or "".

    Raises:
        ArmError: as `plan_path`.
    """
    points = tuple(spline.at(time_s)[0] for time_s in spline.times_s)
    lengths_m = tuple(math.dist(a, b) for a, b in pairwise(points))
    still = (0.0,) * len(points)
    recipe = TimedWaypoints(points, points, lengths_m, still, still[1:], False)
    planner = _Planner(arm, Waypoints(points, None, tuple(names)), "normal")
    return next(_each(planner.starts(q_near_rad), lambda start: planner.as_timed(recipe, spline, start)))


STEP_S = 0.01
KNOTS_MOST = 1500  # a request stays below the server's longest line


@dataclass(frozen=True, slots=True)
class Beside:
    """The path of the arm, how many times longer it takes than the other's motion alone, and which limit of this arm says so.

    `limit`: "" if none does. `offsets`: over the path's time, along the axes of the cell.
    """

    path: PlannedPath
    slower: float
    limit: str
    offsets: CartesianSpline


def plan_beside(follower: Placed, leader: Placed, motion: Motion, offsets: Waypoints, q_near_rad: Sequence[float]) -> Beside:
    """Plan `follower` along `offsets` from the tip of `leader`, which runs `motion` from rest to rest.

    Both are where they should be to each other if they begin together and the runtime stretches the other's motion to this one's
    time (move_together). ArmError if the path cannot be run.
    """
    if offsets.orientations is not None:
        raise ArmError("offsets from another tip: expected way-points without orientation (qw,qx,qy,qz)")
    if motion.duration_s <= 0.0:
        raise ArmError(
            f"arm {leader.name!r} does not move: offsets from a tip at rest are run with `armwright run --relative-to"
            f" {leader.name}`"
        )
    way = _way(offsets, motion.duration_s)
    duration_s = way.duration_s
    times_s = _times(way)
    spline = _sum(follower, leader, Stretched(motion, duration_s), way, times_s)
    places = [_place(offsets, way, time_s) for time_s in times_s]
    path, rest, limit = plan_in_time(follower.arm, spline, places, q_near_rad)
    return Beside(path, path.duration_s / motion.duration_s, limit, way.stretched(rest))


def _way(offsets: Waypoints, least_s: float) -> CartesianSpline:
    """Through the offsets, in their own time but not less than `least_s`; a single one is kept."""
    if len(offsets.points) == 1:
        return CartesianSpline((0.0, least_s), [[c for x in offsets.points[0] for c in (x, 0.0, 0.0, 0.0)]])
    way = timed(offsets.points, offsets.speeds_m_s).spline()
    return way.stretched(max(least_s / way.duration_s, 1.0))


def _times(way: CartesianSpline) -> list[float]:
    """Even times, and those of the offsets' own knots, where their acceleration steps."""
    count = min(KNOTS_MOST, max(2, round(way.duration_s / STEP_S)))
    even, knots_s = np.linspace(0.0, way.duration_s, count + 1), np.array(way.times_s[1:-1])
    is_far = np.abs(even[:, None] - knots_s[None, :]).min(axis=1, initial=np.inf) > 0.1 * STEP_S
    is_far[[0, -1]] = True
    return [float(time_s) for time_s in np.sort(np.concatenate((even[is_far], knots_s)))]


def _sum(follower: Placed, leader: Placed, motion: Motion, way: CartesianSpline, times_s: Sequence[float]) -> CartesianSpline:
    """The tip in the follower's base frame: cubics through place and speed at each time."""
    jacobian_at = ForwardKinematics(leader.arm).tip_jacobian
    turn = np.array(follower.rotation).T
    across = turn @ np.array(leader.rotation)
    points: list[Vector] = []
    speeds: list[Vector] = []
    for time_s in times_s:
        state = motion.at(time_s)
        tip, rows = jacobian_at(*state.q_rad)
        offset, speed, _ = way.at(time_s)
        points += follower.beside_tip(leader, tip, [offset])
        x, y, z = (across @ np.array(rows) @ state.speed_rad_s + turn @ speed).tolist()
        speeds.append((x, y, z))
    return hermite(points, speeds, np.diff(times_s).tolist())


def _place(offsets: Waypoints, way: CartesianSpline, time_s: float) -> str:
    """A time on the path, by the way-point before it."""
    number = int(np.searchsorted(way.times_s, time_s + 1e-9))
    return f"{time_s:.2f} s after the start, at offset {offsets.name(max(number, 1))}"
