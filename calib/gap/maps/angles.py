"""Maps of joints' angles from static poses: what the tip is off by, beside the geometry, the frames and everything named."""

from __future__ import annotations

import dataclasses
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import problem_of
from calib.arm_problem.measured_maps import along
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, rms
from calib.calibration.outcome import with_base_frame
from calib.gap.effects.record import load_of
from calib.gap.finding import MapCheck
from calib.gap.maps.choose import (
    Candidate,
    DrawnMap,
    MapRows,
    MapsFound,
    Places,
    chosen,
    maps_of,
    over_angle,
    over_load,
)
from calib.gap.poses.linear import FREE_PRECISION, Fit, along_joint, by_joints
from calib.gap.poses.outcome import StaticGap
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise
from calib.points.points import Points
from control.model.arm import Arm
from control.model.maps import CorrectionMap

USUAL_rad = 1e-3  # of what a joint is off by, after everything named
FOLDS = 6
LIGHT = 0.001  # of the heaviest joint's load: a gear that carries less does not give way to it
NONE = "no map of the joints' angles helps poses that were held out: none is written"


def angle_maps(arm: Arm, gap: StaticGap) -> tuple[Arm, MapsFound]:
    """The arm with maps of its joints' angles, where these help poses that were held out, and what they do.

    `arm`: as the finding leaves it, with the maps that sets have. Its geometry and base frame are fitted anew beside the maps:
    what departs from every law has bent them.
    """
    problem = problem_of(arm, gap.points)
    x = minimise(problem.of_rows(gap.split.known), LeastSquares(), 1).x
    there = _Poses(
        gap.points, load_of(arm, gap.points, problem.observed.q_rad), by_joints(Fit(problem, x, None))[0]
    )
    measured = _measured(problem, x, gap, there, {(one.joint, one.over) for one in arm.maps})
    found = chosen(measured)
    if found is None:
        return arm, MapsFound((), (), (NONE,))
    solution = problem.solution(x + found.base)
    parts = [
        (measured.candidates[k], USUAL_rad * own) for k, own in zip(found.numbers, found.values, strict=True)
    ]
    maps = maps_of(parts)
    before, after = (gap.floor.tip_m * rms(own[measured.reports]) for own in (found.before, found.after))
    drawn = tuple(there.drawn(one, gap.floor.tip_m * found.after.reshape(-1, 3)) for one in maps)
    framed = with_base_frame(arm.with_dh(solution.dh), solution.frames[0])
    written = dataclasses.replace(framed, maps=(*arm.maps, *maps))
    return written, MapsFound(drawn, (MapCheck("tip_m", None, before, after),))


@dataclass(frozen=True, slots=True)
class _Poses:
    """Poses, gravity's torques (m, n) if the masses are known, and how tips follow joints (m, 3, n)."""

    points: Points
    load_Nm: Array | None
    by_joint: Array

    def place(self, joint: int, over: str) -> Array:
        """The variable of a table of a joint (1-based), (m,)."""
        if over == "load_Nm" and self.load_Nm is not None:
            return np.asarray(self.load_Nm[:, joint - 1])
        return np.asarray(self.points.q_rad[:, joint - 1])

    def direction(self, joint: int) -> Array:
        """Of the joint's last motion, (m,)."""
        return np.asarray(self.points.direction[:, joint - 1])

    def drawn(self, one: CorrectionMap, left_m: Array) -> DrawnMap:
        """A map over its own variable, beside what it and the tips' residuals (m, 3) say of the joint."""
        at = self.place(one.joint, one.over)
        table = along(one, at, self.direction(one.joint))
        own = along_joint(self.by_joint[:, :, one.joint - 1], left_m)
        return DrawnMap(one, at, table + own, table)


def _measured(
    problem: ArmProblem, x: Array, gap: StaticGap, there: _Poses, taken: Set[tuple[int, str]]
) -> MapRows:
    residual, jacobian = problem.residuals_and_jacobian(x)
    rows, noise = 3 * len(gap.points), gap.floor.tip_m
    candidates = tuple(one for one in _candidates(there) if (one.joint, one.over) not in taken)
    tables = []
    for one in candidates:
        columns = one.columns(there.place(one.joint, one.over), there.direction(one.joint)).toarray()
        moved = there.by_joint[:, :, one.joint - 1, None] * columns[:, None, :]
        tables.append(moved.reshape(rows, -1) * (USUAL_rad / noise))
    precision = np.array([1.0 if one.has_bound else FREE_PRECISION for one in problem.parameters])
    return MapRows(
        residual.ravel() / noise,
        -jacobian.reshape(rows, -1) / noise,
        precision,
        candidates,
        tuple(tables),
        _folds(gap),
        np.repeat(np.arange(len(gap.points)), 3),
    )


def _candidates(there: _Poses) -> tuple[Candidate, ...]:
    found: list[Candidate] = []
    heaviest_Nm = 0.0 if there.load_Nm is None else float(np.ptp(there.load_Nm, axis=0).max())
    for joint in range(1, there.points.joint_count + 1):
        own = over_angle(joint, "angle_rad", there.place(joint, "angle_rad"))
        if there.load_Nm is not None:
            load = there.place(joint, "load_Nm")
            own += over_load(joint, "angle_rad", load, LIGHT * heaviest_Nm)
        both_ways = {-1.0, 1.0} <= set(there.direction(joint).tolist())
        found += [one for one in own if both_ways or not one.is_directed]
    return tuple(found)


def _folds(gap: StaticGap) -> Places:
    """Poses that are fitted in turn, three rows each; -1: reports, -2: is not looked at."""
    folds = np.where(gap.split.report & gap.split.is_divided, -1, -2).astype(np.intp)
    known = np.flatnonzero(gap.split.known)
    folds[known] = np.arange(len(known)) % FOLDS
    return np.repeat(folds, 3)
