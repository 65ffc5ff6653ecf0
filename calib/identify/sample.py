"""An objective over some of a problem's poses: value and second-order expansion, summed over poses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.expansion import Problem
from calib.arrays import Array
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
class PoseSample:
    """A sample of the poses: every `stride`-th."""

    problem: Problem
    objective: Objective
    stride: int = 1

    def residuals(self, x: Array) -> Array:
        """(n, 3) [m]."""
        return np.concatenate([self.problem.residuals(x, rows) for rows in self._chunks()])

    def value(self, x: Array) -> float:
        """The objective itself, over these poses."""
        return self.value_of(self.residuals(x), 0.0)

    def value_of(self, residuals: Array, smoothing_m: float) -> float:
        """The objective of residuals (n, 3), smoothed."""
        return self.objective.value(self.objective.distances(residuals), smoothing_m)

    def around(
        self, x: Array, smoothing_m: float, before: Quadratic | None, is_bent: bool = True
    ) -> Quadratic:
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
            x,
            smoothing_m,
            np.concatenate(residuals),
            np.concatenate(present) if present else None,
            gradient,
            gram,
            curvature,
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
