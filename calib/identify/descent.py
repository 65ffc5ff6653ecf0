"""One search: from a start down to a minimum in the box, by Newton's steps with exact second derivatives.

Each step minimises a quadratic in the box. Where the quadratic promises what the objective does not keep, the step is
damped (Levenberg, Marquardt); where it is not convex, it is bent up. What the data hardly determine makes valleys that
are flat along and steep across, and bent: a long step along one climbs its side, so a step that disappoints is first
tried once more from its end straight down to the floor. The objective never rises.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, norms
from calib.identify.box import step_in_box
from calib.identify.sample import Quadratic, Sample

NOTHING_M = 1e-9  # residuals below this everywhere are none: a nanometre
STEP_LIMIT = 150
TRACE = 1e-7  # weight of |x|^2 / 2 per unknown, as a share of the objective, that makes every step unique
LEAST_CURVATURE = 1e-14  # of the largest one
KEPT, POOR, GOOD = 1e-4, 0.25, 0.5  # shares of the promise: not taken, more damping, less damping
VALLEY = 1e-3  # a step that promises less than this share of the objective goes along a valley
RESTORING = (
    1e-6  # of the trace: unknowns with less curvature are left where they are on the way down to the floor
)
SMOOTHER = 0.1  # how much less smoothing each time
AHEAD, LAGS = (
    0.1,
    0.03,
)  # a step that promises less than these shares of what the smoothing costs is followed by less of it
HOPELESS = 1e12  # times the curvature of a typical unknown: no damping helps


@dataclass(frozen=True, slots=True)
class End:
    """Where a search ended: x, steps taken, and whether by itself."""

    x: Array
    steps_count: int
    is_converged: bool


@dataclass(frozen=True, slots=True)
class Goal:
    """When a search ends: smoothings as shares of the mean distance at the start, tolerance as one of the objective.

    x' anchor x / 2 with anchor (k, k) is added to the objective: it holds combinations of unknowns at nominal. Without
    `is_bent` second derivatives of the kinematics are left out: cheaper, and enough to see where a search leads.
    """

    first_smoothing: float
    last_smoothing: float
    tolerance: float
    anchor: Array | None = None
    is_bent: bool = True
    step_limit: int = STEP_LIMIT


def descend(sample: Sample, start: Array, goal: Goal) -> End:
    """Down from a start inside the box."""
    return _Descent(sample, start, goal).ended()


class _Descent:
    """The state of one search."""

    def __init__(self, sample: Sample, start: Array, goal: Goal) -> None:
        self._sample, self._goal = sample, goal
        self._limits = np.array([parameter.limit for parameter in sample.problem.parameters])
        mean_m = 0.0
        if not sample.objective.is_smooth:
            mean_m = float(np.mean(norms(sample.residuals(start))))
        self._last_m = max(goal.last_smoothing * mean_m, 1e-14)
        self._here = sample.around(start, max(goal.first_smoothing * mean_m, 1e-14), None, goal.is_bent)
        typical = float(np.trace(self._here.gram)) / len(start)
        self._held = self._holding(typical)
        self._restoring = RESTORING * typical * len(start)
        self._hopeless = HOPELESS * typical
        self._damping, self._is_undamped = 0.0, False

    def _holding(self, typical: float) -> Array:
        """What holds x at nominal: the anchor, and a trace that makes every step unique."""
        k = len(self._here.x)
        trace = TRACE * self._sample.value_of(self._here.residuals, 0.0) / k
        held = (trace + 1e-15 * k * typical) * np.eye(k)
        return held if self._goal.anchor is None else held + self._goal.anchor

    def _merit(self, there: Quadratic) -> float:
        """What must fall: the objective, smoothed as it is here, and what holds x."""
        value = self._sample.value_of(there.residuals, self._here.smoothing_m)
        return value + 0.5 * float(there.x @ self._held @ there.x)

    def ended(self) -> End:
        """Steps until one promises too little."""
        for steps in range(1, self._goal.step_limit + 1):
            here = self._here
            if float(np.max(np.abs(here.residuals))) < NOTHING_M:
                return End(here.x, steps, True)
            value, excess_m = self._merit(here), self._excess()
            d, promise = self._step()
            if promise > max(self._goal.tolerance * value, LAGS * excess_m):
                self._try(d, promise, value, self._less() if promise < AHEAD * excess_m else here.smoothing_m)
            elif self._damping > 0.0 and not self._is_undamped:
                self._damping, self._is_undamped = 0.0, True
            elif here.smoothing_m > self._last_m:
                self._here = self._resmoothed()
            else:
                return End(here.x, steps, True)
            if self._damping > self._hopeless:
                return End(here.x, steps, False)
        return End(self._here.x, self._goal.step_limit, False)

    def _excess(self) -> float:
        """What the smoothing adds to the objective, where there is less to come."""
        here = self._here
        if here.smoothing_m <= self._last_m or self._sample.objective.is_smooth:
            return 0.0
        smoothed = self._sample.value_of(here.residuals, here.smoothing_m)
        return smoothed - self._sample.value_of(here.residuals, 0.0)

    def _less(self) -> float:
        """The next smoothing."""
        return max(self._last_m, SMOOTHER * self._here.smoothing_m)

    def _resmoothed(self) -> Quadratic:
        """The same place with less smoothing."""
        here = self._here
        return self._sample.around(
            here.x, self._less(), here if here.dual is not None else None, self._goal.is_bent
        )

    def _step(self) -> tuple[Array, float]:
        """The step in the box that the quadratic asks for, and by how much the objective should fall."""
        here = self._here
        gradient = here.gradient + self._held @ here.x
        hessian = here.gram + here.curvature + self._held
        if self._goal.is_bent:
            hessian = _bent_up(hessian)
        if self._damping > 0.0:
            hessian = hessian + self._damping * np.eye(len(here.x))
        d = step_in_box(hessian, gradient, -self._limits - here.x, self._limits - here.x)
        return d, -float(gradient @ d + 0.5 * d @ hessian @ d)

    def _try(self, d: Array, promise: float, value: float, smoothing_m: float) -> None:
        """Take the step if the objective falls, and learn from it."""
        there = self._sample.around(
            self._inside(self._here.x + d), smoothing_m, self._here, self._goal.is_bent
        )
        kept = (value - self._merit(there)) / promise
        if kept < GOOD and promise < VALLEY * value:
            restored = self._restored(there)
            again = (value - self._merit(restored)) / promise
            if again > kept:
                there, kept = restored, again
        if kept > GOOD:
            self._damping = 0.1 * self._damping if self._damping * float(d @ d) > 1e-3 * promise else 0.0
        elif kept < POOR:
            self._damping = max(4.0 * self._damping, promise / max(float(d @ d), 1e-300))
        if kept > KEPT:
            self._here, self._is_undamped = there, False

    def _restored(self, there: Quadratic) -> Quadratic:
        """From there, where a long step along a bent valley has climbed its side, straight down to the floor."""
        d = step_in_box(
            there.gram + self._held + self._restoring * np.eye(len(there.x)),
            there.gradient + self._held @ there.x,
            -self._limits - there.x,
            self._limits - there.x,
        )
        return self._sample.around(self._inside(there.x + d), there.smoothing_m, there, self._goal.is_bent)

    def _inside(self, x: Array) -> Array:
        """Within the limits, whatever the rounding."""
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
