"""The search for a better way to do a task: how far the work is moved, what a way costs, where the arm has room for it.

A way is judged by the tip's expected error over its poses. It is chosen only if it is better for nearly every arm that the points
allow, so that a guess never makes the task worse. `path.py` and `stops.py` say what else may be changed.
"""

from __future__ import annotations

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

import numpy as np

from calib.arrays import Array, Mask
from calib.design.candidates import TOUCH_M, body_points
from calib.gap.plan.collision_free_box import CLEARANCE_m, ground_m
from calib.gap.plan.plan import APPROACH_rad
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Predictor
from control.kinematics.corners import Corners
from control.model.arm import Arm, Vector3
from control.motion.waypoints import Waypoints
from control.progress import Advance
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

    def __init__(self, predictor: Predictor, seed: int = 0) -> None:
        self._predictor = predictor
        posterior = predictor.posterior
        self._off = (posterior.draws(DRAWS, seed) - posterior.mean).T

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
        rms, *parts = (
            float(np.sqrt(part.mean())) for part in (known + unknown + scatter, known, unknown, scatter)
        )
        drawn_m = np.sqrt((np.sum(drawn**2, axis=1) + scatter[:, None]).mean(axis=0))
        return Cost(rms, parts[0], parts[1], parts[2], drawn_m)


def is_surely_better(one: Cost, other: Cost) -> bool:
    """Whether `one` is expected to be better, and is for nearly every arm that the points allow."""
    return one.rms_m < other.rms_m and float(np.mean(one.drawn_m < other.drawn_m)) >= SURE


HALVINGS: Final = 2  # of the step: the error is smooth, an eighth of the area is near enough
NOWHERE: Final = (0.0, 0.0, 0.0)
Found = TypeVar("Found")


def shifted(arm: Arm, waypoints: Waypoints, shift_m: Vector3) -> tuple[Arm, Waypoints]:
    """The way-points and the arm's table, both moved."""
    points = tuple(_moved(point, shift_m) for point in waypoints.points)
    table = arm.table
    if table is not None and table.origin_m is not None and table.known_pose:
        arm = dataclasses.replace(
            arm, table=dataclasses.replace(table, origin_m=_moved(table.origin_m, shift_m))
        )
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
            seen[shift] = found = at(shift)
            if found is not None and (best is None or is_better(found, best[1])):
                best = (shift, found)
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
        found = np.full(len(q_rad), table_m(arm) >= self._lowest_table_m - ROUNDING_m)
        for distance_m, _ in Workspace.of(arm).clearances(self._corners.batch(q_rad), self._body):
            found &= distance_m >= -ROUNDING_m
        return found


@dataclass(frozen=True, slots=True)
class Freedom:
    """What may be changed: how far the work may be moved, +- along x, y, z [m], and whether the order of its points."""

    shift_m: Vector3 = NOWHERE
    any_order: bool = False
    payload_kg: float = 0.0


class HasCost(Protocol):
    """A way of doing the task."""

    @property
    def cost(self) -> Cost:
        """What it costs."""
        ...


Way = TypeVar("Way", bound=HasCost)


@dataclass(frozen=True, slots=True)
class TaskPlan(Generic[Way]):
    """The task as given, as chosen, and what each choice brought: its name and the error after it [m]."""

    plain: Way
    chosen: Way
    steps: tuple[tuple[str, float], ...]


class WaySearch(ABC, Generic[Way]):
    """What all searches have: one arm, one judge, the task as given (`_plain`) and the best place for it."""

    _plain: Way

    def __init__(
        self, arm: Arm, predictor: Predictor, waypoints: Waypoints, freedom: Freedom, advance: Advance
    ) -> None:
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

    def _is_better(self, one: Way, than: Way) -> bool:
        """Worth the change, and sure to be better than the plain one."""
        return one.cost.rms_m < WORTH * than.cost.rms_m and is_surely_better(one.cost, self._plain.cost)
