"""The whole identification: from points to DH deviations with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm_problem.checks import require_sound
from calib.arm_problem.problem import ArmProblem, Solution
from calib.arrays import Array, frozen, norms
from calib.identify.budget import Accuracy
from calib.identify.estimates import Estimate, uncertainty
from calib.identify.objective import Objective, SumOfDistances, value_of
from calib.identify.open_combinations import Undetermined, open_in_words
from calib.identify.solver import Minimum, minimise
from calib.identify.spread import NoiseScale

__all__ = ["Estimate", "Identification", "fit", "identify"]


@dataclass(frozen=True, slots=True)
class Identification:
    """The result. Objectives in their unit; errors are vectors measured minus modelled, (m, 3).

    `x` (k,): the scaled unknowns; `noise`: the noise scale of the standard deviations.
    """

    objective: str
    solution: Solution
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
    best = minimise(problem, objective or SumOfDistances(), starts_count, seed, equal="by noise")
    return best, best.objective


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
    best = minimise(problem, objective or SumOfDistances(), starts_count, seed, accuracy_limit_m, "by noise")
    wanted = best.objective
    before = problem.residuals(np.zeros(len(best.x)))
    after, sensitivity = problem.residuals(best.x), problem.sensitivity(best.x)
    found = uncertainty(problem.parameters, wanted, best.x, after, sensitivity)
    solution = problem.solution(best.x)
    return Identification(
        objective=wanted.name,
        solution=solution,
        nominal_dh=frozen(problem.model.nominal_dh),
        estimates=found.estimates,
        objective_before=value_of(wanted, before),
        objective_after=value_of(wanted, after),
        error_before_m=frozen(before),
        error_after_m=frozen(after),
        noise_m=float(np.sqrt(np.sum(after**2) / max(1, after.size - found.known.rank))),
        rank=found.known.rank,
        condition_number=found.known.condition_number,
        singular_values=found.known.singular_values,
        undetermined=found.known.undetermined,
        steps_count=best.steps_count,
        is_converged=best.is_converged,
        x=frozen(best.x),
        noise=found.noise,
        accuracy=best.accuracy,
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
