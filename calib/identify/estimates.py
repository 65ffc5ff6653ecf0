"""Each parameter with its standard deviation and interval, considering bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.parameters import Parameter
from calib.arrays import Array
from calib.identify.determinability import NOTICEABLE, Determinability, determinability
from calib.identify.objective import Objective
from calib.identify.sensitivity import Sensitivity
from calib.identify.spread import NoiseScale, leverages, noise_scale

AT_BOUND = 1.0 - 1e-6  # a deviation beyond this share of its bound is at the bound
LEVEL = 0.95
KINK = 1e-3  # of the median distance: a smaller residual is at the kink of its objective


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter: nominal value, identified deviation, uncertainty. All in its unit (m, rad or its own).

    `sd` is NaN if the deviation is at its bound; then see `interval`.
    `interval`: 95 % for the deviation, if the true one is within the bounds. `undetermined_share`: 0 if the data determine
    it, 1 if they do not; undetermined parts count as nominal in `sd` and `interval`.
    """

    parameter: Parameter
    deviation: float
    sd: float
    undetermined_share: float
    interval: tuple[float, float] = (float("nan"), float("nan"))

    @property
    def value(self) -> float:
        """Nominal plus deviation."""
        return self.parameter.nominal + self.deviation

    @property
    def is_determined(self) -> bool:
        """Whether the data determine this parameter by itself."""
        return self.undetermined_share <= NOTICEABLE

    @property
    def is_at_bound(self) -> bool:
        """Whether the bound keeps the deviation from growing."""
        return abs(self.deviation) >= AT_BOUND * self.parameter.bound


@dataclass(frozen=True, slots=True)
class Estimation:
    """Estimates, the noise of the residuals, and what the points determine."""

    estimates: tuple[Estimate, ...]
    noise: NoiseScale
    known: Determinability


def uncertainty(
    parameters: tuple[Parameter, ...],
    objective: Objective,
    x: Array,
    residuals: Array,
    sensitivity: Sensitivity,
) -> Estimation:
    """Uncertainty of the optimum x (k,) with residuals (m, 3)."""
    limits = np.array([parameter.limit for parameter in parameters])
    resting = np.abs(x) >= AT_BOUND * limits
    known = determinability(sensitivity.compact, parameters)
    free = np.flatnonzero(~resting)
    spread = np.zeros((len(x), 0))
    if len(free):
        part = determinability(sensitivity.compact[:, :, free], tuple(parameters[k] for k in free))
        spread = np.zeros((len(x), part.rank))
        spread[free] = part.spread
    shares = np.concatenate([leverages(part, spread) for _, part in sensitivity.blocks()])
    noise = noise_scale(objective, residuals, shares)
    sd = np.where(
        resting, np.nan, np.sqrt(noise.variance_m2 * np.einsum("ij,ij->i", known.spread, known.spread))
    )
    lower, upper = _intervals(x, limits, resting, known, noise, objective, residuals, sensitivity)
    scale = np.array([parameter.scale for parameter in parameters])
    estimates = tuple(
        Estimate(
            parameter,
            float(x[k] * scale[k]),
            float(sd[k] * scale[k]),
            float(known.undetermined_share[k]),
            (float(lower[k] * scale[k]), float(upper[k] * scale[k])),
        )
        for k, parameter in enumerate(parameters)
    )
    return Estimation(estimates, noise, known)


def _intervals(
    x: Array,
    limits: Array,
    resting: npt.NDArray[np.bool_],
    known: Determinability,
    noise: NoiseScale,
    objective: Objective,
    residuals: Array,
    sensitivity: Sensitivity,
) -> tuple[Array, Array]:
    """Scaled intervals, (k,) each: around the optimum without bounds, truncated at the bounds.

    That optimum is one Newton step away along the free gradient. A true value inside the bounds is
    covered as often as without truncation.
    """
    middle = x.copy()
    if resting.any():
        slope = _slope(objective, residuals, sensitivity, resting)
        outward = np.where(np.sign(slope) == -np.sign(x[resting]), slope, 0.0)
        middle -= known.spread @ (known.spread[resting].T @ outward) / noise.curvature
    half = noise.quantile(LEVEL) * np.sqrt(
        noise.variance_m2 * np.einsum("ij,ij->i", known.spread, known.spread)
    )
    return np.clip(middle - half, -limits, limits), np.clip(middle + half, -limits, limits)


def _slope(
    objective: Objective, residuals: Array, sensitivity: Sensitivity, resting: npt.NDArray[np.bool_]
) -> Array:
    """Derivative of the objective by each unknown at its bound.

    A residual at a kink has any score up to one: the one that keeps the other unknowns in place.
    """
    distances = objective.distances(residuals)
    across, _ = objective.weights(distances, 0.0)
    by_coordinate = len(distances) != len(residuals)
    score = (across.reshape(residuals.shape) if by_coordinate else across[:, None]) * residuals
    if not objective.is_smooth:
        is_near = distances < KINK * float(np.median(distances))
        kinked = is_near.reshape(residuals.shape) if by_coordinate else np.repeat(is_near[:, None], 3, axis=1)
        score[kinked] = 0.0
        pull = sensitivity.pulled(score)[~resting]
        scale = np.maximum(np.linalg.norm(sensitivity.compact[:, 0, ~resting], axis=0), 1e-300)
        answer, *_ = np.linalg.lstsq(
            (sensitivity.chosen(kinked)[:, ~resting] / scale).T, -pull / scale, rcond=1e-9
        )
        score[kinked] = np.clip(answer, -1.0, 1.0)
    return sensitivity.pulled(score)[resting]
