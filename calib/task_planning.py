"""A task as the arm does it best: for paths that are run through, and for points to stop at."""

from __future__ import annotations

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array, Mask
from calib.design.candidates import STARTS_COUNT, TOUCH_M, body_points, joint_box, postures, spread_poses
from calib.design.planning import DETOUR_RAD, clear_ways, short_path
from calib.errors import CalibrationError
from calib.gap.plan.motions import CLEARANCE_m, ground_m
from calib.gap.plan.plan import APPROACH_rad
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Path, Predictor, sampled
from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import Corners
from control.model.arm import Arm, Vector3
from control.motion.plan import PlannedPath, plan_paths
from control.motion.spline import DEFAULT_PACE_M_S
from control.motion.waypoints import Waypoints
from control.plain_text import Advance, silent
from control.safety.workspace import LinkThickness, Workspace

DRAWS: Final = 200  # arms that the points allow
WORTH: Final = 0.99  # of the error, above which a change is not worth making
SURE: Final = 0.95  # of these, for which a way must be better before it is chosen


@dataclass(frozen=True, slots=True)
class Cost:
    """Root mean square distances over the poses of a task [m].

    rms_m: expected of one visit; drawn_m (DRAWS,): of each drawn arm. Parts of its square: known_m, which the arm's file does
    not correct; unknown_m, which the points leave open; scatter_m, from visit to visit.
    """

    rms_m: float
    known_m: float
    unknown_m: float
    scatter_m: float
    drawn_m: Array


class Judge:
    """Costs of ways by one prediction; all are judged by the same drawn arms."""

    def __init__(self, predictor: Predictor) -> None:
        self._predictor = predictor
        posterior = predictor.posterior
        self._off = (posterior.draws(DRAWS, 0) - posterior.mean).T

    def squares_m2(self, poses: Conditions) -> Array:
        """Expected squared distance of one visit at each pose (m,)."""
        return np.asarray(self._predictor.at(poses).rms_m ** 2)

    def cost(self, poses: Conditions) -> Cost:
        """Over all poses alike."""
        error = self._predictor.at(poses)
        drawn = error.expected_m[:, :, None] + self._predictor.columns(poses) @ self._off
        scatter = np.trace(error.random_m2, axis1=1, axis2=2)
        unknown = np.trace(error.systematic_m2, axis1=1, axis2=2)
        known = np.sum(error.expected_m**2, axis=1)
        rms, *parts = (float(np.sqrt(part.mean())) for part in (known + unknown + scatter, known, unknown, scatter))
        drawn_m = np.sqrt((np.sum(drawn**2, axis=1) + scatter[:, None]).mean(axis=0))
        return Cost(rms, parts[0], parts[1], parts[2], drawn_m)


def is_surely_better(cost: Cost, than: Cost) -> bool:
    """Whether `cost` is expected to be better, and is for nearly every arm that the points allow."""
    return cost.rms_m < than.rms_m and float(np.mean(cost.drawn_m < than.drawn_m)) >= SURE


HALVINGS: Final = 2  # of the step: the error is smooth, an eighth of the area is near enough
NOWHERE: Final = (0.0, 0.0, 0.0)
Found = TypeVar("Found")


def shifted(arm: Arm, waypoints: Waypoints, shift_m: Vector3) -> tuple[Arm, Waypoints]:
    """The way-points and the arm's table, both moved."""
    points = tuple(_moved(point, shift_m) for point in waypoints.points)
    table = arm.table
    if table is not None and table.origin_m is not None and table.known_pose:
        arm = dataclasses.replace(arm, table=dataclasses.replace(table, origin_m=_moved(table.origin_m, shift_m)))
    return arm, dataclasses.replace(waypoints, points=points)


def best_place(
    area_m: Vector3, at: Callable[[Vector3], Found | None], is_better: Callable[[Found, Found], bool]
) -> tuple[Vector3, Found] | None:
    """The best shift within +- area_m: on a grid of three for each axis, then on finer ones around the best so far.

    `at` gives what a shift leads to, or None if the task cannot be done there.
    """
    seen: dict[Vector3, Found | None] = {}
    best: tuple[Vector3, Found] | None = None
    for halving in range(HALVINGS + 1):
        middle = NOWHERE if best is None else best[0]
        for shift in _around(middle, area_m, 0.5**halving):
            if shift in seen:
                continue
            seen[shift] = candidate = at(shift)
            if candidate is not None and (best is None or is_better(candidate, best[1])):
                best = (shift, candidate)
    return best


def places_count(area_m: Vector3) -> int:
    """How many places `best_place` looks at, at most."""
    grid: int = 3 ** sum(half > 0.0 for half in area_m)
    return grid + HALVINGS * (grid - 1)


def _around(middle: Vector3, area_m: Vector3, step: float) -> Iterator[Vector3]:
    """The middle first, so that of equal places the nearer one stays."""
    axes = [(0.0,) if half == 0.0 else (0.0, -step * half, step * half) for half in area_m]
    for offset in itertools.product(*axes):
        x, y, z = (min(half, max(-half, m + o)) for m, o, half in zip(middle, offset, area_m, strict=True))
        yield (x, y, z)


def _moved(point: Vector3, by: Vector3) -> Vector3:
    x, y, z = (a + b for a, b in zip(point, by, strict=True))
    return (x, y, z)


ROUNDING_m: Final = 1e-6
AHEAD: Final = (1.0, 0.5)  # of the way of a lead-in that are looked at, besides its end


def lead_in_of(q_rad: Array, direction: Array) -> Array:
    """Where to come from, so that every joint arrives in this direction (m, n)."""
    return np.asarray(q_rad - APPROACH_rad * direction)


def table_m(arm: Arm) -> float:
    """Height of the table's origin; of the floor without one."""
    table = arm.table
    return table.origin_m[2] if table is not None and table.origin_m is not None else arm.limits.floor_z_m


class Room:
    """The joints' ranges, floor, table and own base of an arm; `arm` of the methods is the same with its table moved."""

    def __init__(self, arm: Arm) -> None:
        self._corners = Corners(arm)
        self._lowest_table_m = min(table_m(arm), arm.limits.floor_z_m)
        self._body = LinkThickness(self._corners.radii_m, self._corners.first_free)

    def holds(self, arm: Arm, q_rad: Array) -> bool:
        """Whether the loop's guard lets the arm be at all of these poses (m, n)."""
        return bool(self._may_be(arm, q_rad).all())

    def has_lead_in(self, arm: Arm, q_rad: Array, direction: Array) -> Mask:
        """Which poses (m, n) can be come to in these directions (m,).

        No part of the arm is below floor or board at the pose, and none is lower on the way to it, unless well clear.
        """
        lower, upper = np.array(arm.limits_rad).T
        ways = np.stack([q_rad, *(q_rad + share * (lead_in_of(q_rad, direction) - q_rad) for share in AHEAD)])
        flat = ways.reshape(-1, q_rad.shape[1])
        heights = body_points(arm, flat)[:, :, 2]
        moving = np.ptp(heights, axis=0) > ROUNDING_m
        heights = heights[:, moving].reshape(len(ways), len(q_rad), -1)
        least = np.minimum(heights[0], ground_m(arm) + CLEARANCE_m) - ROUNDING_m
        is_right = ((flat >= lower) & (flat <= upper)).all(axis=1) & self._may_be(arm, flat)
        is_clear = (heights >= least).all(axis=(0, 2)) & (heights[0] >= ground_m(arm) - TOUCH_M).all(axis=1)
        return np.asarray(is_right.reshape(len(ways), -1).all(axis=0) & is_clear)

    def _may_be(self, arm: Arm, q_rad: Array) -> Mask:
        # The floor ends at a board that is let into it, but not where a plan puts one.
        is_possible = np.full(len(q_rad), table_m(arm) >= self._lowest_table_m - ROUNDING_m)
        for distance_m, _ in Workspace.of(arm).clearances(self._corners.batch(q_rad), self._body):
            is_possible &= distance_m >= -ROUNDING_m
        return is_possible


@dataclass(frozen=True, slots=True)
class Freedom:
    """What may be changed: how far the work may be moved, +- along x, y, z [m], and whether the order of its points."""

    shift_m: Vector3 = NOWHERE
    any_order: bool = False
    payload_kg: float = 0.0


Way = TypeVar("Way", bound="WayOfPath | WayOfStops")


@dataclass(frozen=True, slots=True)
class TaskPlan(Generic[Way]):
    """The task as given, as chosen, and what each choice brought: its name and the error after it [m]."""

    plain: Way
    chosen: Way
    steps: tuple[tuple[str, float], ...]


class WaySearch(ABC, Generic[Way]):
    """What all searches have: one arm, one judge, the task as given (`_plain`) and the best place for it."""

    _plain: Way

    def __init__(self, arm: Arm, predictor: Predictor, waypoints: Waypoints, freedom: Freedom, advance: Advance) -> None:
        self._arm, self._judge, self._given, self._freedom = arm, Judge(predictor), waypoints, freedom
        self._advance, self._done, self._room = advance, 0, Room(arm)

    @abstractmethod
    def _best_at(self, shift_m: Vector3) -> Way | None:
        """The best way with the work moved by shift_m; None if the task cannot be done there."""

    def _best_place(self) -> Way | None:
        if not any(self._freedom.shift_m):
            return None
        found = best_place(self._freedom.shift_m, self._best_at, self._is_better_place)
        return None if found is None else found[1]

    def _is_better_place(self, one: Way, than: Way) -> bool:
        return one.cost.rms_m < than.cost.rms_m and is_surely_better(one.cost, self._plain.cost)

    def _is_better(self, way: Way, than: Way) -> bool:
        """Worth the change, and sure to be better than the plain one."""
        return way.cost.rms_m < WORTH * than.cost.rms_m and is_surely_better(way.cost, self._plain.cost)


# A path with the least expected tip error: its place, its branch, its way round, its speed, and how the arm comes to it.
#
# The path as it is given, planned as `armwright run` plans it from rest, is always a candidate. Another is chosen only if it is
# better for nearly every arm that the points allow, so that a guess never makes the path worse.


PACES: Final = (0.7, 0.5, 0.35, 0.25)  # of the speed given: gears that inertia lifts off their flank stay on it
SAMPLES: Final = 100


@dataclass(frozen=True, slots=True)
class WayOfPath:
    """One way to run the path: `waypoints` as run, `arm` with its table where the work stands.

    lead_in_rad: from where every joint comes to the start in the direction in which it leaves, so that no gear turns over
    there; the start itself where there is no room for that.
    """

    arm: Arm
    waypoints: Waypoints
    shift_m: Vector3
    is_reversed: bool
    pace: float
    plan: PlannedPath
    motion: Path
    lead_in_rad: tuple[float, ...]
    cost: Cost


class PathPlan(TaskPlan[WayOfPath]):
    """A path, as given and as chosen."""

    __slots__ = ()


def planned_path(arm: Arm, predictor: Predictor, waypoints: Waypoints, freedom: Freedom, advance: Advance = silent) -> PathPlan:
    """The best way within what may be changed. PathError if the path as given cannot be run."""
    return _PathSearch(arm, predictor, waypoints, freedom, advance).run()


class _PathSearch(WaySearch[WayOfPath]):
    """One choice after the other: branch, place, way round, speed."""

    def run(self) -> PathPlan:
        ways = list(self._ways(NOWHERE))
        self._plain = best = ways[0]
        choices: tuple[tuple[str, Callable[[WayOfPath], list[WayOfPath]]], ...] = (
            ("branch", lambda _: ways[1:]),
            ("place", self._placed),
            ("way round", self._turned),
            ("speed", self._slower),
        )
        steps: list[tuple[str, float]] = []
        for name, ways_from in choices:
            self._advance(f"looking for a better {name}", self._share())
            better = [way for way in ways_from(best) if self._is_better(way, best)]
            if better:
                least_m = min(way.cost.rms_m for way in better)
                best = next(way for way in better if WORTH * way.cost.rms_m <= least_m)
                steps.append((name, best.cost.rms_m))
        return PathPlan(self._plain, best, tuple(steps))

    def _share(self) -> float:
        """Of the search: nearly all of it are the places."""
        return min(1.0, self._done / places_count(self._freedom.shift_m))

    def _turned(self, best: WayOfPath) -> list[WayOfPath]:
        return list(self._ways(best.shift_m, True)) if self._freedom.any_order else []

    def _slower(self, best: WayOfPath) -> list[WayOfPath]:
        """The fastest first."""
        return [way for pace in PACES for way in self._ways(best.shift_m, best.is_reversed, pace)]

    def _placed(self, _: WayOfPath) -> list[WayOfPath]:
        found = self._best_place()
        return [] if found is None else [found]

    def _best_at(self, shift_m: Vector3) -> WayOfPath | None:
        self._done += 1
        self._advance("looking for a better place", self._share())
        return min(self._ways(shift_m), key=lambda one: one.cost.rms_m, default=None)

    def _ways(self, shift_m: Vector3, is_reversed: bool = False, pace: float = 1.0) -> Iterator[WayOfPath]:
        """One for each start from which the arm can run it; ArmError if the path as given has none."""
        arm, waypoints = shifted(self._arm, self._given, shift_m)
        waypoints = backwards(waypoints) if is_reversed else waypoints
        waypoints = paced(waypoints, pace) if pace != 1.0 else waypoints
        is_given = shift_m == NOWHERE and not is_reversed and pace == 1.0
        try:
            for plan in plan_paths(arm, waypoints):
                motion = sampled(arm, plan, self._freedom.payload_kg, SAMPLES)
                if is_given or self._room.holds(arm, motion.poses.q_rad):
                    lead_in = self._lead_in(arm, plan, motion)
                    cost = self._judge.cost(motion.poses)
                    yield WayOfPath(arm, waypoints, shift_m, is_reversed, pace, plan, motion, lead_in, cost)
        except ArmError:
            if is_given:
                raise

    def _lead_in(self, arm: Arm, plan: PlannedPath, motion: Path) -> tuple[float, ...]:
        start, direction = np.array([plan.q_start_rad]), motion.poses.direction[:1]
        is_possible = self._room.has_lead_in(arm, start, direction)[0]
        return tuple((lead_in_of(start, direction) if is_possible else start)[0].tolist())


def backwards(waypoints: Waypoints) -> Waypoints:
    """The last way-point first."""
    speeds, turned = waypoints.speeds_m_s, waypoints.orientations
    return Waypoints(
        waypoints.points[::-1],
        speeds[::-1] if speeds is not None else None,
        waypoints.places[::-1],
        turned[::-1] if turned is not None else None,
    )


def paced(waypoints: Waypoints, pace: float) -> Waypoints:
    """The same at this share of its speed."""
    given = waypoints.speeds_m_s or (DEFAULT_PACE_M_S,) * len(waypoints.points)
    return dataclasses.replace(waypoints, speeds_m_s=tuple(pace * speed for speed in given))


# Points at which the arm stops: the posture and the side of approach of each, their order, and where they stand.
#
# A gear with play lies on one flank or the other, as its joint came. So each point gets the side on which the error is expected
# to be least, and a lead-in that makes every joint come from there. Sides are searched joint by joint; the error is linear in
# them.


ROUNDS: Final = 2  # of turning each joint's side over


@dataclass(frozen=True, slots=True)
class WayOfStops:
    """One way to visit the points: in this order (m,) of the file's rows, poses and sides (m, n) by row.

    `has_lead_in` (m,): whether the side is the lead-in's, or as the joints come from the point before.
    """

    arm: Arm
    waypoints: Waypoints
    shift_m: Vector3
    order: tuple[int, ...]
    poses: Conditions
    has_lead_in: Mask
    cost: Cost

    @property
    def lead_in_rad(self) -> Array:
        """Where each approach begins (m, n); not a number where there is no lead-in."""
        return np.where(self.has_lead_in[:, None], lead_in_of(self.poses.q_rad, self.poses.direction), np.nan)

    @property
    def travel_rad(self) -> float:
        """Sum of the largest joint travels from the rest pose over all points."""
        here, total = np.array(self.arm.rest_rad), 0.0
        for row in self.order:
            stops = [self.lead_in_rad[row]] if self.has_lead_in[row] else []
            for there in (*stops, self.poses.q_rad[row]):
                total += float(np.abs(there - here).max())
                here = there
        return total


class StopsPlan(TaskPlan[WayOfStops]):
    """Stops, as given and as chosen."""

    __slots__ = ()


def planned_stops(arm: Arm, predictor: Predictor, waypoints: Waypoints, freedom: Freedom, advance: Advance = silent) -> StopsPlan:
    """The best way within what may be changed. ArmError if a point as given is out of reach."""
    if waypoints.orientations is not None:
        raise CalibrationError("--stops: takes positions, got orientations: leave out the columns qw to qz")
    return _StopsSearch(arm, predictor, waypoints, freedom, advance).run()


class _StopsSearch(WaySearch[WayOfStops]):
    """First posture and side of each point, then the place, then the order."""

    def run(self) -> StopsPlan:
        self._plain = best = self._as_given()
        steps: list[tuple[str, float]] = []
        here = self._best_at(NOWHERE)
        if here is not None and self._is_better(here, best):
            best = here
            steps.append(("postures and sides", best.cost.rms_m))
        place = self._best_place()
        if place is not None and self._is_better(place, best):
            best = place
            steps.append(("place", best.cost.rms_m))
        return StopsPlan(self._plain, self._ordered(best), tuple(steps))

    def _as_given(self) -> WayOfStops:
        """In the file's order, each in the posture that is nearest to the one before, straight from there."""
        inverse, here, q = InverseKinematics(self._arm), np.array(self._arm.rest_rad), []
        for point in self._given.points:
            here = np.array(inverse.nearest(point, tuple(here.tolist())))
            q.append(here)
        nearest = np.array(q)
        sides = np.sign(np.diff(nearest, axis=0, prepend=[self._arm.rest_rad]))
        return self._way(self._arm, self._given, NOWHERE, self._conditions(nearest, sides), np.zeros(len(nearest), dtype=bool))

    def _best_at(self, shift_m: Vector3) -> WayOfStops | None:
        """The least expected error of each point where the work is moved by shift_m; None if one is out of reach."""
        self._done += 1
        self._advance("looking for a place", min(1.0, self._done / (1 + places_count(self._freedom.shift_m))))
        arm, waypoints = shifted(self._arm, self._given, shift_m)
        box = joint_box(arm)
        starts = spread_poses(box, STARTS_COUNT)
        q, which = postures(ArmModel(arm), np.array(waypoints.points), starts, box)
        if len(np.unique(which)) < len(waypoints.points):
            return None
        sides, squares = self._sides(arm, q)
        rows = [int(min(np.flatnonzero(which == point), key=lambda row: squares[row])) for point in range(len(waypoints.points))]
        if not np.isfinite(squares[rows]).all():
            return None
        return self._way(arm, waypoints, shift_m, self._conditions(q[rows], sides[rows]), np.ones(len(rows), dtype=bool))

    def _sides(self, arm: Arm, q: Array) -> tuple[Array, Array]:
        """The best side (p, n) of each posture (p, n), and its squared error [m^2]; infinite where no lead-in is possible."""
        best, least = np.ones(q.shape), np.full(len(q), np.inf)
        for first in (1.0, -1.0):
            sides, squares = np.full(q.shape, first), self._squares(arm, q, np.full(q.shape, first))
            for joint in list(range(q.shape[1])) * ROUNDS:
                flipped = sides.copy()
                flipped[:, joint] *= -1.0
                flipped_m2 = self._squares(arm, q, flipped)
                is_better = flipped_m2 < squares
                sides, squares = np.where(is_better[:, None], flipped, sides), np.minimum(flipped_m2, squares)
            is_better = squares < least
            best, least = np.where(is_better[:, None], sides, best), np.minimum(squares, least)
        return best, least

    def _squares(self, arm: Arm, q: Array, sides: Array) -> Array:
        squares = self._judge.squares_m2(self._conditions(q, sides))
        return np.where(self._room.has_lead_in(arm, q, sides), squares, np.inf)

    def _conditions(self, q: Array, sides: Array) -> Conditions:
        return Conditions(q, sides, np.full(len(q), self._freedom.payload_kg))

    def _way(self, arm: Arm, waypoints: Waypoints, shift_m: Vector3, poses: Conditions, led: Mask) -> WayOfStops:
        return WayOfStops(arm, waypoints, shift_m, tuple(range(len(led))), poses, led, self._judge.cost(poses))

    def _ordered(self, way: WayOfStops) -> WayOfStops:
        """A short way through all points, if they may be visited in any order; lead-ins keep the sides."""
        if not (self._freedom.any_order and way.has_lead_in.all()):
            return way
        q = np.vstack((way.arm.rest_rad, way.poses.q_rad))
        entry = np.vstack((way.arm.rest_rad, way.lead_in_rad))
        ways = np.abs(entry[None, :] - q[:, None]).max(axis=2)
        ways = 0.5 * (ways + ways.T) + DETOUR_RAD * ~clear_ways(way.arm, q, ())
        order = tuple(k - 1 for k in short_path(ways)[1:])
        found = WayOfStops(way.arm, way.waypoints, way.shift_m, order, way.poses, way.has_lead_in, way.cost)
        return found if found.travel_rad < way.travel_rad else way
