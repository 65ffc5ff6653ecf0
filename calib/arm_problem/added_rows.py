"""Residual rows that are added behind those of an inner problem, with first derivatives only (Gauss-Newton)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm_problem.expansion import Expanded
from calib.arrays import Array


@dataclass(frozen=True, slots=True)
class WithRows:
    """An inner expansion with the first `own` unknowns, and added residuals (r, 3) with their jacobian (r, 3, k).

    inner None: nothing but the added rows.
    """

    inner: Expanded | None
    own: int
    added: Array
    jacobian: Array

    @property
    def residuals(self) -> Array:
        """(m + r, 3) [m]."""
        return self.added if self.inner is None else np.concatenate((self.inner.residuals, self.added))

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Gradient (k,) and gram (k, k)."""
        m, k, own = len(pull) - len(self.added), self.jacobian.shape[2], self.own
        gradient, gram = np.zeros(k), np.zeros((k, k))
        if self.inner is not None:
            inner_bend = None if bend is None else bend[..., :m]
            gradient[:own], gram[:own, :own] = self.inner.sums(pull[:m], inner_bend)
        gradient += np.einsum("ri,rik->k", pull[m:], self.jacobian)
        return gradient, gram + self._gram(None if bend is None else bend[..., m:])

    def curvature(self, pull: Array) -> Array:
        """Of the inner rows, (k, k)."""
        k = self.jacobian.shape[2]
        whole = np.zeros((k, k))
        if self.inner is not None:
            whole[: self.own, : self.own] = self.inner.curvature(pull[: len(pull) - len(self.added)])
        return whole

    def _gram(self, bend: Array | None) -> Array:
        """Sum of J' bend J; bend (3, r), (3, 3, r), or None for ones."""
        jacobian = self.jacobian
        if bend is None:
            bent = jacobian
        elif bend.ndim == 2:
            bent = bend.T[:, :, None] * jacobian
        else:
            bent = np.einsum("ijr,rjk->rik", bend, jacobian)
        k = jacobian.shape[2]
        return np.asarray(jacobian.reshape(-1, k).T @ bent.reshape(-1, k))


def in_threes(values: Array) -> Array:
    """Numbers (r, ...) that are one residual each, as rows of three, the last filled up with zeros."""
    missing = -len(values) % 3
    filled = np.concatenate((values, np.zeros((missing, *values.shape[1:]))))
    return filled.reshape(-1, 3, *values.shape[1:])
