"""What was measured of static poses, three values a row: the tips of all, then the orientations of those that have one.

An orientation is the rotation vector e of R_measured = exp([e]) R_modelled, times `lever_m` = noise of a tip / noise of an
orientation: all rows have the noise of a tip. How the measured target sits on the last link is an unknown of the geometry.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.posed import PosedProblem
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.posterior.term import Term
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise
from control.model.arm import Arm


@dataclass(frozen=True, slots=True)
class Left:
    """What a model leaves of the tips, (m, 3) [m], and of the orientations, (m, 3) [rad], NaN where there is none."""

    tip_m: Array
    turn_rad: Array

    def times(self, tip_m: float, turn_rad: float, rows: Mask) -> float:
        """Root mean square over the poses `rows`, in standard deviations of tip and orientation; NaN: of tips alone."""
        turned = self.turn_rad[rows] / turn_rad
        all_of_them = np.concatenate(((self.tip_m[rows] / tip_m).ravel(), turned[np.isfinite(turned)]))
        return rms(all_of_them)

    def sizes(self, rows: Mask) -> dict[str, float]:
        """Root mean squares of one axis by channel."""
        turned = self.turn_rad[rows]
        seen = turned[np.isfinite(turned)]
        return {"tip_m": rms(self.tip_m[rows])} | ({"turn_rad": rms(seen)} if len(seen) else {})


def rms(values: Array) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


@dataclass(frozen=True, slots=True)
class Fit:
    """A fitted geometry: unknowns x (k,) of the problem, and how the measured target sits on the last link (3, 3) or None."""

    problem: ArmProblem
    x: Array
    target: Array | None

    @classmethod
    def to(cls, problem: ArmProblem, rows: Mask) -> Fit:
        """Fitted to the poses of a mask (m,); the geometry is near and interior, so that one search finds it."""
        some = problem.of_rows(rows)
        if not len(some.observed.turned_rows):
            return cls(problem, minimise(some, LeastSquares(), 1).x, None)
        posed = PosedProblem(some)
        x = minimise(posed, LeastSquares(), 1).x
        return cls(problem, x[: len(problem.parameters)], posed.target(x))

    @classmethod
    def nominal(cls, problem: ArmProblem, x: Array | None = None) -> Fit:
        """As the file has it, the target where the arm's orientations want it on average."""
        target = PosedProblem(problem).start if len(problem.observed.turned_rows) else None
        return cls(problem, np.zeros(len(problem.parameters)) if x is None else x, target)

    def shaped(self, arm: Arm) -> Arm:
        """An arm with this geometry and tool, on which the laws of effects act."""
        found = self.problem.solution(self.x)
        x, y, z = found.tool_m.tolist()
        return dataclasses.replace(
            arm.with_dh(found.dh), tool=dataclasses.replace(arm.tool, position_m=(x, y, z))
        )

    def at(self, x: Array) -> Fit:
        """At unknowns (K,): those of this geometry, then a turn of the target from where it is."""
        posed = self.posed()
        target = None if posed is None else posed.target(x)
        return dataclasses.replace(self, x=x[: len(self.x)], target=target)

    def left(self) -> Left:
        """The residuals."""
        turned = np.full((len(self.problem), 3), np.nan)
        if (posed := self.posed()) is not None:
            turned[posed.rows] = posed.angles_rad(self._whole(posed))
        return Left(self.problem.residuals(self.x), turned)

    def posed(self) -> PosedProblem | None:
        """The problem with its orientations, where there are any."""
        if self.target is None:
            return None
        posed = PosedProblem(self.problem)
        posed.start = self.target
        return posed

    def _whole(self, posed: PosedProblem) -> Array:
        return np.concatenate((self.x, np.zeros(len(posed.parameters) - len(self.x))))

    def measured(self, lever_m: float) -> Measured:
        """All rows around the fit; without orientations where nothing tells their noise (`lever_m` 0)."""
        count, posed = len(self.problem), self.posed() if lever_m > 0.0 else None
        tips = np.arange(count)
        by_joint, turned_by_joint = by_joints(self)
        if posed is None:
            return Measured(*self.problem.residuals_and_jacobian(self.x), tips, 0.0, by_joint)
        residual, jacobian = posed.residuals_and_jacobian(self._whole(posed))
        scale = np.ones((len(residual), 1))
        scale[count:] = lever_m / posed.lever_m
        return Measured(
            residual * scale,
            jacobian * scale[:, :, None],
            np.concatenate((tips, posed.rows)),
            lever_m,
            np.concatenate((by_joint, lever_m * turned_by_joint[posed.rows])),
        )


@dataclass(frozen=True, slots=True)
class Measured:
    """R rows around a fit: residual (R, 3) and jacobian (R, 3, K) [m], the pose of each (R,), `by_joint` (R, 3, n) [m/rad]."""

    residual: Array
    jacobian: Array
    pose: npt.NDArray[np.intp]
    lever_m: float
    by_joint: Array

    def of(self, poses: Mask) -> Mask:
        """The rows (R,) of some poses (m,)."""
        return poses[self.pose]

    def rows_of(self, moved: Array) -> Array:
        """Moves of every pose as tip and turn, (..., m, 6), as rows (..., R, 3)."""
        tips, turned = moved[..., :3], self.lever_m * moved[..., self._turned, 3:]
        return np.concatenate((tips, turned), axis=-2)

    def moved_by(self, one: Term) -> Array:
        """What a term's columns do, (c, R, 3)."""
        moved = np.zeros((one.count, len(self.pose), 3))
        if one.slope_rad is not None:
            for j in np.flatnonzero(one.slope_rad.any(axis=(0, 1))):
                moved += one.slope_rad[:, self.pose, j, None] * self.by_joint[:, :, j]
        tips = len(self.pose) - len(self._turned)
        if one.slope_m is not None:
            moved[:, :tips] += one.slope_m
        if one.turn_rad is not None:
            moved[:, tips:] += self.lever_m * one.turn_rad[:, self._turned]
        return moved

    def left(self, residual: Array) -> Left:
        """Residuals (R, 3) or (3R,) [m] as what they are of."""
        own = residual.reshape(-1, 3)
        tips = len(own) - len(self._turned)
        turned = np.full((tips, 3), np.nan)
        if self.lever_m > 0.0:
            turned[self._turned] = own[tips:] / self.lever_m
        return Left(own[:tips], turned)

    @property
    def _turned(self) -> npt.NDArray[np.intp]:
        """Poses of the rows of orientation: those behind the last pose's tip."""
        return self.pose[int(self.pose.max(initial=-1)) + 1 :]


def by_joints(fit: Fit) -> tuple[Array, Array]:
    """How tip and last link follow each joint, (m, 3, n) each. A turn's axis is how the tip follows a move along it."""
    problem, found = fit.problem, fit.problem.solution(fit.x)
    by_dh = problem.model.slopes(found.dh, problem.observed.q_rad, found.tool_m).by_dh
    theta = np.array(problem.model.theta_places)
    return np.asarray(by_dh[:, :, theta]), np.asarray(by_dh[:, :, theta - 1])
