"""The arm with a set of effects, fitted to poses: geometry, frames and effects together, by least squares."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.observations import Correction
from calib.arm_problem.problem import ArmProblem, Solution
from calib.arrays import Array, Mask, frozen
from calib.gap.finding import EffectName
from calib.gap.poses.candidate import Candidate, Parameters
from calib.gap.poses.currents import Currents
from calib.gap.poses.frame import FRAME, beyond_linear_m
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise
from calib.points.points import Points
from control.model.arm import Arm

CURVED_LOOKS = 2
KNOWN_sd = 3.0  # a coefficient that is not this far from nothing is none
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
        return self.x[: len(self.x) - sum(len(one.size) for one in self.chosen if one.moves_tip)]

    def sure(self, rows: Mask) -> Mask:
        """Those of `rows` (m,) in which every effect of the model is known to act, and how."""
        return rows & ~unsure(self.chosen, len(rows))

    def rms_m(self, rows: Mask) -> float:
        """Root mean square of one axis over the poses that are sure."""
        return float(np.sqrt(np.mean(self.residual_m[self.sure(rows)] ** 2)))


def fitted(arm: Arm, points: Points, rows: Mask, chosen: Sequence[Candidate] = ()) -> Fitted:
    """Fit geometry and effects to the poses of a mask (m,)."""
    problem = problem_of(arm, points, Choice(corrections=_corrections(chosen)))
    keep = rows & ~unsure(chosen, len(rows))
    x = minimise(problem.of_rows(keep), LeastSquares(), STARTS_COUNT).x
    for _ in range(CURVED_LOOKS if any(one.name.effect == FRAME for one in chosen) else 0):
        problem = _curved(problem, x, chosen)
        x = minimise(problem.of_rows(keep), LeastSquares(), STARTS_COUNT).x
    return Fitted(problem, x, tuple(chosen), problem.residuals(x))


def _curved(problem: ArmProblem, x: Array, chosen: Sequence[Candidate]) -> ArmProblem:
    """The problem with what a turned frame does beyond its linear column, at the unknowns x.

    Half the square of a turn of 20 mrad is 0.1 mm at arm's length: as much as the noise.
    """
    first = len(x) - sum(len(one.size) for one in chosen if one.moves_tip)
    shift = np.zeros_like(problem.references_m)
    for one in (one for one in chosen if one.moves_tip):
        at = slice(first, first + len(one.size))
        if one.name.effect == FRAME:
            shift += beyond_linear_m(one, x[at] * one.size, problem.observed.position_m)
        first = at.stop
    curved = copy.copy(problem)
    curved.observed = dataclasses.replace(problem.observed, known_shift_m=frozen(shift))
    return curved


def unsure(chosen: Sequence[Candidate], count: int) -> Mask:
    """Poses (count,) in which nobody can tell what one of the effects does."""
    found = np.zeros(count, dtype=bool)
    for one in chosen:
        if one.unsure is not None:
            found |= one.unsure
    return found


def _corrections(chosen: Sequence[Candidate]) -> tuple[Correction, ...]:
    return tuple(
        Correction(
            f"{one.name.effect}{one.name.joint or ''}.{c}",
            "",
            slope,
            np.inf,
            0.0,
            float(size),
            None if one.slope_m is None else one.slope_m[c],
        )
        for one in chosen
        if one.moves_tip
        for c, (slope, size) in enumerate(zip(one.slope_rad, one.size, strict=True))
    )


def parameters_of(fit: Fitted, rows: Mask, noise_m: float, currents: Currents | None) -> list[Parameters]:
    """The parameters of every effect with standard deviations, the geometry's uncertainty included.

    Of what the holding currents tell, from these.
    """
    held = _from_currents(fit, rows, currents)
    return [
        one.named(*held.get(one.name, coefficients))
        for one, coefficients in zip(fit.chosen, _from_tips(fit, rows, noise_m), strict=True)
    ]


def unsound(fit: Fitted, rows: Mask, noise_m: float) -> set[EffectName]:
    """Effects whose coefficients came out as no real thing has them, or not to be told from nothing."""
    found = set()
    for one, (value, covariance) in zip(fit.chosen, _from_tips(fit, rows, noise_m), strict=True):
        if one.slope_Nm is None:
            away = float(value @ np.linalg.solve(covariance, value))
            if away < KNOWN_sd**2 or not one.physical(value):
                found.add(one.name)
    return found


def _from_tips(fit: Fitted, rows: Mask, noise_m: float) -> list[tuple[Array, Array]]:
    """Coefficients (c,) and covariance (c, c) of every effect; nothing known of those that move no tip."""
    _, jacobian = fit.problem.residuals_and_jacobian(fit.x)
    base = jacobian[fit.sure(rows)].reshape(-1, len(fit.x)) / noise_m
    prior = np.array([1.0 if parameter.has_bound else 1e-6 for parameter in fit.problem.parameters])
    covariance = np.linalg.inv(base.T @ base + np.diag(prior))
    found, first = [], len(fit.geometry_x)
    for one in fit.chosen:
        scale = np.outer(one.size, one.size)
        if not one.moves_tip:
            found.append((np.zeros(len(one.size)), 1e6 * scale))
            continue
        at = slice(first, first + len(one.size))
        first = at.stop
        found.append((fit.x[at] * one.size, covariance[at, at] * scale))
    return found


def _from_currents(
    fit: Fitted, rows: Mask, currents: Currents | None
) -> dict[EffectName, tuple[Array, Array]]:
    """Coefficients and covariances of the effects that holding currents tell, without a prior."""
    told = [one for one in fit.chosen if one.slope_Nm is not None]
    if not told or currents is None:
        return {}
    seen = currents.evidence(told, rows)
    covariance = np.linalg.pinv(seen.gram)
    value = covariance @ seen.pull
    found, first = {}, 0
    for one in told:
        at = slice(first, first + len(one.size))
        found[one.name] = (value[at] * one.size, covariance[at, at] * np.outer(one.size, one.size))
        first = at.stop
    return found
