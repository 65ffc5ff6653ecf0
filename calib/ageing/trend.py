"""What drifts and how fast, with intervals: zeros of joints from calibrations, parameters of effects from gaps.

The geometry's drift (`calib.ageing.line`) is explained by rates of the joints' zeros as far as it can be; the rest is tested by
chi-squared. Scatter beyond the entries' own intervals widens all intervals (Birge's ratio). Two entries give no such check:
their intervals are those of their standard deviations alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.ageing.history import Entry
from calib.ageing.line import KNOWN, Line, line_of
from calib.arrays import Array
from calib.gap.finding import EffectName
from control.model.arm import Arm

YEAR_days: Final = 365.25
LEVEL: Final = 0.95  # of the intervals that are shown
SURE: Final = 0.99  # of the interval that must exclude 0, since many quantities are looked at
UNSTEADY: Final = 0.001  # probability of the scatter under the entries' own intervals, below which it is said
LEAST: Final = 3  # entries: a straight line through two always fits


@dataclass(frozen=True, slots=True)
class Rate:
    """Change in a year, or by a step, in the quantity's unit; `half` of its 95 % interval; drifts: the 99 % interval excludes 0.

    value: at the last of `count` entries. Rate and half are infinite where the entries do not tell.
    """

    name: str
    unit: str
    value: float
    change: float
    half: float
    drifts: bool
    count: int


@dataclass(frozen=True, slots=True)
class GeometryTrend:
    """The line through the calibrations, the rates of the joints' zeros, and what they leave.

    rest_drifts: geometry beyond the zeros changes. is_steady: the calibrations lie on the line as well as they say. odd: when
    they do not, the one without which the others do, if there is one.
    """

    line: Line
    zeros: tuple[Rate, ...]
    rest_drifts: bool
    is_steady: bool
    odd: Entry | None


def geometry_trend(arm: Arm, entries: Sequence[Entry]) -> GeometryTrend | None:
    """None with calibrations of fewer than two days."""
    line = line_of(arm, entries)
    if line is None:
        return None
    is_steady = _is_steady(line)
    zeros, rest_drifts = by_zeros(line, YEAR_days)
    return GeometryTrend(line, zeros, rest_drifts, is_steady, None if is_steady else _odd(arm, entries))


def by_zeros(line: Line, days: float) -> tuple[tuple[Rate, ...], bool]:
    """The line's rate over so many `days` as changes of the joints' zeros, and whether they leave more than uncertainty."""
    from scipy.stats import chi2

    told = np.flatnonzero(np.isfinite(line.toward).all(axis=0))
    toward, info = line.toward[:, told], line.information
    covariance = np.linalg.pinv(toward.T @ info @ toward, rcond=KNOWN, hermitian=True)
    speeds = covariance @ toward.T @ info @ line.rate
    rest = line.rate - toward @ speeds
    freedom = max(0, len(line.rate) - len(told))
    zeros = tuple(
        _zero(line, joint, days * float(speed), days * math.sqrt(variance))
        for joint, speed, variance in zip(told.tolist(), speeds, np.diag(covariance), strict=True)
    )
    return zeros, freedom > 0 and float(chi2.sf(float(rest @ info @ rest), freedom)) < 1.0 - SURE


def _is_steady(line: Line) -> bool:
    from scipy.stats import chi2

    return not line.freedom or float(chi2.sf(line.chi_squared, line.freedom)) >= UNSTEADY


def _odd(arm: Arm, entries: Sequence[Entry]) -> Entry | None:
    """The only calibration without which LEAST or more others lie on a line."""
    found = []
    for one in (one for one in entries if one.geometry is not None):
        line = line_of(arm, [other for other in entries if other is not one])
        if line is not None and line.count >= LEAST and line.freedom and _is_steady(line):
            found.append(one)
    return found[0] if len(found) == 1 else None


def _zero(line: Line, joint: int, change: float, sd: float) -> Rate:
    half, sure = (_quantile(level, line.freedom) * sd for level in (LEVEL, SURE))
    return Rate(
        f"joint {joint + 1}: zero",
        "rad",
        float(line.zeros_rad[joint]),
        change,
        half,
        abs(change) > sure,
        line.count,
    )


def _quantile(level: float, freedom: int) -> float:
    """Of Student's t; of the normal distribution where nothing checks the standard deviations."""
    from scipy.stats import norm, t

    upper = 0.5 + 0.5 * level
    return float(t.ppf(upper, freedom) if freedom else norm.ppf(upper))


def quantity_rates(entries: Sequence[Entry]) -> tuple[Rate, ...]:
    """Of every quantity that entries of at least two days have, by name."""
    names = sorted({name for one in entries for name in one.quantities})
    found = (_quantity_rate(name, [one for one in entries if name in one.quantities]) for name in names)
    return tuple(one for one in found if one is not None)


def _quantity_rate(name: str, entries: Sequence[Entry]) -> Rate | None:
    """Weighted least squares; equal weights, and their scatter alone, where a standard deviation is unknown."""
    days = np.array([one.day for one in entries]) - entries[-1].day
    if len(set(days.tolist())) < 2:
        return None
    values = np.array([one.quantities[name].value for one in entries])
    sds = np.array([one.quantities[name].sd or math.nan for one in entries])
    is_known, freedom = bool(np.isfinite(sds).all()), len(entries) - 2
    speed, variance, left = _straight(days, values, 1.0 / sds**2 if is_known else np.ones(len(values)))
    scatter = left / freedom if freedom else (1.0 if is_known else math.inf)
    sd = math.sqrt(variance * (max(1.0, scatter) if is_known else scatter)) * YEAR_days
    half, sure = (_quantile(level, freedom) * sd for level in (LEVEL, SURE))
    change = speed * YEAR_days
    return Rate(words_of(name), "", float(values[-1]), change, half, abs(change) > sure, len(entries))


def _straight(days: Array, values: Array, weights: Array) -> tuple[float, float, float]:
    """Slope of the line through the values, its variance for unit weights' variance, and chi-squared."""
    middle = float(weights @ days / weights.sum())
    across = float(weights @ (days - middle) ** 2)
    speed = float(weights @ ((days - middle) * values)) / across
    left = values - float(weights @ values / weights.sum()) - speed * (days - middle)
    return speed, 1.0 / across, float(weights @ left**2)


def words_of(quantity: str) -> str:
    """backlash2.width_rad: backlash on joint 2: width_rad."""
    effect, _, parameter = quantity.partition(".")
    kind = effect.rstrip("0123456789")
    number = effect.removeprefix(kind)
    return f"{EffectName(kind, int(number) if number else None)}: {parameter}"
