"""The arm with a set of effects, fitted to poses: geometry, frames and effects together, by least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.static.candidates import Candidate, Parameters
from calib.identify.assembly import Choice, problem_of
from calib.identify.objective import LeastSquares
from calib.identify.observations import Correction
from calib.identify.problem import ArmProblem, Solution
from calib.identify.solver import minimise
from calib.points import Points
from control.model.arm import Arm

STARTS_COUNT = 1  # the geometry is near, and interior: one search finds it


@dataclass(frozen=True, slots=True)
class Fitted:
    """A model fitted to the poses `rows` of its problem, and what it leaves at all of them."""

    problem: ArmProblem
    x: Array
    chosen: tuple[Candidate, ...]
    residual_m: Array

    @property
    def solution(self) -> Solution:
        """Geometry and frames."""
        return self.problem.solution(self.x)

    @property
    def geometry_x(self) -> Array:
        """The unknowns without those of the effects."""
        return self.x[: len(self.x) - sum(len(one.size) for one in self.chosen)]

    def sure(self, rows: Mask) -> Mask:
        """Those of `rows` (m,) in which every effect of the model is known to act, and how."""
        return rows & ~unsure(self.chosen, len(rows))

    def rms_m(self, rows: Mask) -> float:
        """Root mean square of one axis over the poses that are sure."""
        return float(np.sqrt(np.mean(self.residual_m[self.sure(rows)] ** 2)))


def fitted(arm: Arm, points: Points, rows: Mask, chosen: Sequence[Candidate] = ()) -> Fitted:
    """Fit geometry and effects to the poses of a mask (m,)."""
    problem = problem_of(arm, points, Choice(corrections=_corrections(chosen)))
    x = minimise(problem.of_rows(rows & ~unsure(chosen, len(rows))), LeastSquares(), STARTS_COUNT).x
    return Fitted(problem, x, tuple(chosen), problem.residuals(x))


def unsure(chosen: Sequence[Candidate], count: int) -> Mask:
    """Poses (count,) in which nobody can tell what one of the effects does."""
    found = np.zeros(count, dtype=bool)
    for one in chosen:
        if one.unsure is not None:
            found |= one.unsure
    return found


def _corrections(chosen: Sequence[Candidate]) -> tuple[Correction, ...]:
    return tuple(
        Correction(f"{one.name.effect}{one.name.joint or ''}.{c}", "", slope, np.inf, 0.0, float(size))
        for one in chosen
        for c, (slope, size) in enumerate(zip(one.slope_rad, one.size, strict=True))
    )


def parameters_of(fit: Fitted, rows: Mask, noise_m: float) -> list[Parameters]:
    """The parameters of every effect with standard deviations, the geometry's uncertainty included."""
    _, jacobian = fit.problem.residuals_and_jacobian(fit.x)
    base = jacobian[fit.sure(rows)].reshape(-1, len(fit.x)) / noise_m
    prior = np.array([1.0 if parameter.has_bound else 1e-6 for parameter in fit.problem.parameters])
    covariance = np.linalg.inv(base.T @ base + np.diag(prior))
    found, first = [], len(fit.geometry_x)
    for one in fit.chosen:
        at = slice(first, first + len(one.size))
        found.append(one.parameters(fit.x[at] * one.size, covariance[at, at] * np.outer(one.size, one.size)))
        first = at.stop
    return found
