"""Identification from end to end: points in, DH deviations and how well they are known out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen, norms
from calib.identify.checks import require_usable
from calib.identify.determinability import NOTICEABLE, Undetermined, determinability
from calib.identify.objective import Objective, SumOfDistances, noise_variance, value_of
from calib.identify.parameters import Parameter
from calib.identify.problem import ArmProblem, Solution
from calib.identify.solver import minimise

AT_BOUND = 1.0 - 1e-6  # a scaled deviation beyond this rests on its bound


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter: what it was, what it is now, how well that is known. All in its unit (m or rad).

    `sd` is NaN where the deviation rests on its bound. `undetermined_share`: 0 the data determine it, 1 they
    say nothing.
    """

    parameter: Parameter
    deviation: float
    sd: float
    undetermined_share: float

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
class Identification:
    """What was found. Objectives in their unit; errors are vectors measured minus modelled, (m, 3)."""

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

    @property
    def dh(self) -> Array:
        """The identified DH table (links, 4)."""
        return self.solution.dh

    @property
    def deviations(self) -> Array:
        """Dh minus nominal_dh, (links, 4)."""
        return frozen(self.dh - self.nominal_dh)

    @property
    def sd(self) -> Array:
        """Standard deviations of the free parameters, (k,); NaN at a bound."""
        return frozen([estimate.sd for estimate in self.estimates])

    @property
    def binding(self) -> tuple[str, ...]:
        """Names of parameters that rest on their bound."""
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
        """What the data determine and what not, one sentence each, for the operator."""
        return tuple(_sentences(self))


def identify(
    problem: ArmProblem, *, objective: Objective | None = None, starts_count: int = 4, seed: int = 0
) -> Identification:
    """The deviations within their bounds that explain the measured tips best.

    UnusablePointsError if no calibration can be made of the points. Same inputs and seed, same result.
    """
    wanted: Objective = objective or SumOfDistances()
    require_usable(problem.observed.q_rad, problem.references_m)
    best = minimise(problem, wanted, starts_count, seed)
    before = problem.residuals(np.zeros(len(best.x)))
    after, jacobian = problem.residuals_and_jacobian(best.x)
    known = determinability(jacobian, problem.parameters)
    variance = noise_variance(wanted, after, known.rank)
    solution = problem.solution(best.x)
    return Identification(
        objective=wanted.name,
        solution=solution,
        nominal_dh=frozen(problem.model.nominal_dh),
        estimates=_estimates(problem.parameters, best.x, jacobian, variance, known.undetermined_share),
        objective_before=value_of(wanted, before),
        objective_after=value_of(wanted, after),
        error_before_m=frozen(before),
        error_after_m=frozen(after),
        noise_m=float(np.sqrt(np.sum(after**2) / max(1, after.size - known.rank))),
        rank=known.rank,
        condition_number=known.condition_number,
        singular_values=known.singular_values,
        undetermined=known.undetermined,
        steps_count=best.steps_count,
        is_converged=best.is_converged,
    )


def _estimates(
    parameters: tuple[Parameter, ...], x: Array, jacobian: Array, variance_m2: float, open_share: Array
) -> tuple[Estimate, ...]:
    """Deviation and standard deviation of each; those on a bound are known by the bound, not by the data."""
    limits = np.array([parameter.limit for parameter in parameters])
    free = np.flatnonzero(np.abs(x) < AT_BOUND * limits)
    sd = np.full(len(x), np.nan)
    if len(free):
        known = determinability(jacobian[:, :, free], tuple(parameters[k] for k in free))
        sd[free] = np.sqrt(np.diag(known.covariance(variance_m2)))
    return tuple(
        Estimate(p, float(x[k] * p.scale), float(sd[k] * p.scale), float(open_share[k]))
        for k, p in enumerate(parameters)
    )


def _sentences(result: Identification) -> list[str]:
    """Rank and conditioning, what moves together, bounds that bind, convergence."""
    total = len(result.estimates)
    said = [
        f"These {len(result.error_after_m)} points determine {result.rank} of {total} parameters"
        f" (condition number {result.condition_number:.0f})."
    ]
    said += [f"{group.words}." for group in result.undetermined]
    said += _about_bounds([estimate for estimate in result.estimates if estimate.is_at_bound])
    if not result.is_converged:
        said.append("The search did not end by itself: take the result with care and try more starts.")
    return said


def _about_bounds(bound: list[Estimate]) -> list[str]:
    """Two sorts: the data want more, or the data hardly hold the parameter and noise took it to its bound."""
    wanting = [e.parameter.name for e in bound if e.is_determined]
    loose = [e.parameter.name for e in bound if not e.is_determined]
    said = []
    if wanting:
        said.append(
            f"At the bound: {', '.join(wanting)}. The fit would go further if it could: the deviation is"
            " larger than the bound, the data are too weak to hold it, or an effect other than geometry is"
            " at work."
        )
    if loose:
        said.append(f"At the bound, though these points do not determine it alone: {', '.join(loose)}.")
    return said
