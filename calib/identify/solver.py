"""The minimum of a sum of distances in a box: reweighted least-squares steps, curvature corrected,
line-searched.

Each step minimises a quadratic in the box. Its Hessian first takes the curvature of rho along and across each
residual (Newton's, which ends in a handful of steps); where a line search then gains little, the reweighted
least-squares Hessian (IRLS, a majorant of rho, so a descent) takes over. The objective never rises.

What the data cannot determine stays at nominal: of all parameter sets that fit as well as the best (to
COST_OF_NEARNESS), the one nearest to nominal is wanted. Once the best is known, the null space of its
Jacobian is held at nominal and the rest refitted; if that costs more, a narrower null space is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, norms
from calib.identify.box import step_in_box
from calib.identify.determinability import null_space
from calib.identify.objective import Objective
from calib.identify.problem import Problem

COST_OF_NEARNESS = 8e-7  # share of the objective that staying near nominal may cost
RANK_TOLERANCES = (
    1e-4,
    1e-5,
    1e-6,
    1e-7,
    1e-9,
)  # what counts as undetermined, tried in this order against that cost
TRACE = 1e-8  # weight of |x|^2 / 2 per unknown, as a share of the objective, that makes every step unique
TOLERANCE = 1e-11  # a step that promises less than this share of the objective ends the search
BETTER = 1e-9  # another start replaces the first only by more than this share
BOUND_STARTS = 3
NOTHING_M = 1e-9  # residuals below this everywhere are none: a nanometre
STEP_LIMIT = 80
FIRST_ORDER_STEPS = (
    6  # residuals that stay large (bounds bind) make steps slow; then second derivatives are worth their cost
)
DIFFERENCE = 1e-5  # of a scaled unknown, for those
Stages = tuple[tuple[float, float], ...]
SMOOTH: Stages = ((0.0, TOLERANCE),)  # (smoothing as a share of the median distance, tolerance) per stage
ROUNDED: Stages = ((1e-1, 1e-3), (1e-2, 1e-5), (1e-3, 1e-8), (1e-4, 1e-8), (1e-5, 1e-9), (1e-6, TOLERANCE))
ROUGH_ERROR = 1e-4  # of the objective after the first three of them
SAME = 1e-7  # two rough ends that differ by less are the same minimum


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where a search ended: unknowns x (k,), objective there, steps taken, and whether it ended by itself."""

    x: Array
    value: float
    steps_count: int
    is_converged: bool


def minimise(problem: Problem, objective: Objective, starts_count: int = 4, seed: int = 0) -> Minimum:
    """The best of several searches: from nominal, then from random points of the box.

    Where bounds bind there are local minima, and BOUND_STARTS times as many searches are made.
    """
    k = len(problem.parameters)
    bounded = np.array([parameter.has_bound for parameter in problem.parameters])
    draw = np.random.default_rng(seed)
    rough = _search(problem, objective, np.zeros(k), _rough(objective))
    seen, best = [rough.value], _search(problem, objective, rough.x, _fine(objective), rough.steps_count)
    done = 1
    while done < starts_count * (BOUND_STARTS if np.max(np.abs(best.x[bounded]), initial=0.0) >= 1.0 else 1):
        done += 1
        rough = _search(problem, objective, draw.uniform(-0.7, 0.7, k) * bounded, _rough(objective))
        if (
            rough.value > min(seen) * (1.0 + ROUGH_ERROR)
            or np.min(np.abs(np.divide(seen, rough.value) - 1.0)) < SAME
        ):
            continue
        seen.append(rough.value)
        other = _search(problem, objective, rough.x, _fine(objective), rough.steps_count)
        if other.value < best.value * (1.0 - BETTER):
            best = other
    return _nearest_to_nominal(problem, objective, best)


def _rough(objective: Objective) -> Stages:
    return SMOOTH if objective.is_smooth else ROUNDED[:3]


def _fine(objective: Objective) -> Stages:
    return SMOOTH if objective.is_smooth else ROUNDED[3:]


def _search(problem: Problem, objective: Objective, x: Array, stages: Stages, steps: int = 0) -> Minimum:
    """One search; the kink of the objective is rounded off less and less."""
    converged = False
    for share, tolerance in stages:
        smoothing_m = _smoothing_m(problem, x, share)
        x, taken, converged = _descend(
            problem, objective, x, smoothing_m, np.zeros((len(x), len(x))), tolerance
        )
        steps += taken
    return Minimum(x, objective.value(norms(problem.residuals(x)), 0.0), steps, converged)


def _nearest_to_nominal(problem: Problem, objective: Objective, best: Minimum) -> Minimum:
    """The same fit with what the data do not determine back at nominal, as far as COST_OF_NEARNESS allows."""
    residuals, jacobian = problem.residuals_and_jacobian(best.x)
    share, tolerance = _fine(objective)[-1]
    smoothing_m = _smoothing_m(problem, best.x, share)
    stiffness = _stiffness(objective, residuals, jacobian, smoothing_m)
    tried = -1
    for rank_tolerance in RANK_TOLERANCES:
        null = null_space(jacobian, problem.parameters, rank_tolerance)
        if null.shape[1] == tried:
            continue
        tried = null.shape[1]
        anchor = stiffness * null @ null.T
        x, taken, converged = _descend(problem, objective, best.x, smoothing_m, anchor, tolerance)
        value = objective.value(norms(problem.residuals(x)), 0.0)
        nothing = objective.value(np.full(len(residuals), NOTHING_M), 0.0)
        if value <= max(best.value * (1.0 + COST_OF_NEARNESS), nothing):
            return Minimum(x, value, best.steps_count + taken, converged)
    return best


def _stiffness(objective: Objective, residuals: Array, jacobian: Array, smoothing_m: float) -> float:
    """Curvature of the objective along a typical well determined unknown."""
    across, _ = objective.weights(norms(residuals), smoothing_m)
    return float(np.einsum("i,ijk,ijk->", across, jacobian, jacobian) / jacobian.shape[2])


def _smoothing_m(problem: Problem, x: Array, share: float) -> float:
    """A share of the median distance; never quite 0 where there is a kink."""
    return max(share * float(np.median(norms(problem.residuals(x)))), 1e-13) if share else 0.0


def _descend(
    problem: Problem, objective: Objective, x: Array, smoothing_m: float, anchor: Array, tolerance: float
) -> tuple[Array, int, bool]:
    """Steps at one smoothing until a step promises too little: (x, steps, converged).

    `anchor` (k, k): x' anchor x / 2 is added, which holds some combinations of unknowns at nominal.
    """
    for taken in range(STEP_LIMIT):
        residuals, jacobian = problem.residuals_and_jacobian(x)
        if np.max(norms(residuals)) < NOTHING_M:
            return x, taken, True
        here = _Quadratic.at(objective, residuals, jacobian, x, smoothing_m, anchor)
        if taken >= FIRST_ORDER_STEPS:
            here = here.with_model_curvature(
                _model_curvature(problem, objective, x, residuals, jacobian, smoothing_m)
            )
        x_next, promise = _step(problem, objective, here, x, smoothing_m)
        if promise <= tolerance * here.value or np.array_equal(x_next, x):
            return x_next, taken, True
        x = x_next
    return x, STEP_LIMIT, False


@dataclass(frozen=True, slots=True)
class _Quadratic:
    """Objective plus x' held x / 2, around x: both Hessians, gradient and value."""

    newton: Array
    majorant: Array
    gradient: Array
    value: float
    held: Array

    @classmethod
    def at(
        cls,
        objective: Objective,
        residuals: Array,
        jacobian: Array,
        x: Array,
        smoothing_m: float,
        anchor: Array,
    ) -> _Quadratic:
        distances = norms(residuals)
        across, along = objective.weights(distances, smoothing_m)
        radial = np.einsum("ij,ijk->ik", residuals / np.maximum(distances, 1e-300)[:, None], jacobian)
        rows = jacobian.reshape(-1, jacobian.shape[2])
        majorant = rows.T @ (np.repeat(across, 3)[:, None] * rows)
        newton = majorant + radial.T @ ((along - across)[:, None] * radial)
        value = objective.value(distances, smoothing_m)
        trace = TRACE * value / len(x) + 1e-15 * float(np.trace(majorant))
        held = anchor + trace * np.eye(len(x))
        gradient = radial.T @ (across * distances) + held @ x
        return cls(newton + held, majorant + held, gradient, value + 0.5 * float(x @ held @ x), held)

    def with_model_curvature(self, curvature: Array) -> _Quadratic:
        """With the second derivatives of the kinematics in the Newton Hessian, positive definite again."""
        values, vectors = np.linalg.eigh(self.newton + curvature)
        floor = 1e-12 * float(np.max(np.abs(values)))
        newton = (vectors * np.maximum(np.abs(values), floor)) @ vectors.T
        return _Quadratic(newton, self.majorant, self.gradient, self.value, self.held)


def _model_curvature(
    problem: Problem, objective: Objective, x: Array, residuals: Array, jacobian: Array, smoothing_m: float
) -> Array:
    """Sum of rho'(s)/s residual . d2 residual / dx2, (k, k), from differences of the analytic Jacobian."""
    across, _ = objective.weights(norms(residuals), smoothing_m)
    pull = across[:, None] * residuals
    columns = [
        np.einsum("ij,ijk->k", pull, problem.residuals_and_jacobian(x + DIFFERENCE * unit)[1] - jacobian)
        for unit in np.eye(len(x))
    ]
    curvature = np.array(columns) / DIFFERENCE
    return np.asarray(0.5 * (curvature + curvature.T))


def _step(
    problem: Problem, objective: Objective, here: _Quadratic, x: Array, smoothing_m: float
) -> tuple[Array, float]:
    """The next x and what the quadratic promised; x itself where neither Hessian leads down."""

    def merit(at: Array) -> float:
        return objective.value(norms(problem.residuals(at)), smoothing_m) + 0.5 * float(at @ (here.held @ at))

    limits = np.array([parameter.limit for parameter in problem.parameters])
    promise = 0.0
    best, lowest = x, here.value
    for hessian in (here.newton, here.majorant):
        d = step_in_box(hessian, here.gradient, -limits - x, limits - x)
        slope = float(here.gradient @ d)
        promise = max(promise, -0.5 * slope)
        share = 1.0
        while share > 1e-4:
            candidate = np.clip(x + share * d, -limits, limits)
            there = merit(candidate)
            if there <= here.value + 1e-4 * share * slope:
                break
            share *= 0.4
        if there < lowest:
            best, lowest = candidate, there
        if share > 0.3:
            break
    return best, promise
