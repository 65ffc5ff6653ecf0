"""The whole model as one linear problem: whitened residuals and columns of all terms, the geometry projected out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.poses.measured import Fit, Measured
from calib.gap.posterior.evidence import Gram
from calib.gap.posterior.term import Term

FREE_PRECISION = 1e-6  # of an unknown without a bound, in its own scale


@dataclass(frozen=True, slots=True)
class Linear:
    """Around a fit, of its R rows: geometry `base` (3R, K), values `y` (3R,) and columns (3R, p) in metres, weights (R, 3, 3).

    y is the residual with all geometry deviations and terms at zero, so that priors around zero mean what they say. The last
    unknowns of the geometry are the turn of the measured target, if there is one.
    """

    base: Array
    precision: Array
    y: Array
    columns: Array
    weight: Array
    places: tuple[slice, ...]
    measured: Measured

    @classmethod
    def around(
        cls,
        fit: Fit,
        lever_m: float,
        terms: Sequence[Term],
        moved: Array | None = None,
        weight: Array | None = None,
        follows: Array | None = None,
    ) -> Linear:
        """`moved` (m, 6): what terms that the fit's problem holds already do to tip and last link, to first order; `follows`
        (m, 6, k): how that follows the geometry.
        """
        measured = fit.measured(lever_m)
        count = measured.jacobian.shape[2]
        base = -measured.jacobian.reshape(-1, count)
        if follows is not None:
            rows = measured.rows_of(np.moveaxis(follows, 2, 0))
            base[:, : len(fit.x)] += rows.reshape(len(rows), -1).T
        columns = np.concatenate([measured.moved_by(one) for one in terms])
        ends = np.cumsum([one.count for one in terms])
        places = tuple(slice(int(end) - one.count, int(end)) for one, end in zip(terms, ends, strict=True))
        precision = np.full(count, FREE_PRECISION)
        precision[: len(fit.x)][[one.has_bound for one in fit.problem.parameters]] = 1.0
        known = measured.residual if moved is None else measured.residual + measured.rows_of(moved)
        y = known.ravel() + base[:, : len(fit.x)] @ fit.x
        root = np.tile(np.eye(3), (len(measured.pose), 1, 1)) if weight is None else weight
        return cls(base, precision, y, columns.reshape(len(columns), -1).T, root, places, measured)

    def projected(self, poses: Mask, noise_m: float, held: Array | None = None) -> Gram:
        """What evidence needs, from some poses (m,).

        `held` (r, K + p + 1): the holding currents' channel, geometry, columns and values in standard deviations. Both channels
        see one geometry: what the tips leave open of it is integrated out of the currents.
        """
        base, columns, y = (
            self.whitened(values, poses, noise_m) for values in (self.base, self.columns, self.y[:, None])
        )
        values = np.column_stack((columns, y))
        # the prior as rows of its own: what tips leave open, a factor 1e8 in size, is lost in normal equations
        q, r = np.linalg.qr(np.vstack((base, np.diag(np.sqrt(self.precision)))))
        fit = np.linalg.solve(r, q[: len(base)].T @ values)
        rest = np.vstack((values, np.zeros_like(fit))) - q @ (q[: len(base)].T @ values)
        seen = rest.T @ rest
        used = float(np.sum(q[: len(base)] ** 2))
        more = np.zeros_like(seen) if held is None else _beside(r.T @ r, fit, held)
        return Gram(
            seen[:-1, :-1],
            seen[:-1, -1],
            more[:-1, :-1],
            more[:-1, -1],
            float(seen[-1, -1]),
            len(base) - used,
        )

    def geometry(self, poses: Mask, noise_m: float, total: Array) -> Array:
        """Unknowns (K,) of the geometry beside the terms' move `total` (3R,)."""
        base = self.whitened(self.base, poses, noise_m)
        left = self.whitened((self.y - total)[:, None], poses, noise_m)[:, 0]
        rows = np.vstack((base, np.diag(np.sqrt(self.precision))))
        return np.asarray(np.linalg.lstsq(rows, np.concatenate((left, np.zeros(len(self.precision)))))[0])

    def whitened(self, values: Array, poses: Mask, noise_m: float) -> Array:
        """Values (3R, c) at some poses (m,), in standard deviations of the noise."""
        rows = self.measured.of(poses)
        own = values.reshape(len(rows), 3, -1)[rows]
        return np.asarray((self.weight[rows] / noise_m @ own).reshape(3 * int(rows.sum()), -1))


def _beside(known: Array, fit: Array, held: Array) -> Array:
    """Sums of squares of a second channel, whose values have their base where a first one fits it: `fit` (K, v) with the inverse
    covariance `known` (K, K). `held` (r, K + v): base and values.

    E' (I + B known^-1 B')^-1 E with E = values - B fit, by Woodbury's identity.
    """
    base = held[:, : len(known)]
    left = held[:, len(known) :] - base @ fit
    taken = np.linalg.solve(np.linalg.cholesky(known + base.T @ base), base.T @ left)
    return np.asarray(left.T @ left - taken.T @ taken)
