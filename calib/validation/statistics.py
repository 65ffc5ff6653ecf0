"""Statistics of distances, and significance of differences: Student's t, 95 %, two-sided; shares and quantiles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from calib.arrays import Array

CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class ErrorSummary:
    """Distances between target and measured tips: count, mean, root mean square, largest, standard deviation.

    `mean_half_width_m` is half the 95 % confidence interval of the mean (Student's t); NaN for fewer than two
    points.
    """

    count: int
    mean_m: float
    rms_m: float
    max_m: float
    sd_m: float
    mean_half_width_m: float


class PairedFinding(Enum):
    """Result of a paired difference."""

    BETTER = "better"
    WORSE = "worse"
    NOTHING = "no significant difference"


@dataclass(frozen=True, slots=True)
class Difference:
    """Distances before minus after at the same points: mean, and half its 95 % interval (NaN for one point)."""

    count: int
    mean_m: float
    half_width_m: float

    @property
    def lower_m(self) -> float:
        """Lower end of the 95 % interval."""
        return self.mean_m - self.half_width_m

    @property
    def upper_m(self) -> float:
        """Upper end of the 95 % interval."""
        return self.mean_m + self.half_width_m

    @property
    def finding(self) -> PairedFinding:
        """Better or worse only if the whole interval is; one point is not significant."""
        if self.lower_m > 0.0:
            return PairedFinding.BETTER
        return PairedFinding.WORSE if self.upper_m < 0.0 else PairedFinding.NOTHING

    def in_words(self) -> str:
        """Text such as `better by 12.3 mm [11.9, 12.7] (95 %)`, with significant digits only."""
        if math.isnan(self.half_width_m):
            if self.count > 1:
                alike = f"{1e3 * self.mean_m:+.3f} mm at all {self.count} points alike"
                return f"{PairedFinding.NOTHING.value}: {alike}, which tells no interval"
            return f"one point, {1e3 * self.mean_m:+.3f} mm: too few for an interval"
        digits = digits_mm(self.half_width_m)
        if self.finding is PairedFinding.NOTHING:
            return f"{self.finding.value}: {self._spelled(1.0, digits)}"
        sign = 1.0 if self.finding is PairedFinding.BETTER else -1.0
        return f"{self.finding.value} by {self._spelled(sign, digits)}"

    def _spelled(self, sign: float, digits: int) -> str:
        low, high = sorted((sign * self.lower_m, sign * self.upper_m))
        mean = sign * self.mean_m
        return f"{1e3 * mean:.{digits}f} mm [{1e3 * low:.{digits}f}, {1e3 * high:.{digits}f}] (95 %)"


def digits_mm(uncertainty_m: float) -> int:
    """Decimals of a length in mm, two significant digits of its uncertainty, 1 to 4."""
    if not uncertainty_m > 0.0:
        return 3
    return min(4, max(1, 1 - math.floor(math.log10(1e3 * uncertainty_m))))


def summarise(errors_m: Array) -> ErrorSummary:
    """Statistics of distances (m,)."""
    return ErrorSummary(
        count=len(errors_m),
        mean_m=float(np.mean(errors_m)),
        rms_m=float(np.sqrt(np.mean(errors_m**2))),
        max_m=float(np.max(errors_m)),
        sd_m=float(np.std(errors_m, ddof=1)) if len(errors_m) > 1 else math.nan,
        mean_half_width_m=mean_half_width(errors_m),
    )


def improvement_percent(before_m: float, after_m: float) -> float:
    """100 (before - after) / before; 0 where there was no error before."""
    return 100.0 * (1.0 - after_m / before_m) if before_m > 0.0 else 0.0


def difference(before_m: Array, after_m: Array) -> Difference:
    """Paired difference of distances (m,) at the same points."""
    each = before_m - after_m
    return Difference(len(each), float(np.mean(each)), mean_half_width(each))


def mean_half_width(values: Array) -> float:
    """Half the 95 % interval of the mean of values (m,): t s / sqrt(m); NaN where all are one value, which tells no scatter."""
    m = len(values)
    if m < 2 or np.ptp(values) == 0.0:
        return math.nan
    return student_t(m - 1) * float(np.std(values, ddof=1)) / math.sqrt(m)


def student_t(freedom: int) -> float:
    """Two-sided 95 % quantile of Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))


# Shares and quantiles of samples, with 95 % intervals.

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
