"""When the next calibration is due: when the tip, by the trend, has drifted from what the arm's file says by a tolerance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.ageing.line import Line
from calib.ageing.trend import LEAST
from calib.arrays import Array

DRAWS: Final = 4000
RISK: Final = 0.05  # of being later than the tolerance
FURTHEST: Final = 3.0  # times the recorded days: a line says nothing of what comes much later


@dataclass(frozen=True, slots=True)
class Due:
    """Days after the last calibration. `days`: until then the tip keeps the tolerance with a probability of 1 - RISK.

    middle_days: in the median. furthest_days: later than that is not said; both are at most this. now_m: root mean square of
    what the last calibration itself leaves uncertain.
    """

    tolerance_m: float
    days: float
    middle_days: float
    furthest_days: float
    now_m: float

    @property
    def is_open(self) -> bool:
        """Whether the tolerance is kept for as long as the record can say."""
        return self.days >= self.furthest_days


def due(line: Line, tolerance_m: float) -> Due | None:
    """By the drift of the geometry, root mean square over the workspace; None with fewer than LEAST calibrations."""
    if line.count < LEAST:
        return None
    start, speed = _drawn(line)
    constant, mixed, square = (
        np.einsum("dr,dr->d", one, other) / line.poses_count
        for one, other in ((start, start), (start, speed), (speed, speed))
    )
    days = _first_day(constant, mixed, square, tolerance_m)
    furthest = FURTHEST * line.days
    early, middle = (min(float(np.quantile(days, share, method="lower")), furthest) for share in (RISK, 0.5))
    return Due(tolerance_m, early, middle, furthest, math.sqrt(float(constant.mean())))


def _drawn(line: Line) -> tuple[Array, Array]:
    """Draws of the line's start and rate, (draws, r) each."""
    size, rng = len(line.rate), np.random.default_rng(0)
    values, vectors = np.linalg.eigh(line.covariance)
    normal = rng.standard_normal((DRAWS, 2 * size)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    if line.freedom:  # Student's t
        normal *= np.sqrt(line.freedom / rng.chisquare(line.freedom, DRAWS))[:, None]
    return line.start + normal[:, :size], line.rate + normal[:, size:]


def _first_day(constant: Array, mixed: Array, square: Array, tolerance_m: float) -> Array:
    """The first day on which constant + 2 mixed t + square t^2 reaches the tolerance's square."""
    room = tolerance_m**2 - constant
    with np.errstate(divide="ignore", invalid="ignore"):
        days = (-mixed + np.sqrt(np.maximum(0.0, mixed**2 + square * room))) / square
    return np.where(room <= 0.0, 0.0, np.where(square > 0.0, days, math.inf))
