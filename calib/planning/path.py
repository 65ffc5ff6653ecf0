"""A path with the least expected tip error: its place, its branch, its way round, its speed, and how the arm comes to it.

The path as it is given, planned as `armwright run` plans it from rest, is always a candidate. Another is chosen only if it is
better for nearly every arm that the points allow, so that a guess never makes the path worse.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.planning.search import (
    NOWHERE,
    WORTH,
    Cost,
    Freedom,
    TaskPlan,
    WaySearch,
    lead_in_of,
    places_count,
    shifted,
)
from calib.trust.prediction import Path, Predictor, sampled
from control.errors import ArmError
from control.model.arm import Arm, Vector3
from control.motion.plan import PlannedPath, plan_paths
from control.motion.spline import DEFAULT_PACE_M_S
from control.motion.waypoints import Waypoints
from control.progress import Advance, silent

PACES: Final = (
    0.7,
    0.5,
    0.35,
    0.25,
)  # of the speed given: gears that inertia lifts off their flank stay on it
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


def planned_path(
    arm: Arm, predictor: Predictor, waypoints: Waypoints, freedom: Freedom, advance: Advance = silent
) -> PathPlan:
    """The best way within what may be changed. PathError if the path as given cannot be run."""
    return _Search(arm, predictor, waypoints, freedom, advance).run()


class _Search(WaySearch[WayOfPath]):
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
        for name, found in choices:
            self._advance(f"looking for a better {name}", self._share())
            better = [one for one in found(best) if self._is_better(one, best)]
            if better:
                least_m = min(one.cost.rms_m for one in better)
                best = next(one for one in better if WORTH * one.cost.rms_m <= least_m)
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
