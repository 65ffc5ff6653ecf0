"""The minimum of an objective within bounds: several searches, and of equally good solutions the nearest to nominal.

What the data do not determine stays at nominal. After the best search, the null space of its Jacobian is fixed at nominal
and the rest refitted; if that costs more than COST_OF_NEARNESS, a narrower null space is fixed. An identification allows
more (`Equal` "by noise"): what the fixed unknowns would gain by fitting noise. It begins with all combinations of which a
change by the bound is less than the noise: none of them ends at a bound because of noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from calib.arm_problem.arm_model import prior_sd
from calib.arm_problem.expansion import Problem
from calib.arm_problem.posed import WeightedProblem
from calib.arrays import Array, norms
from calib.errors import CalibrationError
from calib.identify.descent import NOTHING_M, PoseSample, Prior, SearchEnd, Termination, descend
from calib.identify.determinability import Sensitivity, determinability, null_space
from calib.identify.objective import Huber, LeastSquares, NoiseScale, Objective, SumOfDistances, leverages, noise_scale
from calib.settling import FITS_MOST, Settling

# The constraint E <= k a of SpringerPlus 5:1771, eq. (4): the mean distance over the k points is at most a.
#
# The sum of distances E2 is the paper's E; minimising it, the constraint is a check. Another objective rho is minimised
# subject to it by a multiplier: E2 at the minimum of rho + lambda E2 decreases with lambda, and the lambda
# for which E2 = k a is searched.


@dataclass(frozen=True, slots=True)
class Accuracy:
    """The requested average accuracy a, the one reached, and the smallest possible one if it was searched.

    `multiplier` is the lambda, 0 where the constraint does not bind.
    """

    limit_m: float
    mean_m: float
    least_m: float | None = None
    multiplier: float = 0.0

    @property
    def is_met(self) -> bool:
        """Whether E <= k a, to rounding."""
        return self.mean_m <= self.limit_m * (1.0 + 1e-9)

    def in_words(self) -> str:
        """A sentence for the operator."""
        wanted, reached = f"{1e3 * self.limit_m:.4g} mm", f"{1e3 * self.mean_m:.4g} mm"
        if not self.is_met:
            return (
                f"The requested average accuracy of {wanted} cannot be met with these bounds. The result has the smallest"
                f" possible mean distance, {reached}. Request less, widen the bounds, or look for effects other than geometry."
            )
        how = ", at some cost to the objective" if self.multiplier else ""
        return f"The requested average accuracy of {wanted} is met{how}: the mean distance is {reached}."


@dataclass(frozen=True, slots=True)
class WithDistances:
    """`first` plus `multiplier` times the sum of distances; the dual has three columns for each of the two."""

    first: Objective
    multiplier: float
    name: str = "an objective and a share of the sum of distances"
    is_smooth: bool = False

    @property
    def _second(self) -> SumOfDistances:
        return SumOfDistances()

    def distances(self, residuals: Array) -> Array:
        """Those of the first, then the lengths."""
        return np.concatenate((self.first.distances(residuals), self._second.distances(residuals)))

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """The sum of both."""
        of_first, lengths = self._split(distances_m)
        return self.first.value(of_first, smoothing_m) + self.multiplier * self._second.value(lengths, smoothing_m)

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """Of lengths, (m,)."""
        across, along = self.first.weights(distances_m, smoothing_m)
        more_across, more_along = self._second.weights(distances_m, smoothing_m)
        return across + self.multiplier * more_across, along + self.multiplier * more_along

    def expansion(self, residuals: Array, smoothing_m: float, dual: Array | None) -> tuple[Array, Array | None]:
        """The sums of both."""
        one, two = (None, None) if dual is None else (dual[:, :3], dual[:, 3:])
        pull, bend = self.first.expansion(residuals, smoothing_m, one)
        more_pull, more_bend = self._second.expansion(residuals, smoothing_m, two)
        return pull + self.multiplier * more_pull, _matrices(bend, len(residuals)) + self.multiplier * _matrices(
            more_bend, len(residuals)
        )

    def next_dual(self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None) -> Array | None:
        """Both duals, side by side; zeros for an objective without kinks."""
        one, two = (None, None) if dual is None else (dual[:, :3], dual[:, 3:])
        first = self.first.next_dual(residuals, moved, smoothing_m, one)
        second = self._second.next_dual(residuals, moved, smoothing_m, two)
        return np.hstack([np.zeros_like(residuals) if part is None else part for part in (first, second)])

    def _split(self, distances_m: Array) -> tuple[Array, Array]:
        """Split into the parts of the first and the second."""
        a_pose = len(self.first.distances(np.zeros((1, 3))))
        lengths_count = len(distances_m) // (a_pose + 1)
        return distances_m[:-lengths_count], distances_m[-lengths_count:]


def _matrices(bend: Array | None, count: int) -> Array:
    """Any form of a second derivative as matrices, (3, 3, m)."""
    if bend is not None and bend.ndim == 3:
        return bend
    whole = np.zeros((3, 3, count))
    whole[[0, 1, 2], [0, 1, 2]] = 1.0 if bend is None else bend
    return whole


COST_OF_NEARNESS = 8e-7  # share of the objective that staying near nominal may cost
# What counts as undetermined, tried in this order against that cost.
RANK_TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-9)
STEEPEST = 0.5  # slope of the noise that is left over the one that was assumed: a step is at most twice as long as their distance
SETTLED = 0.02  # of the noise's variance: a weight that is off by more moves a deviation by a noticeable share
BETTER = 1e-9  # another start replaces the first only by more than this share
# Factors on the number of starts: with active bounds, with several minima, with many active bounds.
BOUND_STARTS, SEVERAL_STARTS, MANY_STARTS = 2, 6, 12
MANY_BOUND = 4  # parameters at their bounds: the geometry deviates by more than the bounds
ROUGH_ERROR = 3e-3  # tolerance of a rough search, and of one on a sample of poses
SAME = 0.003  # rough results with the same active bounds and a smaller difference of residuals are the same minimum
SAME_END = 1e-6  # finished results on a sample with a smaller difference are the same minimum
DIFFERENT = 1e-7  # relative difference below which objectives are equal
POSES_PER_UNKNOWN = 6  # enough poses to select promising starts
FIT = Termination(1.0, 1.0, 1e-2, is_bent=False)  # least squares, from which the other objectives start
ROUGH = Termination(1e-1, 1e-2, 1e-4, step_limit=25)
FINE = Termination(1e-2, 1e-7, 1e-9)
TO_NOISE = Termination(1e-2, 1e-2, 1e-4)  # for the scatter that a fit leaves, of which a hundredth does not count
BISECTIONS, LIMIT_REACHED = 60, 1e-7  # of lambda; unused share of the requested accuracy
NULL_POSES = 5000
REACH = 0.7  # of the box, from which starts are drawn
Equal = Literal["exactly", "by noise"]  # how closely two fits must agree to prefer the one nearer to nominal


@dataclass(frozen=True, slots=True)
class Minimum:
    """Result of the search: unknowns x (k,), objective, and whether it converged.

    `objective` is the requested one with its threshold; `value` is its value and that of the `prior`, without a constraint.
    `accuracy` is None if none was requested.
    """

    x: Array
    value: float
    is_converged: bool
    objective: Objective
    prior: Prior | None = None
    accuracy: Accuracy | None = None

    @property
    def constraint_met(self) -> bool:
        """Whether the mean distance meets the request, if any."""
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

    With active bounds there are local minima, and BOUND_STARTS times as many searches are made; SEVERAL_STARTS times if
    several are found, MANY_STARTS times if MANY_BOUND are active. With `accuracy_limit_m` the mean distance must not be
    larger; if no parameters within the bounds reach that, the minimum is that of the sum of distances, whatever the
    objective. CalibrationError for an invalid limit.
    """
    if accuracy_limit_m is not None and not 0.0 < accuracy_limit_m < np.inf:
        raise CalibrationError(f"average accuracy: expected a positive length in m, got {accuracy_limit_m}")
    wanted = settled(problem, objective, seed)
    prior = prior_of(problem, wanted)
    best = best_of_starts(problem, wanted, starts_count, seed, prior)
    minimum = _nearest_to_nominal(PoseSample(problem, wanted, prior=prior), best, equal)
    if accuracy_limit_m is None:
        return minimum
    return _constrained(problem, minimum, accuracy_limit_m, starts_count, seed)


def prior_of(problem: Problem, objective: Objective) -> Prior | None:
    """How exactly the arm's parts are made, against the noise that it leaves; None where nothing is known.

    Of normal errors of variance v about the fit, and of deviations of standard deviation s, the most probable deviations have
    J'J / v + 1 / s^2 as the Hessian. The objective's is curvature J'J, so that 1 / s^2 has the weight curvature v. What the model
    lacks, such as play, is no noise of the measurement, but scatters as one: v is that of the residuals, as the fit leaves them.
    It is found from above, beginning at nominal, and from below, beginning where the points alone lead: parts that are worse than
    their tolerances say look like noise from above, exact fits of few points like exact points from below. The likelier stands.
    """
    sd = prior_sd(problem.parameters, math.inf, math.inf)
    if not np.isfinite(sd).any():
        return None
    nominal = np.zeros(len(sd))
    made = Prior(np.array([parameter.made / parameter.scale for parameter in problem.parameters]), np.zeros(len(sd)), 1.0)
    sample = PoseSample(problem, objective)
    alone = descend(sample, nominal, replace(TO_NOISE, first_smoothing=1.0)).x
    all_noise = noise_scale(objective, problem.residuals(nominal), np.zeros((len(problem), 3, 3)))
    ends = [
        _against_noise(sample, made, sd, x, noise) for x, noise in ((nominal, all_noise), (alone, _noise_left(sample, alone)[0]))
    ]
    return max(ends, key=lambda end: end[1])[0]


def _against_noise(sample: PoseSample, prior: Prior, sd: Array, x: Array, noise: NoiseScale) -> tuple[Prior, float]:
    """The prior against the noise that its fit leaves, found by steps from unknowns `x` (k,) and a first noise on, and ln of its
    evidence: minus infinity where the points are too few to tell a noise.

    Where more noise is assumed, fewer deviations follow single points, and the noise that is left may be less: to take it as the
    next one goes to and fro. So the steps are the secant method's, in ln of the variance.
    """
    settling, evidence = Settling(FITS_MOST), -math.inf
    assumed = left = math.nan
    slope, variance_m2 = 0.0, noise.variance_m2
    while variance_m2 > 0.0 and settling.goes_on:
        prior = replace(prior, square_m2=variance_m2 / sd**2, curvature=noise.curvature)
        sample = replace(sample, prior=prior)
        x = descend(sample, x, TO_NOISE).x
        noise, evidence = _noise_left(sample, x)
        if not noise.variance_m2 > 0.0:
            break
        before, assumed, left_before, left = assumed, math.log(variance_m2), left, math.log(noise.variance_m2)
        if assumed != before and math.isfinite(before):
            slope = min((left - left_before) / (assumed - before), STEEPEST)
        settling.takes(abs(left - assumed), SETTLED)
        variance_m2 = math.exp(assumed + (left - assumed) / (1.0 - slope))
    return prior, evidence


def _noise_left(sample: PoseSample, x: Array) -> tuple[NoiseScale, float]:
    """The noise of a fit, and ln of the evidence of normal noise of its size: over all unknowns, by Laplace's method, without
    what is the same for every noise.
    """
    problem, prior, residuals = sample.problem, sample.prior, sample.residuals(x)
    sensitivity = Sensitivity.at(problem, x)
    spread = determinability(_known(sensitivity.compact, prior), problem.parameters).spread
    shares = np.concatenate([leverages(part, spread) for _, part in sensitivity.blocks()])
    noise = noise_scale(sample.objective, residuals, shares)
    square, count = float(np.sum(residuals**2)), residuals.size
    variance = square / max(count - float(np.einsum("ijj->", shares)), 1.0)
    if not variance > 0.0:
        return noise, -math.inf
    precision = prior_sd(problem.parameters) ** -2.0
    flat = sensitivity.compact.reshape(-1, len(x))
    volume = np.linalg.slogdet(flat.T @ flat / variance + np.diag(precision))[1]
    off = x if prior is None else x - prior.mean
    return noise, -0.5 * float(count * math.log(variance) + square / variance + precision @ off**2 + volume)


def settled(problem: Problem, objective: Objective, seed: int = 0) -> Objective:
    """The objective, or Huber's with a threshold from the noise."""
    if not isinstance(objective, Huber) or objective.threshold_m is not None:
        return objective
    robust = best_of_starts(problem, SumOfDistances(), 1, seed)
    return objective.settled_on(PoseSample(problem, SumOfDistances()).residuals(robust.x))


def _constrained(problem: Problem, minimum: Minimum, limit_m: float, starts_count: int, seed: int) -> Minimum:
    """The minimum subject to a mean distance of at most limit_m."""
    mean_m = _mean_m(problem, minimum.x)
    is_distance = isinstance(minimum.objective, SumOfDistances) and minimum.prior is None
    if mean_m <= limit_m or is_distance:
        return replace(minimum, accuracy=Accuracy(limit_m, mean_m, mean_m if is_distance else None))
    closest = minimise(problem, SumOfDistances(), starts_count, seed)
    least_m = _mean_m(problem, closest.x)
    if least_m >= limit_m:
        return _instead(problem, minimum, closest.x, Accuracy(limit_m, least_m, least_m))
    x, multiplier = _multiplied(problem, minimum, closest.x, limit_m)
    return _instead(problem, minimum, x, Accuracy(limit_m, _mean_m(problem, x), least_m, multiplier))


def _multiplied(problem: Problem, minimum: Minimum, closest: Array, limit_m: float) -> tuple[Array, float]:
    """The minimum of objective + lambda E2 whose mean distance is limit_m, and the lambda: bisection of its logarithm.

    Returns the end of the interval that meets the constraint.
    """
    per_distance = minimum.value / (len(problem) * limit_m)
    low, high, best, best_multiplier = 1e-9, 1e9, closest, np.inf
    start = minimum.x
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        objective = WithDistances(minimum.objective, middle * per_distance)
        sample = PoseSample(problem, objective, prior=minimum.prior)
        start = descend(sample, start, _fine(sample)).x
        mean_m = _mean_m(problem, start)
        if mean_m > limit_m:
            low = middle
            continue
        high, best, best_multiplier = middle, start, float(middle * per_distance)
        if mean_m > limit_m * (1.0 - LIMIT_REACHED):
            break
    return best, best_multiplier


def _instead(problem: Problem, minimum: Minimum, x: Array, accuracy: Accuracy) -> Minimum:
    """The same minimum record at another point."""
    return replace(minimum, x=x, value=PoseSample(problem, minimum.objective, prior=minimum.prior).value(x), accuracy=accuracy)


def _mean_m(problem: Problem, x: Array) -> float:
    """The mean distance."""
    return float(np.mean(norms(PoseSample(problem, SumOfDistances()).residuals(x))))


def best_of_starts(problem: Problem, objective: Objective, starts_count: int, seed: int, prior: Prior | None = None) -> Minimum:
    """The best of all searches; undetermined unknowns may be anywhere.

    Covariances have the axes of a frame that is itself identified, and their weights those of its start: what turns arm and
    frame together must not turn. It stays at nominal then; else the search turns everything to where the weights are least.
    """
    k = len(problem.parameters)
    bounded = np.array([parameter.has_bound for parameter in problem.parameters])
    draw = np.random.default_rng(seed)
    whole = PoseSample(problem, objective, prior=prior)
    held = _undetermined(problem) if isinstance(problem, WeightedProblem) else None
    few = replace(whole, stride=max(1, len(problem) // (POSES_PER_UNKNOWN * k)))
    ends = _Ends(few)
    rough = _rough(few, np.zeros(k), held)
    ends.is_new(rough.x)
    if few.stride > 1:
        ends.is_lead(_descended(few, rough.x, _fine(few), held).x)
    best = _finished(whole, rough, held)
    limit = starts_count * _times(int(np.sum(np.abs(best.x[bounded]) >= 1.0)))
    done = 1
    while done < limit:
        done += 1
        rough = _rough(few, draw.uniform(-REACH, REACH, k) * bounded, held)
        if not ends.is_new(rough.x):
            continue
        if few.stride > 1:
            rough = _descended(few, rough.x, _fine(few), held)
            if not ends.is_lead(rough.x):
                continue
        minimum = _finished(whole, rough, held)
        if abs(minimum.value - best.value) > DIFFERENT * best.value:
            limit = max(limit, starts_count * SEVERAL_STARTS)
        if minimum.value < best.value * (1.0 - BETTER):
            best = minimum
    return best


def _times(at_bound_count: int) -> int:
    """Factor on the number of starts for this many parameters at their bounds."""
    if at_bound_count >= MANY_BOUND:
        return MANY_STARTS
    return BOUND_STARTS if at_bound_count else 1


class _Ends:
    """Results of rough searches, to recognise new ones."""

    def __init__(self, sample: PoseSample) -> None:
        self._sample = sample
        self._limits = np.array([parameter.limit for parameter in sample.problem.parameters])
        self._seen: list[tuple[Array, Array]] = []
        self._finished: list[float] = []
        self._lowest = np.inf

    def is_lead(self, x: Array) -> bool:
        """Whether this result, on these poses, is another minimum than the previous ones."""
        value = self._sample.value(x)
        is_known = any(abs(value - other) <= SAME_END * other for other in self._finished)
        self._finished.append(value)
        return not is_known

    def is_new(self, x: Array) -> bool:
        """Whether a search from here may end lower than the others: low enough, with other active bounds or residuals."""
        residuals = self._sample.residuals(x)
        value = self._sample.value_of(residuals, 0.0)
        at_bound = np.sign(x) * (np.abs(x) >= self._limits)
        near = SAME * float(np.mean(norms(residuals)))
        is_new = value <= self._lowest * (1.0 + ROUGH_ERROR) and not any(
            np.array_equal(at_bound, bounds) and float(np.mean(norms(residuals - other))) < near for bounds, other in self._seen
        )
        if is_new:
            self._seen.append((at_bound, residuals))
        self._lowest = min(self._lowest, value)
        return is_new


def _undetermined(problem: Problem) -> Array:
    """Combinations of unknowns (k, k - rank) that no point sees at nominal."""
    return null_space(Sensitivity.at(problem, np.zeros(len(problem.parameters))).compact, problem.parameters, RANK_TOLERANCES[0])


def _known(seen: Array, prior: Prior | None) -> Array:
    """A sensitivity (m, 3, k) or (n, 1, k) of the points, beside what is known beforehand, as rows (r, 1, k)."""
    return seen if prior is None else np.concatenate((seen.reshape(-1, 1, seen.shape[2]), prior.rows))


def _rough(sample: PoseSample, start: Array, held: Array | None) -> SearchEnd:
    """A search with a coarse tolerance."""
    if not isinstance(sample.objective, LeastSquares):
        prior = sample.prior and replace(sample.prior, curvature=1.0)
        fit = replace(sample, objective=LeastSquares(), prior=prior)
        start = _descended(fit, start, FIT, held).x
    return _descended(sample, start, ROUGH, held)


def _finished(sample: PoseSample, rough: SearchEnd, held: Array | None) -> Minimum:
    """The search to convergence on all poses."""
    end = _descended(sample, rough.x, _fine(sample), held)
    return Minimum(end.x, sample.value(end.x), end.is_converged, sample.objective, sample.prior)


def _descended(sample: PoseSample, start: Array, goal: Termination, held: Array | None) -> SearchEnd:
    """A search that holds these combinations at nominal, as stiffly as the points of the sample hold others."""
    if held is None or not held.shape[1]:
        return descend(sample, start, goal)
    residuals, jacobian = sample.problem.residuals_and_jacobian(start, slice(None, None, sample.stride))
    stiffness = sample.stride * _stiffness(sample.objective, residuals, jacobian)
    return descend(sample, start, replace(goal, anchor=stiffness * held @ held.T))


def _fine(sample: PoseSample) -> Termination:
    """The goal of a final search. Some k distances are zero at a minimum, each increased by the smoothing."""
    share = len(sample.problem) / sample.stride / len(sample.problem.parameters)
    return replace(FINE, last_smoothing=FINE.last_smoothing * max(1.0, share))


def _nearest_to_nominal(sample: PoseSample, best: Minimum, equal: Equal) -> Minimum:
    """The fit with undetermined combinations back at nominal, as far as the allowed cost permits."""
    problem, objective = sample.problem, sample.objective
    # With very many poses, a sample gives the null space; the cost is evaluated on all.
    stride = max(1, len(problem) // NULL_POSES)
    residuals, jacobian = problem.residuals_and_jacobian(best.x, slice(None, None, stride))
    goal = _fine(sample)
    stiffness = stride * _stiffness(objective, residuals, jacobian)
    nothing = objective.value(objective.distances(np.full((len(problem), 3), NOTHING_M)), 0.0)
    tried = -1
    sensitivity, noise_m = (Sensitivity.at(problem, best.x).compact, 0.0 if equal == "exactly" else _noise_m(problem, best.x))
    # First what the noise hides: a change by its bound is less than a standard deviation. Rotations of arm and board
    # together cost nothing, unless the objective depends on axes (absolute coordinates).
    ways = [(sensitivity, RANK_TOLERANCES[0], noise_m)] if noise_m else []
    ways += [(way, tolerance, 0.0) for way, tolerance in product((sensitivity, jacobian), RANK_TOLERANCES)]
    for derivative, rank_tolerance, least_m in ways:
        null = null_space(_known(derivative, sample.prior), problem.parameters, rank_tolerance, least_m)
        if null.shape[1] == tried:
            continue
        tried = null.shape[1]
        end = descend(sample, best.x, replace(goal, anchor=stiffness * null @ null.T))
        value = sample.value(end.x)
        cost = COST_OF_NEARNESS if equal == "exactly" else _gain_by_noise(problem, tried)
        if value <= max(best.value * (1.0 + cost), nothing):
            return replace(best, x=end.x, value=value, is_converged=end.is_converged)
    return best


def _noise_m(problem: Problem, x: Array) -> float:
    """Scatter of one coordinate about the fit; 0 where no coordinates are left over."""
    freedom = 3 * len(problem) - len(problem.parameters)
    return float(np.sqrt(np.sum(problem.residuals(x) ** 2) / freedom)) if freedom > 0 else 0.0


def _gain_by_noise(problem: Problem, unknowns_count: int) -> float:
    """Expected share of the objective that this many unknowns remove by fitting noise.

    Each removes 1 / freedom from a sum of squares, and half of that from a sum of distances; the smaller is used.
    """
    freedom = 3 * len(problem) - len(problem.parameters)
    return max(COST_OF_NEARNESS, unknowns_count / (2.0 * freedom)) if freedom > 0 else COST_OF_NEARNESS


def _stiffness(objective: Objective, residuals: Array, jacobian: Array) -> float:
    """Curvature of the objective along a typical well determined unknown."""
    across, _ = objective.weights(np.maximum(norms(residuals), float(np.mean(norms(residuals)))), 0.0)
    return float(np.einsum("i,ijk,ijk->", across, jacobian, jacobian) / jacobian.shape[2])
