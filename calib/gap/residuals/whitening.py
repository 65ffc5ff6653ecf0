"""Noise of the rows as it is measured: an autoregressive model of each cell, fitted to what a model leaves.

Rows that follow each other are not independent: the filters leave a little, and what a law errs by lasts for many rows. An AR
process of small order has that spectrum; its prediction errors are white, and sums of their squares are a likelihood
(Brockwell, Davis, Time Series: Theory and Methods, 2nd ed., ch. 8):
  e_t = (r_t - sum over k = 1 .. p of a_k r_(t-k)) / (s_p g_run),   ln L = -1/2 sum e_t^2 - sum ln (s_p g_run),
with r (m,) the rows of a cell, a (p,) and s_p of `fitted`, and g the size of each run. By Levinson and Durbin, from the
autocovariances c_0 .. c_p of r / g, order k follows from order k - 1:
  f = (c_k - a' (c_(k-1) .. c_1)) / v,   a <- (a - f reversed(a), f),   v <- v (1 - f^2),   s_k = sqrt(v).
Rows after a gap begin anew, with the lower orders: row j of a stretch has order min(j, p).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from calib.arrays import Array
from calib.gap.posterior.constants import DRAWN, NOISE_LEAST, ORDER

Places = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Noise:
    """Of a cell: prediction coefficients of orders 0 to p (order k: k of them), the deviation of each order's error, and the
    scale of each run: what a law errs by is another thing in a fast run than in a slow one.
    """

    coefficients: tuple[Array, ...]
    sd: Array
    scale: Array

    @classmethod
    def white(cls, runs: int) -> Noise:
        """Independent rows of the floor's size."""
        return cls((np.zeros(0),), np.ones(1), np.ones(runs))


@dataclass(frozen=True, slots=True)
class RowOrder:
    """How rows of a cell follow each other: `before` (m,) counts those before it in its stretch, each `stride` rows earlier."""

    before: Places
    stride: int
    run: Places

    @classmethod
    def of(cls, run: Places, sample: Places, step: int, stride: int, usable: Flags | None = None) -> RowOrder:
        """From each row's run and sample; neighbours are `step` samples apart, `stride` rows side by side at each.

        Rows that are not `usable` are like gaps.
        """
        own_run, own_sample = run[::stride], sample[::stride]
        follows = np.zeros(len(own_run), dtype=bool)
        follows[1:] = (np.diff(own_run) == 0) & (np.diff(own_sample) <= step)
        if usable is not None:
            follows &= usable[::stride]
            follows[1:] &= usable[::stride][:-1]
        count = np.arange(len(own_run))
        first = np.maximum.accumulate(np.where(follows, 0, count))
        return cls(np.repeat(count - first, stride), stride, run)

    def whitener(self, noise: Noise, picked: Flags | None = None) -> sparse.csr_array:
        """Prediction errors over their standard deviation as a matrix on the rows (m,): all of them, or those picked.

        A band of as many diagonals as there are orders, so that it costs as much whatever gaps there are.
        """
        highest = len(noise.coefficients) - 1
        weights = np.zeros((highest + 1, highest + 1))  # by order and lag
        for order, coefficients in enumerate(noise.coefficients):
            weights[order, : order + 1] = np.concatenate(([1.0], -coefficients)) / noise.sd[order]
        at = np.arange(len(self.before)) if picked is None else np.flatnonzero(picked)
        orders = np.minimum(self.before[at], highest)
        lags = np.arange(highest + 1)
        used = lags <= orders[:, None]
        columns = (at[:, None] - lags * self.stride)[used]
        values = (weights[orders] / noise.scale[self.run[at]][:, None])[used]
        ends = np.concatenate(([0], np.cumsum(orders + 1)))
        return sparse.csr_array((values, columns, ends), shape=(len(at), len(self.before)))

    def whitened(self, values: Array, noise: Noise) -> Array:
        """Prediction errors of values (m, c) over their standard deviation."""
        return np.asarray(self.whitener(noise) @ values)

    def covariances(self, values: Array, picked: Flags, orders: int) -> tuple[Array, Array]:
        """Sums of values (m,) times those k rows earlier, k = 0 .. orders, and of how many pairs."""
        sums, counts = np.zeros(orders + 1), np.zeros(orders + 1)
        for k in range(orders + 1):
            at = np.flatnonzero(self.before >= k)
            at = at[picked[at] & picked[at - k * self.stride]]
            sums[k], counts[k] = float(values[at] @ values[at - k * self.stride]), len(at)
        return sums, counts


def fitted(series: RowOrder, values: Array, picked: Flags, order: int = ORDER) -> Noise:
    """The noise of a cell from what is left on its picked rows (Levinson and Durbin's recursion); not below the floor."""
    scale = _scales(series, values, picked)
    values = values / scale[series.run]
    sums, counts = series.covariances(values, picked, order)
    if counts[order] < 10 * order:
        return Noise((np.zeros(0),), np.ones(1), scale)
    # divided by all rows, so that the sequence is one that a process can have
    covariance = sums / counts[0]
    coefficients, variance = [np.zeros(0)], [float(covariance[0])]
    for k in range(1, order + 1):
        last = coefficients[-1]
        missed = covariance[k] - float(last @ covariance[k - 1 : 0 : -1])
        share = float(np.clip(missed / max(variance[-1], 1e-300), -0.98, 0.98))
        coefficients.append(np.append(last - share * last[::-1], share))
        variance.append(variance[-1] * (1.0 - share**2))
    least = NOISE_LEAST / float(np.sqrt(np.mean(scale[series.run[picked]] ** 2)))
    return Noise(tuple(coefficients), np.maximum(np.sqrt(variance), least), scale)


def _scales(series: RowOrder, values: Array, picked: Flags) -> Array:
    """Root mean square of each run, drawn to that of all where it has few rows; runs without any have that of all."""
    runs = int(series.run.max()) + 1
    squares = np.bincount(series.run[picked], values[picked] ** 2, runs)
    counts = np.bincount(series.run[picked], minlength=runs)
    whole = float(squares.sum() / max(counts.sum(), 1))
    return np.asarray(np.maximum(np.sqrt((squares + DRAWN * whole) / (counts + DRAWN)), 1.0))
