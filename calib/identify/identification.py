"""The whole identification: from points to DH deviations with their uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import Parameter
from calib.arm_problem.checks import require_sound
from calib.arm_problem.expansion import Problem
from calib.arm_problem.posed import WeightedProblem, posed_part, whole_problem
from calib.arm_problem.problem import ArmProblem, ModelValues
from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from calib.identify.descent import Prior
from calib.identify.determinability import NOTICEABLE, Determinability, Sensitivity, Undetermined, determinability, open_in_words
from calib.identify.objective import NoiseScale, Objective, SumOfDistances, leverages, noise_scale, value_of
from calib.identify.solver import Accuracy, Minimum, minimise

# Each parameter with its standard deviation and interval, considering bounds.

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
    prior: Prior | None = None,
) -> Estimation:
    """Uncertainty of the optimum x (k,) with residuals (m, 3). What the points determine is said of them alone."""
    limits = np.array([parameter.limit for parameter in parameters])
    resting = np.abs(x) >= AT_BOUND * limits
    of_points = known = determinability(sensitivity.compact, parameters)
    compact = sensitivity.compact
    if prior is not None:
        compact = np.concatenate((compact, prior.rows))
        known = determinability(compact, parameters)
    free = np.flatnonzero(~resting)
    spread = np.zeros((len(x), 0))
    if len(free):
        part = determinability(compact[:, :, free], tuple(parameters[k] for k in free))
        spread = np.zeros((len(x), part.rank))
        spread[free] = part.spread
    shares = np.concatenate([leverages(part, spread) for _, part in sensitivity.blocks()])
    noise = noise_scale(objective, residuals, shares)
    free_sd = np.sqrt(noise.variance_m2 * np.einsum("ij,ij->i", known.spread, known.spread))
    sd = np.where(resting, np.nan, free_sd)
    # Around the optimum without bounds, one Newton step away along the free gradient, and truncated at the bounds: a true value
    # inside them is covered as often as without truncation.
    middle = x.copy()
    if resting.any():
        slope = _slope(objective, residuals, sensitivity, resting)
        if prior is not None:
            slope = slope + (prior.weight * (x - prior.mean))[resting]
        outward = np.where(np.sign(slope) == -np.sign(x[resting]), slope, 0.0)
        middle -= known.spread @ (known.spread[resting].T @ outward) / noise.curvature
    half = noise.quantile(LEVEL) * free_sd
    lower, upper = np.clip(middle - half, -limits, limits), np.clip(middle + half, -limits, limits)
    scale = np.array([parameter.scale for parameter in parameters])
    estimates = tuple(
        Estimate(
            parameter,
            float(x[k] * scale[k]),
            float(sd[k] * scale[k]),
            float(of_points.undetermined_share[k]),
            (float(lower[k] * scale[k]), float(upper[k] * scale[k])),
        )
        for k, parameter in enumerate(parameters)
    )
    return Estimation(estimates, noise, of_points)


def _slope(objective: Objective, residuals: Array, sensitivity: Sensitivity, resting: npt.NDArray[np.bool_]) -> Array:
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
        answer, *_ = np.linalg.lstsq((sensitivity.chosen(kinked)[:, ~resting] / scale).T, -pull / scale, rcond=1e-9)
        score[kinked] = np.clip(answer, -1.0, 1.0)
    return sensitivity.pulled(score)[resting]


@dataclass(frozen=True, slots=True)
class OrientationFit:
    """What was identified from orientations: `rows` of the points that have one, errors (r, 3) as rotation vectors in the base
    frame, position noise over orientation noise, and the target's axes in the last link's frame (3, 3).
    """

    rows: tuple[int, ...]
    error_before_rad: Array
    error_after_rad: Array
    lever_m: float
    target: Array

    @property
    def mean_before_rad(self) -> float:
        """Mean angle at nominal."""
        return float(np.mean(norms(self.error_before_rad)))

    @property
    def mean_after_rad(self) -> float:
        """Mean angle after identification."""
        return float(np.mean(norms(self.error_after_rad)))

    def in_words(self) -> str:
        """A sentence for the operator."""
        return (
            f"{len(self.rows)} measured orientations: mean error {1e3 * self.mean_before_rad:.2f} mrad before,"
            f" {1e3 * self.mean_after_rad:.2f} mrad after."
        )

    def noise_ratio(self, position_m: Array) -> float:
        """Scatter of the orientations over that of the positions (m, 3), as a multiple of what the stated noises say."""
        turned = self.lever_m * float(np.sqrt(np.mean(self.error_after_rad**2)))
        return turned / max(float(np.sqrt(np.mean(position_m**2))), 1e-300)


@dataclass(frozen=True, slots=True)
class Identification:
    """The result. Objectives in their unit; errors are vectors measured minus modelled, (m, 3).

    `x` (k,): the scaled unknowns; `noise`: the noise scale of the standard deviations. `weighted`: scatter over what the points'
    covariances say, 1 if they are right, None if they have none; objectives and noise_m are then of a usual point. `unsettled_m`:
    by how much the last of the fits that follow loads moved all tips, where further ones would have gone on.
    """

    objective: str
    solution: ModelValues
    nominal_dh: Array
    estimates: tuple[Estimate, ...]
    objective_before: float
    objective_after: float
    error_before_m: Array
    error_after_m: Array
    noise_m: float
    rank: int
    condition_number: float
    undetermined: tuple[Undetermined, ...]
    is_converged: bool
    x: Array
    noise: NoiseScale
    accuracy: Accuracy | None = None
    orientation: OrientationFit | None = None
    weighted: float | None = None
    unsettled_m: float = 0.0

    @property
    def dh(self) -> Array:
        """The identified DH table (links, 4)."""
        return self.solution.dh

    @property
    def deviations(self) -> Array:
        """The difference dh - nominal_dh, (links, 4)."""
        return frozen(self.dh - self.nominal_dh)

    @property
    def binding(self) -> tuple[str, ...]:
        """Names of parameters at their bound."""
        return tuple(e.parameter.name for e in self.estimates if e.is_at_bound)

    @property
    def mean_before_m(self) -> float:
        """Mean distance at nominal."""
        return float(np.mean(norms(self.error_before_m)))

    @property
    def mean_after_m(self) -> float:
        """Mean distance after identification."""
        return float(np.mean(norms(self.error_after_m)))

    def in_words(self) -> tuple[str, ...]:
        """Sentences for the operator: what the data determine and what not."""
        return tuple(_sentences(self))


def identify(
    problem: ArmProblem,
    *,
    objective: Objective | None = None,
    starts_count: int = 4,
    seed: int = 0,
    accuracy_limit_m: float | None = None,
) -> Identification:
    """Find the deviations within their bounds that best explain the measured tips.

    `accuracy_limit_m` is the a of E <= k a (SpringerPlus 5:1771, eq. 4): see `accuracy` of the result.
    UnusablePointsError if the points allow no calibration. Deterministic for the same inputs and seed.
    """
    require_sound(problem)
    _require_plain(problem, accuracy_limit_m)
    whole, best = _solved(problem, objective or SumOfDistances(), starts_count, seed, accuracy_limit_m)
    wanted, x = best.objective, best.x[: len(problem.parameters)]
    before, after = whole.residuals(np.zeros(len(best.x))), whole.residuals(best.x)
    estimation = uncertainty(whole.parameters, wanted, best.x, after, Sensitivity.at(whole, best.x), best.prior)
    return Identification(
        objective=wanted.name,
        solution=problem.solution(x),
        nominal_dh=frozen(problem.model.nominal_dh),
        estimates=estimation.estimates,
        objective_before=value_of(wanted, before),
        objective_after=value_of(wanted, after),
        error_before_m=frozen(problem.residuals(np.zeros(len(x)))),
        error_after_m=frozen(problem.residuals(x)),
        noise_m=float(np.sqrt(np.sum(after**2) / max(1, after.size - estimation.known.rank))),
        rank=estimation.known.rank,
        condition_number=estimation.known.condition_number,
        undetermined=estimation.known.undetermined,
        is_converged=best.is_converged,
        x=frozen(x),
        noise=estimation.noise,
        accuracy=best.accuracy,
        orientation=_orientation(whole, best.x),
        weighted=_weighted(whole, estimation.noise),
    )


def _require_plain(problem: ArmProblem, accuracy_limit_m: float | None) -> None:
    """CalibrationError for a required accuracy of points that do not count alike."""
    if accuracy_limit_m is not None and whole_problem(problem) is not problem:
        raise CalibrationError(
            "a required accuracy is one of positions that count alike: leave it out, or qw, qx, qy, qz and the covariances of the"
            " points"
        )


def _solved(
    problem: ArmProblem, objective: Objective, starts_count: int, seed: int, accuracy_limit_m: float | None = None
) -> tuple[Problem, Minimum]:
    """The whole problem and its minimum. Covariances in a frame that was identified are turned to it, and all is solved again."""
    whole = whole_problem(problem)
    best = minimise(whole, objective, starts_count, seed, accuracy_limit_m, "by noise")
    if isinstance(whole, WeightedProblem) and problem.free_frames:
        frames = problem.solution(best.x[: len(problem.parameters)]).frames
        whole = whole_problem(problem, frames)
        best = minimise(whole, objective, starts_count, seed, equal="by noise")
    return whole, best


def _weighted(whole: Problem, noise: NoiseScale) -> float | None:
    """Scatter of the residuals over what the covariances say; None if the points have none."""
    if not isinstance(whole, WeightedProblem):
        return None
    return float(np.sqrt(noise.variance_m2)) / whole.unit_m


def _orientation(whole: Problem, x: Array) -> OrientationFit | None:
    posed = posed_part(whole)
    if posed is None:
        return None
    return OrientationFit(
        rows=tuple(posed.rows.tolist()),
        error_before_rad=frozen(posed.angles_rad(np.zeros(len(x)))),
        error_after_rad=frozen(posed.angles_rad(x)),
        lever_m=posed.lever_m,
        target=frozen(posed.target(x)),
    )


def _sentences(result: Identification) -> list[str]:
    """Rank and conditioning, correlated parameters, active bounds, convergence."""
    total = len(result.estimates)
    sentences = [
        f"These {len(result.error_after_m)} points determine {result.rank} of {total} parameters"
        f" (condition number {result.condition_number:.0f})."
    ]
    sentences += [f"{sentence}." for sentence in open_in_words(result.undetermined)]
    if made := sum(math.isfinite(estimate.parameter.sd) for estimate in result.estimates):
        sentences.append(
            f"Of {made} parameters the tolerances of the arm's file say how exactly they are made: it counts beside the points,"
            " against the scatter that the model leaves."
        )
    sentences += _about_bounds([estimate for estimate in result.estimates if estimate.is_at_bound])
    if not result.is_converged:
        sentences.append("The solver did not converge: do not trust the result; try more starts.")
    return sentences


def _about_bounds(bound: list[Estimate]) -> list[str]:
    """Two cases: the data require more, or they hardly determine the parameter and noise drove it to its bound."""
    wanting = [e.parameter.name for e in bound if e.is_determined]
    loose = [e.parameter.name for e in bound if not e.is_determined]
    sentences = []
    if wanting:
        sentences.append(
            f"At the bound: {', '.join(wanting)}. Possible causes: the deviation is larger than the bound, the data"
            " determine it too weakly, or an effect other than geometry is present."
        )
    if loose:
        sentences.append(f"At the bound, but not determined individually by these points: {', '.join(loose)}.")
    return sentences
