"""What is minimised: a sum over points of rho(|residual|).

The solver asks an objective only for rho and its first two derivatives, so Huber's loss is one more class
here. A sum of absolute coordinates is the same with every coordinate as a point of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.arrays import Array, norms


class Objective(Protocol):
    """Sum of rho(s) over points, s the distance between measured and modelled tip; rho convex, rising."""

    @property
    def name(self) -> str:
        """For tables and files."""

    @property
    def is_smooth(self) -> bool:
        """Whether rho has no kink at zero."""

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """The sum; `smoothing_m` rounds a kink at zero off, 0 is the objective itself."""

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """rho'(s) / s and rho''(s) of each point: curvature across and along the residual."""


@dataclass(frozen=True, slots=True)
class SumOfDistances:
    """E2 = sum of |measured - modelled|, SpringerPlus 5:1771, eq. (4) with Euclidean norms; the default."""

    name: str = "E2: sum of distances"
    is_smooth: bool = False

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """Sum of sqrt(s^2 + smoothing^2)."""
        return float(np.sum(np.hypot(distances_m, smoothing_m)))

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """1/sqrt(s^2 + e^2) and e^2/sqrt(s^2 + e^2)^3, of s and smoothing e."""
        across = 1.0 / np.maximum(np.hypot(distances_m, smoothing_m), 1e-15)
        return across, smoothing_m**2 * across**3


@dataclass(frozen=True, slots=True)
class LeastSquares:
    """Half the sum of squared distances."""

    name: str = "LSQ: half the sum of squared distances"
    is_smooth: bool = True

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """Sum of s^2 / 2; there is no kink to smooth."""
        return 0.5 * float(distances_m @ distances_m)

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """1 and 1."""
        ones = np.ones_like(distances_m)
        return ones, ones


def value_of(objective: Objective, residuals: Array, smoothing_m: float = 0.0) -> float:
    """The objective of residuals (m, 3)."""
    return objective.value(norms(residuals), smoothing_m)


def noise_variance(objective: Objective, residuals: Array, rank: int) -> float:
    """sigma^2 such that sigma^2 (J'J)^-1 is the covariance of the estimate, [m^2], isotropic noise taken for
    granted.

    Sandwich of an M-estimator (Huber, Robust Statistics, 1981, ch. 7): mean of psi psi' over the square of
    the mean curvature, with 3m / (3m - rank) for what the fit has taken out of the residuals.
    """
    distances = norms(residuals)
    freedom = 3 * len(distances) - rank
    if freedom <= 0:
        return float("nan")
    across, along = objective.weights(distances, 1e-6 * float(np.median(distances)))
    score = np.mean((across * distances) ** 2) / 3.0
    curvature = np.mean(2.0 * across + along) / 3.0
    return float(score / curvature**2 * 3 * len(distances) / freedom)
