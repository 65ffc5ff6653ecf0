"""Is the prediction right on poses that it has not seen? A fifth of them is left out in turn, and predicted with its interval."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.trust.posterior import linearised, loose_play_m2, posterior_of

FOLDS: Final = 5
LEAST: Final = 10  # poses, below which nothing is left out
ELLIPSOID_95: Final = 7.815  # 95 % of chi-squared with three degrees of freedom


@dataclass(frozen=True, slots=True)
class Coverage:
    """How many of `count` poses lay inside their 95 % ellipsoids, and their root mean square distances [m].

    without_m: from the arm's own model; left_m: from the predicted error; predicted_m: what the ellipsoids promise.
    """

    count: int
    inside: int
    without_m: float
    left_m: float
    predicted_m: float

    @property
    def share(self) -> float:
        """Of the poses inside."""
        return self.inside / self.count


def coverage_of(problem: ArmProblem, at: Conditions, discrepancy: Discrepancy) -> Coverage | None:
    """Of the recorded poses, noise included; None with fewer than LEAST poses."""
    count = len(problem)
    if count < LEAST:
        return None
    fold = np.random.default_rng(0).permutation(count) % FOLDS
    squares, left, promised = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
    for k in range(FOLDS):
        held = fold == k
        left[held], covariance = _predicted(problem, at, discrepancy, held)
        squares[held] = np.einsum(
            "mi,mi->m", left[held], np.linalg.solve(covariance, left[held][:, :, None])[:, :, 0]
        )
        promised[held] = np.trace(covariance, axis1=1, axis2=2)
    before = problem.residuals(np.zeros(len(problem.parameters)))
    return Coverage(
        count,
        int((squares < ELLIPSOID_95).sum()),
        float(np.sqrt(np.mean(np.sum(before**2, axis=1)))),
        float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
        float(np.sqrt(np.mean(promised))),
    )


def _predicted(
    problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, held: np.ndarray
) -> tuple[Array, Array]:
    """What is left at the poses `held` (h, 3), and its predicted covariance (h, 3, 3)."""
    found = posterior_of(problem, at, discrepancy, ~held)
    discrepancy = discrepancy.knowing(found.odds)
    design, wanted = linearised(problem, at, discrepancy, found.x)
    rows = design[held]
    loose = loose_play_m2(discrepancy, at, problem.solution(found.x), found)[held]
    spread = np.einsum("mik,kl,mjl->mij", rows, found.covariance, rows, optimize=True)
    return wanted[held] - rows @ found.mean, spread + loose + found.noise_m**2 * np.eye(3)
