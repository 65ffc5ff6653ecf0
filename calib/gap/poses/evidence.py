"""How well sets of effects explain the residuals, all of them at once, with the geometry refitted beside each.

The model is linear around the fitted geometry, y = A b + C s + noise of variance 1, with Gaussian priors: b ~ N(0, I) in
bounds, s ~ N(0, I) in typical sizes. With b integrated out, all that a set S of columns needs is G = C' M C and h = C' M y,
where M = I - A (A'A + I)^-1 A'; its log evidence over the empty set is
  ln Z = h_S' (I + G_SS)^-1 h_S / 2 - ln det(I + G_SS) / 2
(MacKay, Information Theory, Inference, and Learning Algorithms, 2003, ch. 28). G and h are computed once, so that every
single effect, pair and rival costs a small matrix.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen


@dataclass(frozen=True, slots=True)
class Evidence:
    """G (c, c) and h (c,) of all columns, and what the geometry alone leaves: `left` = y' M y of `count` values."""

    gram: Array
    pull: Array
    left: float
    count: int

    @classmethod
    def of(cls, base: Array, columns: Array, y: Array) -> Evidence:
        """From whitened base columns (r, k) in bounds, effect columns (r, c) in typical sizes and values y (r,)."""
        inner = np.linalg.cholesky(base.T @ base + np.eye(base.shape[1]))
        wanted = np.column_stack((columns, y))
        taken = np.linalg.solve(inner.T, np.linalg.solve(inner, base.T @ wanted))
        rest = wanted - base @ taken
        # as a sum of squares, not as a difference: large columns that the base all but explains would else lose their sign
        seen = rest.T @ rest + taken.T @ taken
        return cls(frozen(seen[:-1, :-1]), frozen(seen[:-1, -1]), float(seen[-1, -1]), len(y))

    @classmethod
    def empty(cls, count: int) -> Evidence:
        """That of no measurement, for `count` columns."""
        return cls(frozen(np.zeros((count, count))), frozen(np.zeros(count)), 0.0, 0)

    def beside(self, other: Evidence) -> Evidence:
        """That of both, from measurements that share no unknown but these columns."""
        gram, pull = frozen(self.gram + other.gram), frozen(self.pull + other.pull)
        return Evidence(gram, pull, self.left + other.left, self.count + other.count)

    def log(self, chosen: Sequence[int]) -> float:
        """Ln Z of a set of columns over the empty set."""
        if not len(chosen):
            return 0.0
        k = list(chosen)
        inner = np.linalg.cholesky(np.eye(len(k)) + self.gram[np.ix_(k, k)])
        half = np.linalg.solve(inner, self.pull[k])
        return float(0.5 * half @ half - np.sum(np.log(np.diag(inner))))

    def log_each(self, sets: Sequence[Sequence[int]]) -> tuple[Array, list[Array]]:
        """Ln Z of many sets at once, and each one's coefficients in typical sizes."""
        logs, values = np.zeros(len(sets)), [np.zeros(0)] * len(sets)
        for size in {len(one) for one in sets if len(one)}:
            which = [k for k, one in enumerate(sets) if len(one) == size]
            k = np.array([sets[w] for w in which])
            inner = np.eye(size) + self.gram[k[:, :, None], k[:, None, :]]
            pull = self.pull[k]
            value = np.linalg.solve(inner, pull[:, :, None])[:, :, 0]
            logs[which] = 0.5 * np.sum(pull * value, axis=1) - 0.5 * np.linalg.slogdet(inner)[1]
            for w, own in zip(which, value, strict=True):
                values[w] = own
        return logs, values

    def estimate(self, chosen: Sequence[int]) -> tuple[Array, Array]:
        """Coefficients (k,) of a set of columns, in typical sizes, and their covariance (k, k)."""
        k = list(chosen)
        covariance = np.linalg.inv(np.eye(len(k)) + self.gram[np.ix_(k, k)])
        return np.asarray(covariance @ self.pull[k]), np.asarray(covariance)

    def left_with(self, chosen: Sequence[int]) -> float:
        """The sum of squares that is left with a set of columns fitted, in noise variances."""
        if not len(chosen):
            return self.left
        size, _ = self.estimate(chosen)
        k = list(chosen)
        return float(self.left - 2.0 * size @ self.pull[k] + size @ self.gram[np.ix_(k, k)] @ size)

    def detectability(self, chosen: Sequence[int], sizes: Array, beside: Sequence[int] = ()) -> float:
        """Standard deviations by which columns of these sizes stand out, the geometry and columns `beside` refitted."""
        k, b = list(chosen), list(beside)
        seen = self.gram[np.ix_(k, k)]
        if b:
            across = self.gram[np.ix_(b, k)]
            seen = seen - across.T @ np.linalg.solve(np.eye(len(b)) + self.gram[np.ix_(b, b)], across)
        return math.sqrt(max(0.0, float(sizes @ seen @ sizes)))


def tail(value: Array) -> float:
    """What a Cauchy prior takes less than a Gaussian of the same scale, for coefficients in typical sizes.

    Three times a typical size is not rare, and must not cost a law 4.5 in log evidence against a rival that does with less.
    """
    square = value * value
    return float(np.sum(np.maximum(0.0, 0.5 * square - np.log1p(square))))
