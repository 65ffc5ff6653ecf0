"""Objectives: a sum over points of rho(residual), rho convex; and the noise of the residuals that one leaves.

A residual r (3,) is measured minus modelled tip. Sums of distances or of absolute coordinates have a kink at zero. It is
rounded off, |v| becomes sqrt(v^2 + e^2), and the curvature uses a separate dual z, |z| <= 1, that converges to
v / |v| (Chan, Golub, Mulet, SIAM Journal on Scientific Computing 20 (1999) 1964): Newton's method then works down to
e = 0, where z = v / sqrt(v^2 + e^2) fails.

The noise is what an estimate scatters by, and what is known beforehand counts against.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.arrays import Array, norms
from calib.errors import CalibrationError

TINY_m = 1e-15
# Huber's threshold in standard deviations of one coordinate: 95 % of the efficiency of least squares if the noise is
# normal, for residuals of three coordinates (for one coordinate it is 1.345).
HUBER_BEND = 1.628
MEDIAN_OF_NORM = 1.5382  # median length of a normal vector of three coordinates with standard deviation 1
LEAST_BEND_m = 1e-9


class Objective(Protocol):
    """The sum over points. `smoothing_m` rounds a kink at zero off; 0 is the objective itself."""

    @property
    def name(self) -> str:
        """Name for tables and files."""

    @property
    def is_smooth(self) -> bool:
        """Whether rho has no kink at zero."""

    def distances(self, residuals: Array) -> Array:
        """Arguments of rho: lengths (m,) of residuals (m, 3), or their absolute coordinates (3m,)."""

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """The sum of rho."""

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """rho'(s) / s and rho''(s) of each distance s: curvature across and along the residual."""

    def expansion(self, residuals: Array, smoothing_m: float, dual: Array | None) -> tuple[Array, Array | None]:
        """First derivative (m, 3), and second as diagonals (3, m) or matrices (3, 3, m); None for ones.

        `dual` (m, 3), or None at the start.
        """

    def next_dual(self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None) -> Array | None:
        """The dual after a step that took `residuals` (m, 3) to `moved`; None if there is no kink."""


class _Rounded:
    """The sum of |s|, its kink at zero rounded off: sqrt(s^2 + smoothing^2)."""

    __slots__ = ()

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """Sum of sqrt(s^2 + smoothing^2)."""
        lengths = np.hypot(distances_m, smoothing_m) if smoothing_m else np.abs(distances_m)
        return float(np.sum(lengths))

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """1/sqrt(s^2 + e^2) and e^2/sqrt(s^2 + e^2)^3, of s and smoothing e."""
        across = 1.0 / np.maximum(np.hypot(distances_m, smoothing_m), TINY_m)
        return across, smoothing_m**2 * across**3


@dataclass(frozen=True, slots=True)
class SumOfDistances(_Rounded):
    """E2 = sum of |measured - modelled|, SpringerPlus 5:1771, eq. (4) with Euclidean norms; the default. [m]"""

    name: str = "E2: sum of distances"
    is_smooth: bool = False

    def distances(self, residuals: Array) -> Array:
        """Lengths, (m,)."""
        return norms(residuals)

    def expansion(self, residuals: Array, smoothing_m: float, dual: Array | None) -> tuple[Array, Array | None]:
        """U = r / sqrt(|r|^2 + e^2) and (1 - (z u' + u z') / 2) / sqrt(|r|^2 + e^2)."""
        across, _ = self.weights(norms(residuals), smoothing_m)
        unit = residuals * across[:, None]
        z, u = (unit if dual is None else dual).T, unit.T
        half = 0.5 * across * z
        bend = -(half[:, None] * u[None] + u[:, None] * half[None])
        bend[[0, 1, 2], [0, 1, 2]] += across
        return unit, bend

    def next_dual(self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None) -> Array | None:
        """Z + dz = (dr - z (u . dr)) / sqrt(|r|^2 + e^2) + u, brought back to |z| <= 1."""
        across = self.weights(norms(residuals), smoothing_m)[0][:, None]
        unit, step = residuals * across, moved - residuals
        z = unit if dual is None else dual
        wanted = across * (step - z * np.einsum("ij,ij->i", unit, step)[:, None]) + unit
        return np.asarray(wanted / np.maximum(1.0, norms(wanted))[:, None])


@dataclass(frozen=True, slots=True)
class SumOfCoordinates(_Rounded):
    """E1 = sum of |x| + |y| + |z| of measured minus modelled, the other reading of SpringerPlus 5:1771, eq. (4). [m]"""

    name: str = "E1: sum of absolute coordinates"
    is_smooth: bool = False

    def distances(self, residuals: Array) -> Array:
        """Absolute coordinates, (3m,)."""
        return np.abs(residuals).ravel()

    def expansion(self, residuals: Array, smoothing_m: float, dual: Array | None) -> tuple[Array, Array | None]:
        """U = r / sqrt(r^2 + e^2) and (1 - z u) / sqrt(r^2 + e^2), coordinate by coordinate."""
        across, _ = self.weights(residuals, smoothing_m)
        unit = residuals * across
        return unit, (across * (1.0 - (unit if dual is None else dual) * unit)).T

    def next_dual(self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None) -> Array | None:
        """As for E2, coordinate by coordinate."""
        across, _ = self.weights(residuals, smoothing_m)
        unit = residuals * across
        z = unit if dual is None else dual
        return np.clip(across * (moved - residuals) * (1.0 - z * unit) + unit, -1.0, 1.0)


@dataclass(frozen=True, slots=True)
class LeastSquares:
    """Half the sum of squared distances. [m^2]"""

    name: str = "LSQ: half the sum of squared distances"
    is_smooth: bool = True

    def distances(self, residuals: Array) -> Array:
        """Lengths, (m,)."""
        return norms(residuals)

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """Sum of s^2 / 2; there is no kink to smooth."""
        return 0.5 * float(distances_m @ distances_m)

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """1 and 1."""
        ones = np.ones_like(distances_m)
        return ones, ones

    def expansion(self, residuals: Array, smoothing_m: float, dual: Array | None) -> tuple[Array, Array | None]:
        """R and ones."""
        return residuals, None

    def next_dual(self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None) -> Array | None:
        """None: there is no kink."""
        return None


@dataclass(frozen=True, slots=True)
class Huber:
    """s^2 / 2 up to a distance s of `threshold_m` = t, t s - t^2 / 2 beyond (Huber, Robust Statistics, 1981). [m^2]

    Without a threshold, it is derived from the noise: HUBER_BEND robust standard deviations of one coordinate.
    """

    threshold_m: float | None = None
    is_smooth: bool = True

    def __post_init__(self) -> None:
        """CalibrationError for an invalid threshold."""
        if self.threshold_m is not None and not 0.0 < self.threshold_m < np.inf:
            raise CalibrationError(f"threshold of the objective huber: expected a positive length in m, got {self.threshold_m}")

    @property
    def name(self) -> str:
        """Name with the threshold."""
        bend = "from the noise" if self.threshold_m is None else f"{1e3 * self.threshold_m:.4g} mm"
        return f"Huber: squared distances, linear beyond a threshold ({bend})"

    @property
    def bend_m(self) -> float:
        """The threshold; CalibrationError if it has not been settled."""
        if self.threshold_m is None:
            raise CalibrationError("threshold of the objective huber: not set yet; see settled_on")
        return self.threshold_m

    def settled_on(self, residuals: Array) -> Huber:
        """The objective with a threshold from residuals (m, 3) of a robust fit, if none was given."""
        if self.threshold_m is not None:
            return self
        deviation = float(np.median(norms(residuals))) / MEDIAN_OF_NORM
        return Huber(max(HUBER_BEND * deviation, LEAST_BEND_m))

    def distances(self, residuals: Array) -> Array:
        """Lengths, (m,)."""
        return norms(residuals)

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """The sum; there is no kink to smooth."""
        near = np.minimum(distances_m, self.bend_m)
        return float(np.sum(near * (distances_m - 0.5 * near)))

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """min(1, t / s), and 1 within the threshold, 0 beyond."""
        is_near = distances_m <= self.bend_m
        across = np.where(is_near, 1.0, self.bend_m / np.maximum(distances_m, self.bend_m))
        return across, is_near.astype(float)

    def expansion(self, residuals: Array, smoothing_m: float, dual: Array | None) -> tuple[Array, Array | None]:
        """R min(1, t / |r|); beyond the threshold t / |r| across the residual and 0 along it."""
        distances = norms(residuals)
        across, along = self.weights(distances, smoothing_m)
        unit = (residuals / np.maximum(distances, TINY_m)[:, None]).T
        bend = ((along - across) * unit)[:, None] * unit[None]
        bend[[0, 1, 2], [0, 1, 2]] += across
        return residuals * across[:, None], bend

    def next_dual(self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None) -> Array | None:
        """None: there is no kink."""
        return None


def objective_named(name: str, threshold_m: float | None = None) -> Objective:
    """The objective called e2, e1, lsq or huber; `threshold_m` is huber's. CalibrationError for another."""
    if threshold_m is not None and name != "huber":
        raise CalibrationError(f"threshold of {threshold_m} m: only the objective huber has a threshold, got objective {name}")
    known: dict[str, Objective] = {
        "e2": SumOfDistances(),
        "e1": SumOfCoordinates(),
        "lsq": LeastSquares(),
        "huber": Huber(threshold_m),
    }
    if name not in known:
        raise CalibrationError(f'objective "{name}": expected one of {", ".join(known)}')
    return known[name]


def value_of(objective: Objective, residuals: Array, smoothing_m: float = 0.0) -> float:
    """The objective of residuals (m, 3)."""
    return objective.value(objective.distances(residuals), smoothing_m)


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
