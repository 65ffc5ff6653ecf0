"""One search: from a start to a minimum in the box, by Newton's method with exact second derivatives.

Each step minimises a quadratic in the box. If the objective decreases less than predicted, the step is
damped (Levenberg, Marquardt); if the quadratic is not convex, it is made so. Weakly determined combinations form curved valleys,
flat along and steep across: a long step along one climbs its side, so a rejected step is first
retried from its end straight down to the floor. The objective never increases.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.expansion import Problem
from calib.arrays import Array, norms
from calib.identify.objective import Objective

CHUNK = 1000  # poses at a time: their columns stay in the processor's cache, and memory does not grow with the poses


@dataclass(frozen=True, slots=True)
class Quadratic:
    """At x (k,): residuals (n, 3), the dual of the kinks there (n, 3), the gradient (k,) of the smoothed objective, and
    the two parts (k, k) of its Hessian: `gram` from rho, `curvature` from the kinematics.
    """

    x: Array
    smoothing_m: float
    residuals: Array
    dual: Array | None
    gradient: Array
    gram: Array
    curvature: Array


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known of the scaled unknowns (k,) before the points: sum of weight (x - mean)^2 / 2 is added to the objective.

    `square_m2`: the noise's variance over theirs, 0 where nothing is known; weight: the same times the objective's `curvature`.
    """

    mean: Array
    square_m2: Array
    curvature: float

    @property
    def weight(self) -> Array:
        """(k,), in the objective's unit."""
        return self.curvature * self.square_m2

    @property
    def rows(self) -> Array:
        """As rows (k, 1, k) of a sensitivity, beside those of the points."""
        return np.diag(np.sqrt(self.square_m2))[:, None, :]

    def value(self, x: Array) -> float:
        """At unknowns x (k,)."""
        return 0.5 * float(self.weight @ (x - self.mean) ** 2)


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A sample of the poses, every `stride`-th, and what is known beforehand, None: nothing."""

    problem: Problem
    objective: Objective
    stride: int = 1
    prior: Prior | None = None

    def residuals(self, x: Array) -> Array:
        """(n, 3) [m]."""
        return np.concatenate([self.problem.residuals(x, rows) for rows in self._chunks()])

    def value(self, x: Array) -> float:
        """The objective itself, over these poses."""
        value = self.value_of(self.residuals(x), 0.0)
        return value if self.prior is None else value + self.prior.value(x) / self.stride

    def value_of(self, residuals: Array, smoothing_m: float) -> float:
        """The objective of residuals (n, 3), smoothed."""
        return self.objective.value(self.objective.distances(residuals), smoothing_m)

    def around(self, x: Array, smoothing_m: float, before: Quadratic | None, is_bent: bool = True) -> Quadratic:
        """Second-order expansion around x, with the kinematics' if `is_bent`; the dual is that of a step from `before` to x."""
        k, done = len(x), 0
        gradient, gram, curvature = np.zeros(k), np.zeros((k, k)), np.zeros((k, k))
        residuals, duals = [], []
        for rows in self._chunks():
            here = self.problem.expanded(x, rows)
            dual = self._dual(here.residuals, slice(done, done + len(here.residuals)), before)
            pull, bend = self.objective.expansion(here.residuals, smoothing_m, dual)
            some_gradient, some_gram = here.sums(pull, bend)
            gradient += some_gradient
            gram += some_gram
            if is_bent:
                curvature += here.curvature(pull)
            residuals.append(here.residuals)
            duals.append(dual)
            done += len(here.residuals)
        present = [dual for dual in duals if dual is not None]
        return Quadratic(
            x, smoothing_m, np.concatenate(residuals), np.concatenate(present) if present else None, gradient, gram, curvature
        )

    def _dual(self, residuals: Array, part: slice, before: Quadratic | None) -> Array | None:
        """The dual of some of the poses."""
        if before is None:
            return None
        dual = None if before.dual is None else before.dual[part]
        return self.objective.next_dual(before.residuals[part], residuals, before.smoothing_m, dual)

    def _chunks(self) -> Iterator[slice]:
        """Slices of poses."""
        for start in range(0, len(self.problem), CHUNK * self.stride):
            yield slice(start, start + CHUNK * self.stride, self.stride)


Mask = npt.NDArray[np.bool_]
PATIENCE = 3  # exchanges of whole blocks without progress, before variables are exchanged one by one
ROUNDING = 1e-13  # of the largest slope: a smaller multiplier counts as zero


def step_in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """The d with lower <= d <= upper that minimises gradient . d + d' H d / 2; H (k, k) positive definite.

    Block principal pivoting (Judice and Pires, Computers and Operations Research 21 (1994) 587): solve on the free
    variables, then exchange all that are on the wrong side, bound or free, at once; without progress, exchange only
    the last of them, which guarantees termination.
    """
    at_lower, at_upper = (lower >= 0.0) & (gradient > 0.0), (upper <= 0.0) & (gradient < 0.0)
    fewest, patience = len(gradient) + 1, PATIENCE
    d = np.zeros_like(gradient)
    for _ in range(50 * len(gradient)):
        d, slope = _solved(hessian, gradient, np.where(at_lower, lower, upper), at_lower | at_upper)
        rounding = ROUNDING * float(np.max(np.abs(gradient))) + 1e-300
        free = ~(at_lower | at_upper)
        below, above = free & (d < lower), free & (d > upper)
        released = (at_lower & (slope < -rounding)) | (at_upper & (slope > rounding))
        wrong = np.flatnonzero(below | above | released)
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong = wrong[-1:]
        at_lower[wrong], at_upper[wrong] = below[wrong], above[wrong]
    return np.asarray(np.clip(d, lower, upper))


def _solved(hessian: Array, gradient: Array, bound: Array, is_held: Mask) -> tuple[Array, Array]:
    """The minimum over the free variables, and the gradient there; 0 along the free ones."""
    if not is_held.any():
        return _newton(hessian, gradient), np.zeros_like(gradient)
    d = np.where(is_held, bound, 0.0)
    free = np.flatnonzero(~is_held)
    slope = gradient + hessian @ d
    if len(free):
        d[free] = _newton(hessian[free[:, None], free], slope[free])
        slope = gradient + hessian @ d
    return d, slope


def _newton(hessian: Array, gradient: Array) -> Array:
    """The step to the minimum; along what the points do not determine, none."""
    try:
        return np.asarray(np.linalg.solve(hessian, -gradient))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(hessian, -gradient, rcond=None)[0])


NOTHING_M = 1e-9  # residuals below a nanometre count as zero
STEP_LIMIT = 150
TRACE = 1e-7  # weight of |x|^2 / 2 per unknown, as a share of the objective, that makes every step unique
LEAST_CURVATURE = 1e-14  # of the largest one
KEPT, POOR, GOOD = 1e-4, 0.25, 0.5  # shares of the prediction: rejected, more damping, less damping
VALLEY = 1e-3  # a step with a smaller predicted decrease is along a valley
RESTORING = 1e-6  # of the trace: unknowns with less curvature are fixed in a restoration
SMOOTHER = 0.1  # reduction of the smoothing each time
AHEAD, LAGS = (
    0.1,
    0.03,
)  # smoothing is reduced after a step with a predicted decrease below these shares of the smoothing's cost
HOPELESS = 1e12  # times the curvature of a typical unknown: no damping helps


@dataclass(frozen=True, slots=True)
class SearchEnd:
    """Result of a search: x, and whether it converged."""

    x: Array
    is_converged: bool


@dataclass(frozen=True, slots=True)
class Termination:
    """Termination of a search: smoothings as shares of the mean distance at the start, tolerance as a share of the objective.

    x' anchor x / 2 with anchor (k, k) is added to the objective to hold combinations of unknowns at nominal. Without
    `is_bent` second derivatives of the kinematics are omitted: cheaper, and sufficient for a rough search.
    """

    first_smoothing: float
    last_smoothing: float
    tolerance: float
    anchor: Array | None = None
    is_bent: bool = True
    step_limit: int = STEP_LIMIT


def descend(sample: PoseSample, start: Array, goal: Termination) -> SearchEnd:
    """Search from a start inside the box."""
    return _Descent(sample, start, goal).ended()


class _Descent:
    """The state of one search."""

    def __init__(self, sample: PoseSample, start: Array, goal: Termination) -> None:
        self._sample, self._goal = sample, goal
        self._limits = np.array([parameter.limit for parameter in sample.problem.parameters])
        mean_m = 0.0
        if not sample.objective.is_smooth:
            mean_m = float(np.mean(norms(sample.residuals(start))))
        self._last_m = max(goal.last_smoothing * mean_m, 1e-14)
        self._here = sample.around(start, max(goal.first_smoothing * mean_m, 1e-14), None, goal.is_bent)
        typical = float(np.trace(self._here.gram)) / len(start)
        self._held = self._holding(typical)
        prior = sample.prior
        self._drawn = np.zeros(len(start)) if prior is None else prior.weight * prior.mean / sample.stride
        self._restoring = RESTORING * typical * len(start)
        self._hopeless = HOPELESS * typical
        self._damping, self._is_undamped = 0.0, False

    def _holding(self, typical: float) -> Array:
        """The regularisation towards nominal: the anchor, and a small trace that makes every step unique."""
        k = len(self._here.x)
        trace = TRACE * self._sample.value_of(self._here.residuals, 0.0) / k
        held = (trace + 1e-15 * k * typical) * np.eye(k)
        if (prior := self._sample.prior) is not None:
            held += np.diag(prior.weight / self._sample.stride)
        return held if self._goal.anchor is None else held + self._goal.anchor

    def _merit(self, there: Quadratic) -> float:
        """The merit function: the objective with the present smoothing, plus regularisation."""
        return self._sample.value_of(there.residuals, self._here.smoothing_m) + self._regularisation(there)

    def _regularisation(self, there: Quadratic) -> float:
        return float((0.5 * there.x @ self._held - self._drawn) @ there.x)

    def ended(self) -> SearchEnd:
        """Take steps until the predicted decrease is too small."""
        for _ in range(self._goal.step_limit):
            here = self._here
            if float(np.max(np.abs(here.residuals))) < NOTHING_M:
                return SearchEnd(here.x, True)
            value, excess_m = self._value()
            d, promise = self._step()
            if promise > max(self._goal.tolerance * value, LAGS * excess_m):
                self._try(d, promise, value, self._less() if promise < AHEAD * excess_m else here.smoothing_m)
            elif self._damping > 0.0 and not self._is_undamped:
                self._damping, self._is_undamped = 0.0, True
            elif here.smoothing_m > self._last_m:
                self._here = self._resmoothed()
            else:
                return SearchEnd(here.x, True)
            if self._damping > self._hopeless:
                return SearchEnd(here.x, False)
        return SearchEnd(self._here.x, False)

    def _value(self) -> tuple[float, float]:
        """The merit function here, and what the smoothing adds to it, if it will be reduced further."""
        here, objective = self._here, self._sample.objective
        distances = objective.distances(here.residuals)
        smoothed = objective.value(distances, here.smoothing_m)
        is_last = here.smoothing_m <= self._last_m or objective.is_smooth
        excess_m = 0.0 if is_last else smoothed - objective.value(distances, 0.0)
        return smoothed + self._regularisation(here), excess_m

    def _less(self) -> float:
        """The next smoothing."""
        return max(self._last_m, SMOOTHER * self._here.smoothing_m)

    def _resmoothed(self) -> Quadratic:
        """The present point with less smoothing."""
        here = self._here
        return self._sample.around(here.x, self._less(), here if here.dual is not None else None, self._goal.is_bent)

    def _step(self) -> tuple[Array, float]:
        """The minimising step in the box, and the predicted decrease."""
        here = self._here
        gradient = here.gradient + self._held @ here.x - self._drawn
        hessian = here.gram + here.curvature + self._held
        if self._goal.is_bent:
            hessian = _bent_up(hessian)
        if self._damping > 0.0:
            hessian = hessian + self._damping * np.eye(len(here.x))
        d = step_in_box(hessian, gradient, -self._limits - here.x, self._limits - here.x)
        return d, -float(gradient @ d + 0.5 * d @ hessian @ d)

    def _try(self, d: Array, promise: float, value: float, smoothing_m: float) -> None:
        """Take the step if the objective decreases, and adapt the damping."""
        there = self._sample.around(self._inside(self._here.x + d), smoothing_m, self._here, self._goal.is_bent)
        achieved = (value - self._merit(there)) / promise
        if achieved < GOOD and promise < VALLEY * value:
            restored = self._restored(there)
            again = (value - self._merit(restored)) / promise
            if again > achieved:
                there, achieved = restored, again
        if achieved > GOOD:
            self._damping = 0.1 * self._damping if self._damping * float(d @ d) > 1e-3 * promise else 0.0
        elif achieved < POOR:
            self._damping = max(4.0 * self._damping, promise / max(float(d @ d), 1e-300))
        if achieved > KEPT:
            self._here, self._is_undamped = there, False

    def _restored(self, there: Quadratic) -> Quadratic:
        """Restoration: from the end of a long step along a curved valley, straight down to its floor."""
        d = step_in_box(
            there.gram + self._held + self._restoring * np.eye(len(there.x)),
            there.gradient + self._held @ there.x - self._drawn,
            -self._limits - there.x,
            self._limits - there.x,
        )
        return self._sample.around(self._inside(there.x + d), there.smoothing_m, there, self._goal.is_bent)

    def _inside(self, x: Array) -> Array:
        """Clip to the limits against rounding errors."""
        return np.clip(x, -self._limits, self._limits)


def _bent_up(hessian: Array) -> Array:
    """The Hessian itself if it is positive definite, else with its eigenvalues' signs turned."""
    try:
        np.linalg.cholesky(hessian)
        return hessian
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(hessian)
        floor = LEAST_CURVATURE * float(np.max(np.abs(values)))
        return np.asarray((vectors * np.maximum(np.abs(values), floor)) @ vectors.T)
