"""The noise of the residuals: what an estimate scatters by, and what is known beforehand counts against."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.identify.objective import Objective

ROUNDS_LIMIT = 60
SETTLED = 1e-5
LEVERAGE_LIMIT = 0.95  # a point that alone determines something gives no information on the noise
NORMAL_QUARTILE = 0.6745  # median of |e| of a normal e with standard deviation 1
BANDWIDTH = 1.06  # Silverman, Density Estimation, 1986, eq. (3.28): 1.06 sigma n^(-1/5)


@dataclass(frozen=True, slots=True)
class NoiseScale:
    """`variance_m2` times (J'J)^-1 is the covariance; the variance has `freedom` degrees of freedom.

    NaN and 0 if there are no more residuals than unknowns, or so few that they do not tell. `curvature` times J'J is the mean
    Hessian of the objective.
    """

    variance_m2: float
    freedom: float
    curvature: float

    def quantile(self, level: float = 0.95) -> float:
        """Half width of an interval in standard deviations: Student's t, two-sided."""
        from scipy.special import stdtrit

        return float(stdtrit(self.freedom, 0.5 + 0.5 * level)) if self.freedom > 0.0 else math.nan


def leverages(sensitivity: Array, spread: Array) -> Array:
    """H_i = J_i (J'J)^-1 J_i', (m, 3, 3), of the sensitivity (m, 3, k) and spread (k, rank): trace sums to the rank."""
    seen = sensitivity @ spread
    return np.asarray(seen @ seen.transpose(0, 2, 1))


def noise_scale(objective: Objective, residuals: Array, leverage: Array) -> NoiseScale:
    """Noise scale from residuals (m, 3) and leverages (m, 3, 3).

    Noise is assumed independent and identical for all points and axes. An estimate that minimises a sum of rho(residual)
    then has the covariance v (J'J)^-1, v = E[psi^2] / E[psi']^2 (Huber, Robust Statistics, 1981, ch. 7), psi = rho'. Both
    means are over true errors, but only residuals are known, and the fit has shrunk each towards zero, the more the
    larger the point's leverage h. Without the point, its residual would be r + h / (1 - h) psi(r) / c, c the mean of
    psi' (a one-step deletion; r / (1 - h) for least squares, where it is exact). That is a true error plus, independent
    of it, the error of the rest's prediction, together 1 / (1 - h) times the variance of the error; so the means are over
    sqrt(1 - h) times that. For least squares v is the mean of r^2 / (1 - h), unbiased; sums of distances, whose residuals
    cluster at the kink, get the variance found in simulations.
    """
    distances = objective.distances(residuals)
    dimension = 3 if len(distances) == len(residuals) else 1
    axes = np.einsum("ijj->ij", leverage)
    shares = np.minimum(axes.mean(axis=1) if dimension == 3 else axes.ravel(), LEVERAGE_LIMIT)
    freedom = dimension * (len(distances) - float(shares.sum()))
    if freedom < 0.5:
        return NoiseScale(math.nan, 0.0, math.inf)
    if not np.max(distances) > 0.0:
        return NoiseScale(0.0, 0.0, math.inf)
    curvature = float(np.mean(_bends(objective, distances / np.sqrt(1.0 - shares), dimension)))
    scores = bends = np.zeros(0)
    for _ in range(ROUNDS_LIMIT):
        pulls = objective.weights(distances, 0.0)[0] * distances / curvature
        errors = np.sqrt(1.0 - shares) * (distances + shares / (1.0 - shares) * pulls)
        scores = (objective.weights(errors, 0.0)[0] * errors) ** 2 / dimension
        bends = _bends(objective, errors, dimension)
        before, curvature = curvature, float(np.mean(bends))
        if abs(curvature - before) < SETTLED * before:
            break
    variance = float(np.mean(scores)) / curvature**2
    if not variance <= (float(np.max(distances)) / (1.0 - LEVERAGE_LIMIT)) ** 2:
        return NoiseScale(math.nan, 0.0, math.inf)  # too few residuals: the rounds do not settle
    return NoiseScale(variance, _freedom(scores, bends, freedom / (dimension * len(distances))), curvature)


def _freedom(scores: Array, bends: Array, share: float) -> float:
    """Degrees of freedom of a chi-square that varies as the variance does (Satterthwaite, Biometrics 2 (1946) 110).

    To first order ln v changes by score_i / mean - 2 bend_i / mean with each point.
    """
    influence = scores / np.mean(scores) - 2.0 * bends / np.mean(bends)
    relative = float(np.var(influence)) / (len(scores) * share)
    return min(2.0 / relative if relative > 0.0 else math.inf, 1e6)


def _bends(objective: Objective, errors: Array, dimension: int) -> Array:
    """Curvature of rho at errors, mean over the axes; at the kink of absolute coordinates twice the density there."""
    if dimension == 3:
        across, along = objective.weights(errors, 0.0)
        return np.asarray((2.0 * across + along) / 3.0)
    sigma = float(np.median(errors)) / NORMAL_QUARTILE
    width = BANDWIDTH * sigma * len(errors) ** -0.2
    shrunk = errors * math.sqrt(1.0 - (width / sigma) ** 2)  # so that smoothing does not change the variance
    return np.asarray(2.0 * np.exp(-0.5 * (shrunk / width) ** 2) / (math.sqrt(2.0 * math.pi) * width))
