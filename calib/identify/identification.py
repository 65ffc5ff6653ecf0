"""The whole identification: from points to DH deviations with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib.arm_problem.checks import require_sound
from calib.arm_problem.expansion import Problem
from calib.arm_problem.problem import ArmProblem, ModelValues
from calib.arm_problem.weighted import WeightedProblem, posed_part, whole_problem
from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from calib.identify.budget import Accuracy
from calib.identify.determinability import Sensitivity
from calib.identify.estimates import Estimate, NoiseScale, uncertainty
from calib.identify.objective import Objective, SumOfDistances, value_of
from calib.identify.open_combinations import Undetermined, open_in_words
from calib.identify.solver import Minimum, minimise

__all__ = ["Estimate", "Identification", "fit", "identify"]


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
    singular_values: Array
    undetermined: tuple[Undetermined, ...]
    steps_count: int
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
    def sd(self) -> Array:
        """Standard deviations of the free parameters, (k,); NaN at a bound."""
        return frozen([estimate.sd for estimate in self.estimates])

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

    @property
    def rms_after_m(self) -> float:
        """Root mean square distance after identification."""
        return float(np.sqrt(np.mean(norms(self.error_after_m) ** 2)))

    def in_words(self) -> tuple[str, ...]:
        """Sentences for the operator: what the data determine and what not."""
        return tuple(_sentences(self))


def fit(
    problem: ArmProblem, objective: Objective | None = None, starts_count: int = 4, seed: int = 0
) -> tuple[Minimum, Objective]:
    """The optimum only, and the minimised objective: Huber's without a threshold derives it from the noise."""
    _, best = _solved(problem, objective or SumOfDistances(), starts_count, seed)
    return replace(best, x=best.x[: len(problem.parameters)]), best.objective


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
    found = uncertainty(whole.parameters, wanted, best.x, after, Sensitivity.at(whole, best.x))
    return Identification(
        objective=wanted.name,
        solution=problem.solution(x),
        nominal_dh=frozen(problem.model.nominal_dh),
        estimates=found.estimates,
        objective_before=value_of(wanted, before),
        objective_after=value_of(wanted, after),
        error_before_m=frozen(problem.residuals(np.zeros(len(x)))),
        error_after_m=frozen(problem.residuals(x)),
        noise_m=float(np.sqrt(np.sum(after**2) / max(1, after.size - found.known.rank))),
        rank=found.known.rank,
        condition_number=found.known.condition_number,
        singular_values=found.known.singular_values,
        undetermined=found.known.undetermined,
        steps_count=best.steps_count,
        is_converged=best.is_converged,
        x=frozen(x),
        noise=found.noise,
        accuracy=best.accuracy,
        orientation=_orientation(whole, best.x),
        weighted=_weighted(whole, found.noise),
    )


def _require_plain(problem: ArmProblem, accuracy_limit_m: float | None) -> None:
    """CalibrationError for a required accuracy of points that do not count alike."""
    if accuracy_limit_m is not None and whole_problem(problem) is not problem:
        raise CalibrationError(
            "a required accuracy is one of positions that count alike: leave it out, or qw, qx, qy, qz and the covariances of the"
            " points"
        )


def _solved(
    problem: ArmProblem,
    objective: Objective,
    starts_count: int,
    seed: int,
    accuracy_limit_m: float | None = None,
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
        sentences.append(
            f"At the bound, but not determined individually by these points: {', '.join(loose)}."
        )
    return sentences
