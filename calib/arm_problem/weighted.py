"""Points whose covariances are known: each residual counts by its own noise, along each direction.

    r -> W r,   W = s C^(-1/2),   s the noise of a usual point

W makes the noise alike in all rows and directions, so that objectives, noise and intervals hold unchanged; s keeps it a length.
C is stated in the axes of the measuring frame. Where that frame is itself identified, its axes are those of the start, or of an
earlier solution: W is constant while the solver works, so derivatives stay exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm_problem.expansion import ALL, Expanded, Problem
from calib.arm_problem.frames import Frame
from calib.arm_problem.posed import PosedProblem
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array


def whole_problem(problem: ArmProblem, frames: tuple[Frame, ...] | None = None) -> Problem:
    """The problem with rows for measured orientations, and weighted by covariances where they are known.

    `frames`: of an earlier solution, whose axes the covariances are turned to; by default those of the start.
    """
    posed = PosedProblem(problem) if len(problem.observed.turned_rows) else None
    inner: Problem = problem if posed is None else posed
    weights, covariance = position_weights(problem, frames), problem.observed.covariance
    if weights is None or covariance is None:
        return inner
    if posed is not None:
        turns = _weights(problem, 1, frames)[posed.rows] / posed.lever_m
        weights = np.concatenate((weights, turns))
    return WeightedProblem(inner, weights, usual_noise_m(covariance[:, 0]))


def posed_part(whole: Problem) -> PosedProblem | None:
    """The problem with orientations inside a whole one; None without orientations."""
    inner = whole.inner if isinstance(whole, WeightedProblem) else whole
    return inner if isinstance(inner, PosedProblem) else None


def position_weights(problem: ArmProblem, frames: tuple[Frame, ...] | None = None) -> Array | None:
    """W (m, 3, 3) of the tips' residuals in the base frame; None if all points count alike."""
    return None if problem.observed.covariance is None else _weights(problem, 0, frames)


def usual_noise_m(covariance: Array) -> float:
    """Standard deviation of one axis of a usual point: median over covariances (m, 3, 3) of positions."""
    return float(np.median(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)))


def _weights(problem: ArmProblem, kind: int, frames: tuple[Frame, ...] | None) -> Array:
    """Weights (m, 3, 3) of positions (kind 0) or orientations (1), turned to the base frame's axes."""
    observed = problem.observed
    if observed.covariance is None:
        raise ValueError("points without covariances have no weights")
    turns = np.array([frame.rotation for frame in frames or observed.frames])[observed.frame]
    values, axes = np.linalg.eigh(observed.covariance[:, kind])
    axes = turns @ axes
    roots = usual_noise_m(observed.covariance[:, 0]) / np.sqrt(values)
    return np.asarray((axes * roots[:, None, :]) @ np.swapaxes(axes, 1, 2))


@dataclass(frozen=True, slots=True)
class WeightedExpansion:
    """An expansion whose residuals are multiplied by weights (m, 3, 3)."""

    inner: Expanded
    weights: Array

    @property
    def residuals(self) -> Array:
        """(m, 3)."""
        return _times(self.weights, self.inner.residuals)

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Gradient (k,) and gram (k, k): pull and bend act on the weighted residuals."""
        w = self.weights
        if bend is None:
            bent = w @ w
        elif bend.ndim == 2:
            bent = w @ (bend.T[:, :, None] * w)
        else:
            bent = w @ np.moveaxis(bend, 2, 0) @ w
        return self.inner.sums(_times(w, pull), np.ascontiguousarray(np.moveaxis(bent, 0, 2)))

    def curvature(self, pull: Array) -> Array:
        """(k, k)."""
        return self.inner.curvature(_times(self.weights, pull))


class WeightedProblem:
    """A problem whose residuals are multiplied by symmetric weights (rows, 3, 3); unit_m: then the noise of one axis."""

    def __init__(self, inner: Problem, weights: Array, unit_m: float) -> None:
        self.inner, self.weights, self.unit_m = inner, weights, unit_m
        self.parameters = inner.parameters

    def __len__(self) -> int:
        """How many rows."""
        return len(self.inner)

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3) [m of a usual point]."""
        return _times(self.weights[rows], self.inner.residuals(x, rows))

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """(rows, 3) and (rows, 3, k)."""
        residuals, jacobian = self.inner.residuals_and_jacobian(x, rows)
        return _times(self.weights[rows], residuals), self.weights[rows] @ jacobian

    def expanded(self, x: Array, rows: slice = ALL) -> WeightedExpansion:
        """Around x."""
        return WeightedExpansion(self.inner.expanded(x, rows), self.weights[rows])

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3, k)."""
        return np.asarray(self.weights[rows] @ self.inner.sensitivity(x, rows))


def _times(weights: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("mij,mj->mi", weights, vectors))
