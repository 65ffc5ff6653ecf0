"""The minimum of an objective in the box of the bounds: several searches, the best of them, and of all that fit as well the
nearest to nominal.

What the data cannot determine stays at nominal: of all parameter sets that fit as well as the best, the one nearest to
nominal is wanted. Once the best is known, the null space of its Jacobian is held at nominal and the rest refitted; if that
costs more than COST_OF_NEARNESS, a narrower null space is held. An identification allows more (`Equal` "by noise"): what the
held unknowns would gain by following noise alone, so that no combination that the points leave open ends at a bound for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from calib.arm_problem.problem import Problem
from calib.arrays import Array, norms
from calib.errors import CalibrationError
from calib.identify.budget import Accuracy, WithDistances
from calib.identify.descent import NOTHING_M, End, Goal, descend
from calib.identify.determinability import null_space
from calib.identify.objective import Huber, LeastSquares, Objective, SumOfDistances
from calib.identify.sample import Sample

COST_OF_NEARNESS = 8e-7  # share of the objective that staying near nominal may cost
# What counts as undetermined, tried in this order against that cost.
RANK_TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-9)
BETTER = 1e-9  # another start replaces the first only by more than this share
# Times the starts asked for: where bounds bind, where several minima have shown, where many bounds bind.
BOUND_STARTS, SEVERAL_STARTS, MANY_STARTS = 2, 6, 12
MANY_BOUND = 4  # parameters at their bounds: geometry that is off by more than they allow
ROUGH_ERROR = 3e-3  # of the objective where a rough search ends, and of a sample of poses
SAME = 0.003  # rough ends with the same bounds whose residuals differ by less than this share are the same minimum
SAME_END = 1e-6  # finished ends on some of the poses that differ by less are the same minimum
DIFFERENT = 1e-7  # objectives that differ by less are the same
POSES_PER_UNKNOWN = 6  # enough of them to tell which starts are worth going on with
FIT = Goal(1.0, 1.0, 1e-2, is_bent=False)  # least squares, from which the other objectives set out
ROUGH = Goal(1e-1, 1e-2, 1e-4, step_limit=25)
FINE = Goal(1e-2, 1e-7, 1e-9)
BISECTIONS, LIMIT_REACHED = 60, 1e-7  # of lambda; share of the wanted accuracy that may be left unused
NULL_POSES = 5000
REACH = 0.7  # of the box, from where starts are drawn
Equal = Literal[
    "exactly", "by noise"
]  # how nearly two fits must agree so that the nearer one to nominal is taken


@dataclass(frozen=True, slots=True)
class Minimum:
    """Where the search ended: unknowns x (k,), objective there, steps taken, and whether it ended by itself.

    `objective` is the one asked for, a threshold settled; `value` is its own, whatever else was asked for. `accuracy` is None
    where none was.
    """

    x: Array
    value: float
    steps_count: int
    is_converged: bool
    objective: Objective
    accuracy: Accuracy | None = None

    @property
    def constraint_met(self) -> bool:
        """Whether the mean distance is what was asked for, if anything was."""
        return self.accuracy is None or self.accuracy.is_met


def minimise(
    problem: Problem,
    objective: Objective,
    starts_count: int = 4,
    seed: int = 0,
    accuracy_limit_m: float | None = None,
    equal: Equal = "exactly",
) -> Minimum:
    """The best of several searches: from nominal, then from random points of the box.

    Where bounds bind there are local minima, and BOUND_STARTS times as many searches are made; SEVERAL_STARTS times if
    several are found, MANY_STARTS times where MANY_BOUND bind. With `accuracy_limit_m` the mean distance must not be
    larger; if no parameters within the bounds reach that, the minimum is that of the sum of distances, whatever the
    objective, and says so. CalibrationError for a limit that makes no sense.
    """
    if accuracy_limit_m is not None and not 0.0 < accuracy_limit_m < np.inf:
        raise CalibrationError(f"average accuracy: expected a positive length in m, got {accuracy_limit_m}")
    wanted = settled(problem, objective, seed)
    best = best_of_starts(problem, wanted, starts_count, seed)
    found = _nearest_to_nominal(problem, wanted, best, equal)
    if accuracy_limit_m is None:
        return found
    return _constrained(problem, found, accuracy_limit_m, starts_count, seed)


def settled(problem: Problem, objective: Objective, seed: int = 0) -> Objective:
    """The objective itself, or Huber's with the threshold that the noise asks for."""
    if not isinstance(objective, Huber) or objective.threshold_m is not None:
        return objective
    robust = best_of_starts(problem, SumOfDistances(), 1, seed)
    return objective.settled_on(Sample(problem, SumOfDistances()).residuals(robust.x))


def _constrained(problem: Problem, found: Minimum, limit_m: float, starts_count: int, seed: int) -> Minimum:
    """The minimum subject to a mean distance of at most limit_m."""
    mean_m = _mean_m(problem, found.x)
    is_distance = isinstance(found.objective, SumOfDistances)
    if mean_m <= limit_m or is_distance:
        return replace(found, accuracy=Accuracy(limit_m, mean_m, mean_m if is_distance else None))
    closest = minimise(problem, SumOfDistances(), starts_count, seed)
    least_m = _mean_m(problem, closest.x)
    if least_m >= limit_m:
        return _instead(problem, found, closest.x, Accuracy(limit_m, least_m, least_m))
    x, multiplier = _multiplied(problem, found, closest.x, limit_m)
    return _instead(problem, found, x, Accuracy(limit_m, _mean_m(problem, x), least_m, multiplier))


def _multiplied(problem: Problem, found: Minimum, closest: Array, limit_m: float) -> tuple[Array, float]:
    """The minimum of objective + lambda E2 whose mean distance is limit_m, and the lambda: bisection of its logarithm.

    Of the two ends of the interval, which close in, the one that meets the constraint is given.
    """
    per_distance = found.value / (len(problem) * limit_m)
    low, high, best, best_multiplier = 1e-9, 1e9, closest, np.inf
    start = found.x
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        objective = WithDistances(found.objective, middle * per_distance)
        sample = Sample(problem, objective)
        start = descend(sample, start, _fine(sample)).x
        mean_m = _mean_m(problem, start)
        if mean_m > limit_m:
            low = middle
            continue
        high, best, best_multiplier = middle, start, float(middle * per_distance)
        if mean_m > limit_m * (1.0 - LIMIT_REACHED):
            break
    return best, best_multiplier


def _instead(problem: Problem, found: Minimum, x: Array, accuracy: Accuracy) -> Minimum:
    """Another place, judged by the same objective."""
    return replace(found, x=x, value=Sample(problem, found.objective).value(x), accuracy=accuracy)


def _mean_m(problem: Problem, x: Array) -> float:
    """The mean distance."""
    return float(np.mean(norms(Sample(problem, SumOfDistances()).residuals(x))))


def best_of_starts(problem: Problem, objective: Objective, starts_count: int, seed: int) -> Minimum:
    """The best of all searches, wherever the unknowns are that do not matter."""
    k = len(problem.parameters)
    bounded = np.array([parameter.has_bound for parameter in problem.parameters])
    draw = np.random.default_rng(seed)
    few = Sample(problem, objective, max(1, len(problem) // (POSES_PER_UNKNOWN * k)))
    ends = _Ends(few)
    rough = _rough(few, np.zeros(k))
    ends.is_new(rough.x)
    if few.stride > 1:
        ends.is_lead(descend(few, rough.x, _fine(few)).x)
    best = _finished(problem, objective, rough)
    limit = starts_count * _times(int(np.sum(np.abs(best.x[bounded]) >= 1.0)))
    done = 1
    while done < limit:
        done += 1
        rough = _rough(few, draw.uniform(-REACH, REACH, k) * bounded)
        if not ends.is_new(rough.x):
            continue
        if few.stride > 1:
            rough = descend(few, rough.x, _fine(few))
            if not ends.is_lead(rough.x):
                continue
        other = _finished(problem, objective, rough)
        if abs(other.value - best.value) > DIFFERENT * best.value:
            limit = max(limit, starts_count * SEVERAL_STARTS)
        if other.value < best.value * (1.0 - BETTER):
            best = other
    return best


def _times(at_bound_count: int) -> int:
    """How many times the starts that were asked for so many parameters at their bounds want."""
    if at_bound_count >= MANY_BOUND:
        return MANY_STARTS
    return BOUND_STARTS if at_bound_count else 1


class _Ends:
    """Ends of rough searches, to tell a new one from those that have been there."""

    def __init__(self, sample: Sample) -> None:
        self._sample = sample
        self._limits = np.array([parameter.limit for parameter in sample.problem.parameters])
        self._seen: list[tuple[Array, Array]] = []
        self._finished: list[float] = []
        self._lowest = np.inf

    def is_lead(self, x: Array) -> bool:
        """Whether a search that ended here, on these poses, ended in another minimum than those before."""
        value = self._sample.value(x)
        is_known = any(abs(value - other) <= SAME_END * other for other in self._finished)
        self._finished.append(value)
        return not is_known

    def is_new(self, x: Array) -> bool:
        """Whether a search that got here may end lower than the others: low enough, other bounds or other residuals."""
        residuals = self._sample.residuals(x)
        value = self._sample.value_of(residuals, 0.0)
        at_bound = np.sign(x) * (np.abs(x) >= self._limits)
        near = SAME * float(np.mean(norms(residuals)))
        is_new = value <= self._lowest * (1.0 + ROUGH_ERROR) and not any(
            np.array_equal(at_bound, bounds) and float(np.mean(norms(residuals - other))) < near
            for bounds, other in self._seen
        )
        if is_new:
            self._seen.append((at_bound, residuals))
        self._lowest = min(self._lowest, value)
        return is_new


def _rough(sample: Sample, start: Array) -> End:
    """A search that ends as soon as it is clear where it leads."""
    if isinstance(sample.objective, LeastSquares):
        return descend(sample, start, ROUGH)
    fitted = descend(replace(sample, objective=LeastSquares()), start, FIT)
    found = descend(sample, fitted.x, ROUGH)
    return replace(found, steps_count=fitted.steps_count + found.steps_count)


def _finished(problem: Problem, objective: Objective, rough: End) -> Minimum:
    """The same search to its end, on all poses."""
    sample = Sample(problem, objective)
    end = descend(sample, rough.x, _fine(sample))
    return Minimum(
        end.x, sample.value(end.x), rough.steps_count + end.steps_count, end.is_converged, objective
    )


def _fine(sample: Sample) -> Goal:
    """The goal of a last search. Some k distances are zero at a minimum, each of them a smoothing too long."""
    share = len(sample.problem) / sample.stride / len(sample.problem.parameters)
    return replace(FINE, last_smoothing=FINE.last_smoothing * max(1.0, share))


def _nearest_to_nominal(problem: Problem, objective: Objective, best: Minimum, equal: Equal) -> Minimum:
    """The same fit with what the data do not determine back at nominal, as far as the allowed cost lets it."""
    # Of very many poses some tell the null space; what they overlook shows in the cost, which is that on all.
    stride = max(1, len(problem) // NULL_POSES)
    residuals, jacobian = problem.residuals_and_jacobian(best.x, slice(None, None, stride))
    sample = Sample(problem, objective)
    goal = _fine(sample)
    stiffness = stride * _stiffness(objective, residuals, jacobian)
    nothing = objective.value(objective.distances(np.full((len(problem), 3), NOTHING_M)), 0.0)
    tried = -1
    # Turns of arm and board together cost nothing but where the objective has axes of its own (absolute coordinates).
    for derivative, rank_tolerance in product((problem.sensitivity(best.x), jacobian), RANK_TOLERANCES):
        null = null_space(derivative, problem.parameters, rank_tolerance)
        if null.shape[1] == tried:
            continue
        tried = null.shape[1]
        end = descend(sample, best.x, replace(goal, anchor=stiffness * null @ null.T))
        value = sample.value(end.x)
        cost = COST_OF_NEARNESS if equal == "exactly" else _gain_by_noise(problem, tried)
        if value <= max(best.value * (1.0 + cost), nothing):
            return Minimum(end.x, value, best.steps_count + end.steps_count, end.is_converged, objective)
    return best


def _gain_by_noise(problem: Problem, unknowns_count: int) -> float:
    """Share of the objective that so many unknowns take off it in the mean by following noise.

    Each takes 1 / freedom off a sum of squares, and half of that off a sum of distances: the lesser counts.
    """
    freedom = 3 * len(problem) - len(problem.parameters)
    return max(COST_OF_NEARNESS, unknowns_count / (2.0 * freedom)) if freedom > 0 else COST_OF_NEARNESS


def _stiffness(objective: Objective, residuals: Array, jacobian: Array) -> float:
    """Curvature of the objective along a typical well determined unknown."""
    across, _ = objective.weights(np.maximum(norms(residuals), float(np.mean(norms(residuals)))), 0.0)
    return float(np.einsum("i,ijk,ijk->", across, jacobian, jacobian) / jacobian.shape[2])
