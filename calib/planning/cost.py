"""What a way of doing a task costs: the tip's expected error, and whether one way is surely better than another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import Predictor

DRAWS: Final = 200  # arms that the points allow
WORTH: Final = 0.99  # of the error, above which a change is not worth making
SURE: Final = 0.95  # of these, for which a way must be better before it is chosen


@dataclass(frozen=True, slots=True)
class Cost:
    """Root mean square distances over the poses of a task [m].

    rms_m: expected of one visit; drawn_m (DRAWS,): of each drawn arm. Parts of its square: known_m, which the arm's file does
    not correct; unknown_m, which the points leave open; scatter_m, from visit to visit.
    """

    rms_m: float
    known_m: float
    unknown_m: float
    scatter_m: float
    drawn_m: Array


class Judge:
    """Costs of ways by one prediction; all are judged by the same drawn arms."""

    def __init__(self, predictor: Predictor, seed: int = 0) -> None:
        self._predictor = predictor
        posterior = predictor.posterior
        self._off = (posterior.draws(DRAWS, seed) - posterior.mean).T

    def squares_m2(self, poses: Conditions) -> Array:
        """Expected squared distance of one visit at each pose (m,)."""
        return np.asarray(self._predictor.at(poses).rms_m ** 2)

    def cost(self, poses: Conditions) -> Cost:
        """Over all poses alike."""
        error = self._predictor.at(poses)
        drawn = error.expected_m[:, :, None] + self._predictor.columns(poses) @ self._off
        scatter = np.trace(error.random_m2, axis1=1, axis2=2)
        unknown = np.trace(error.systematic_m2, axis1=1, axis2=2)
        known = np.sum(error.expected_m**2, axis=1)
        rms, *parts = (
            float(np.sqrt(part.mean())) for part in (known + unknown + scatter, known, unknown, scatter)
        )
        drawn_m = np.sqrt((np.sum(drawn**2, axis=1) + scatter[:, None]).mean(axis=0))
        return Cost(rms, parts[0], parts[1], parts[2], drawn_m)


def is_worth_it(one: Cost, than: Cost, plain: Cost) -> bool:
    """Whether a change from `than` to `one` is worth making, and `one` sure to be better than the plain way."""
    return one.rms_m < WORTH * than.rms_m and is_surely_better(one, plain)


def is_surely_better(one: Cost, other: Cost) -> bool:
    """Whether `one` is expected to be better, and is for nearly every arm that the points allow."""
    return one.rms_m < other.rms_m and float(np.mean(one.drawn_m < other.drawn_m)) >= SURE
