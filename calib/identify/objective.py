"""Objectives: a sum over points of rho(residual), rho convex.

A residual r (3,) is measured minus modelled tip. Sums of distances or of absolute coordinates have a kink at zero. It is
rounded off, |v| becomes sqrt(v^2 + e^2), and the curvature uses a separate dual z, |z| <= 1, that converges to
v / |v| (Chan, Golub, Mulet, SIAM Journal on Scientific Computing 20 (1999) 1964): Newton's method then works down to
e = 0, where z = v / sqrt(v^2 + e^2) fails.
"""

from __future__ import annotations

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
