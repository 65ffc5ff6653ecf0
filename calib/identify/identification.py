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
from calib.identify.determinability import NOTICEABLE, Determinability, Sensitivity, Undetermined, determinability, open_in_words
from calib.identify.objective import Objective, SumOfDistances, value_of
from calib.identify.solver import Accuracy, Minimum, minimise

# Each parameter with its standard deviation and interval, considering bounds.

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
    parameters: tuple[Parameter, ...], objective: Objective, x: Array, residuals: Array, sensitivity: Sensitivity
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
    free_sd = np.sqrt(noise.variance_m2 * np.einsum("ij,ij->i", known.spread, known.spread))
    sd = np.where(resting, np.nan, free_sd)
    # Around the optimum without bounds, one Newton step away along the free gradient, and truncated at the bounds: a true value
    # inside them is covered as often as without truncation.
    middle = x.copy()
    if resting.any():
        slope = _slope(objective, residuals, sensitivity, resting)
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
            float(known.undetermined_share[k]),
            (float(lower[k] * scale[k]), float(upper[k] * scale[k])),
        )
        for k, parameter in enumerate(parameters)
    )
    return Estimation(estimates, noise, known)


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
    estimation = uncertainty(whole.parameters, wanted, best.x, after, Sensitivity.at(whole, best.x))
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
