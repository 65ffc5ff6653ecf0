"""Points at which the arm stops: the posture and the side of approach of each, their order, and where they stand.

A gear with play lies on one flank or the other, as its joint came. So each point gets the side on which the error is expected to
be least, and a lead-in that makes every joint come from there. Sides are searched joint by joint; the error is linear in them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array, Mask
from calib.design.candidates import STARTS_COUNT, joint_box, postures, spread_poses
from calib.design.planning import DETOUR_RAD, clear_ways, short_path
from calib.errors import CalibrationError
from calib.planning.search import (
    NOWHERE,
    Cost,
    Freedom,
    TaskPlan,
    WaySearch,
    lead_in_of,
    places_count,
    shifted,
)
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Predictor
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm, Vector3
from control.motion.waypoints import Waypoints
from control.progress import Advance, silent

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
        here, total = _rest(self.arm), 0.0
        for row in self.order:
            stops = [self.lead_in_rad[row]] if self.has_lead_in[row] else []
            for there in (*stops, self.poses.q_rad[row]):
                total += float(np.abs(there - here).max())
                here = there
        return total


class StopsPlan(TaskPlan[WayOfStops]):
    """Stops, as given and as chosen."""

    __slots__ = ()


def planned_stops(
    arm: Arm, predictor: Predictor, waypoints: Waypoints, freedom: Freedom, advance: Advance = silent
) -> StopsPlan:
    """The best way within what may be changed. ArmError if a point as given is out of reach."""
    if waypoints.orientations is not None:
        raise CalibrationError("--stops: takes positions, got orientations: leave out the columns qw to qz")
    return _Search(arm, predictor, waypoints, freedom, advance).run()


class _Search(WaySearch[WayOfStops]):
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
        inverse, here, q = InverseKinematics(self._arm), _rest(self._arm), []
        for point in self._given.points:
            here = np.array(inverse.nearest(point, tuple(here.tolist())))
            q.append(here)
        found = np.array(q)
        sides = np.sign(np.diff(found, axis=0, prepend=_rest(self._arm)[None]))
        return self._way(self._arm, self._given, NOWHERE, found, sides, np.zeros(len(found), dtype=bool))

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
        rows = [
            int(min(np.flatnonzero(which == point), key=lambda row: squares[row]))
            for point in range(len(waypoints.points))
        ]
        if not np.isfinite(squares[rows]).all():
            return None
        return self._way(arm, waypoints, shift_m, q[rows], sides[rows], np.ones(len(rows), dtype=bool))

    def _sides(self, arm: Arm, q: Array) -> tuple[Array, Array]:
        """The best side (p, n) of each posture (p, n), and its squared error [m^2]; infinite where no lead-in is possible."""
        best, least = np.ones(q.shape), np.full(len(q), np.inf)
        for first in (1.0, -1.0):
            sides, squares = np.full(q.shape, first), self._squares(arm, q, np.full(q.shape, first))
            for joint in list(range(q.shape[1])) * ROUNDS:
                other = sides.copy()
                other[:, joint] *= -1.0
                found = self._squares(arm, q, other)
                is_better = found < squares
                sides, squares = np.where(is_better[:, None], other, sides), np.minimum(found, squares)
            is_better = squares < least
            best, least = np.where(is_better[:, None], sides, best), np.minimum(squares, least)
        return best, least

    def _squares(self, arm: Arm, q: Array, sides: Array) -> Array:
        squares = self._judge.squares_m2(self._conditions(q, sides))
        return np.where(self._room.has_lead_in(arm, q, sides), squares, np.inf)

    def _conditions(self, q: Array, sides: Array) -> Conditions:
        return Conditions(q, sides, np.full(len(q), self._freedom.payload_kg))

    def _way(
        self, arm: Arm, waypoints: Waypoints, shift_m: Vector3, q: Array, sides: Array, led: Mask
    ) -> WayOfStops:
        poses = self._conditions(q, sides)
        return WayOfStops(arm, waypoints, shift_m, tuple(range(len(q))), poses, led, self._judge.cost(poses))

    def _ordered(self, way: WayOfStops) -> WayOfStops:
        """A short way through all points, if they may be visited in any order; lead-ins keep the sides."""
        if not (self._freedom.any_order and way.has_lead_in.all()):
            return way
        q = np.vstack((_rest(way.arm), way.poses.q_rad))
        entry = np.vstack((_rest(way.arm), way.lead_in_rad))
        ways = np.abs(entry[None, :] - q[:, None]).max(axis=2)
        ways = 0.5 * (ways + ways.T) + DETOUR_RAD * ~clear_ways(way.arm, q, ())
        order = tuple(k - 1 for k in short_path(ways)[1:])
        found = WayOfStops(way.arm, way.waypoints, way.shift_m, order, way.poses, way.has_lead_in, way.cost)
        return found if found.travel_rad < way.travel_rad else way


def _rest(arm: Arm) -> Array:
    return np.array(arm.rest.q_rad if arm.rest is not None else np.zeros(arm.joint_count))
