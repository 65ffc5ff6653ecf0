"""Shares and quantiles of samples, with 95 % intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array

Z95: Final = 1.959964


@dataclass(frozen=True, slots=True)
class IntervalFigure:
    """A value with its 95 % interval."""

    value: float
    lower: float
    upper: float


def proportion(met: int, count: int) -> IntervalFigure:
    """The share that `met` of `count` say (Wilson 1927)."""
    p = met / count
    centre = p + Z95**2 / (2.0 * count)
    spread = Z95 * math.sqrt(p * (1.0 - p) / count + Z95**2 / (4.0 * count * count))
    low, high = (centre - spread) / (1.0 + Z95**2 / count), (centre + spread) / (1.0 + Z95**2 / count)
    return IntervalFigure(p, max(0.0, min(p, low)), min(1.0, max(p, high)))


def quantile(values: Array, share: float) -> IntervalFigure:
    """A quantile; its interval is by order statistics (normal approximation of the binomial)."""
    ordered, count = np.sort(values), len(values)
    spread = Z95 * math.sqrt(count * share * (1.0 - share))
    low, high = (int(np.clip(round(count * share + way * spread), 0, count - 1)) for way in (-1, 1))
    middle = float(np.quantile(values, share))
    return IntervalFigure(middle, min(middle, float(ordered[low])), max(middle, float(ordered[high])))
