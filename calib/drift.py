"""What drifts between calibrations and how fast, what changed at once, and when the next one is due.

Geometry drifts along a straight line in time through several calibrations, each with its own uncertainty. Few DH parameters are
determined by themselves, and which combinations are depends on the parameters. So
geometry is compared where it shows, at the tip: each calibration's tips at fixed poses over the
workspace, by the full kinematics, relative to the last one's. Their coordinates c are along what
parameters can change there (left singular vectors of the tips' derivatives), so that |c|^2 / poses is the
mean square at the tip. Then c(t) = start + rate t, by generalised least squares; a step on a given day is
fitted in the same way, with its change in the place of the rate. Where a calibration identified the tool, too, coordinates are
across what another place of the tool does: along it, geometry and tool cannot be told apart.

The drift is explained by rates of the joints' zeros as far as it can be; the rest is tested by chi-squared. Parameters of effects
drift by gaps. Scatter beyond the entries' own intervals widens all intervals (Birge's ratio). Two entries give no such check:
their intervals are those of their standard deviations alone. One change between two calibrations, such as a slipped zero, may
explain a record which a straight line does not.

A calibration is due when the tip, by the trend, has drifted from what the arm's file says by a tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel, dh_names
from calib.arrays import Array
from calib.design.candidates import workspace_poses
from calib.gap.finding import EffectName
from calib.history import KNOWN, Entry, GeometryRecord, information_about
from calib.identify.determinability import RANK_TOLERANCE
from control.model.arm import Arm

POSES: Final = 150
DRAWN: Final = 5  # poses over the joints' ranges for each one that is used
HIDDEN: Final = 0.1  # of what a zero does at the tip, if another place of the tool does all but that
YEAR_days: Final = 365.25
LEVEL: Final = 0.95  # of the intervals that are shown
SURE: Final = 0.99  # of the interval that must exclude 0, since many quantities are looked at
UNSTEADY: Final = 0.001  # probability of the scatter under the entries' own intervals, below which it is said
LEAST: Final = 3  # entries: a straight line through two always fits
LEFT_MOST: Final = 0.1  # of a line's excess chi-squared: steady drift, an outlier or mere scatter leaves a step far more
DRAWS: Final = 4000
RISK: Final = 0.05  # of being later than the tolerance
FURTHEST: Final = 3.0  # times the recorded days: a line says nothing of what comes much later


@dataclass(frozen=True, slots=True)
class DriftLine:
    """Coordinates (r,) [m sqrt(poses)]: start at the last calibration, and rate [1/day], or a step's change;
    covariance (2 r, 2 r) of both.

    scatter: how much more the calibrations scatter than they say, at least 1; freedom: degrees of freedom of that, 0 of two
    calibrations; chi_squared: of their scatter. toward (r, n): one radian of each joint's zero, halfway; NaN: not in the record.
    zeros_rad (n,): at the last calibration, from arm.toml's. unseen: combinations of geometry that show at the tip and that the
    calibrations do not tell the drift of. is_tool_free: what another place of the tool does is left out.
    """

    poses_count: int
    days: float
    count: int
    start: Array
    rate: Array
    covariance: Array
    scatter: float
    freedom: int
    chi_squared: float
    toward: Array
    zeros_rad: Array
    unseen: int
    is_tool_free: bool

    @property
    def information(self) -> Array:
        """About the rate, whatever the start is, (r, r)."""
        size = len(self.rate)
        return np.asarray(np.linalg.pinv(self.covariance[size:, size:], rcond=KNOWN, hermitian=True))


def line_of(arm: Arm, entries: Sequence[Entry], step_day: float | None = None) -> DriftLine | None:
    """Through all entries that have a geometry, or a step that the entries from that day on are behind; None with fewer than two
    days.
    """
    used = [(entry.day, entry.geometry) for entry in entries if entry.geometry is not None]
    if len({day for day, _ in used}) < 2:
        return None
    view = _View(arm, used[0][1], used[-1][1], any(geometry.is_tool_free for _, geometry in used))
    days = np.array([day for day, _ in used]) - used[-1][0]
    seen = [view.seen(geometry) for _, geometry in used]
    if step_day is None:
        return _fitted(view, seen, days, days / -days.min(), float(-days.min()))
    return _fitted(view, seen, days, np.array([0.0 if day >= step_day else -1.0 for day, _ in used]), 1.0)


class _View:
    """The coordinates of what geometry does at the tip, about the last calibration's."""

    def __init__(self, arm: Arm, first: GeometryRecord, last: GeometryRecord, is_tool_free: bool) -> None:
        self.is_tool_free, self._arm, self._model = is_tool_free, arm, ArmModel(arm)
        self._every = dh_names(len(arm.links))
        self._q = workspace_poses(arm, (), DRAWN * POSES)[:POSES]
        self.count = len(self._q)
        self._dh = self._table(last)
        slopes = self._model.slopes(self._dh, self._q)
        self._tips = slopes.tips
        places = [self._every.index(name) for name in last.names if name in self._every]
        scales = np.array([scale for name, scale in zip(last.names, last.scales, strict=True) if name in self._every])
        by_tool, _ = np.linalg.qr(slopes.by_tool.reshape(-1, 3))
        by_dh = slopes.by_dh.reshape(-1, len(self._every))
        by_dh = by_dh - by_tool @ (by_tool.T @ by_dh) if is_tool_free else by_dh
        left, singular, _ = np.linalg.svd(by_dh[:, places] * scales, full_matrices=False)
        self._basis = left[:, singular > RANK_TOLERANCE * singular[0]]
        thetas = list(self._model.theta_places)
        # Halfway between the first and the last, where a tangent is the chord of a large change.
        midway = self._model.slopes(0.5 * (self._table(first) + self._dh), self._q).by_dh
        turned = midway.reshape(-1, len(self._every))[:, thetas]
        self.toward = self._basis.T @ turned
        hidden = np.linalg.norm(self.toward, axis=0) < HIDDEN * np.linalg.norm(turned, axis=0)
        self.toward[:, hidden] = np.nan  # the tool's place does as much
        self.toward[:, [self._every[place] not in last.names for place in thetas]] = np.nan
        self.zeros_rad = (self._dh - arm.dh).ravel()[thetas]

    def seen(self, geometry: GeometryRecord) -> tuple[Array, Array]:
        """A calibration's coordinates (r,) and their information (r, r)."""
        dh = self._table(geometry)
        slopes = self._model.slopes(dh, self._q)
        rows = [k for k, name in enumerate(geometry.names) if name in self._every]
        places = [self._every.index(geometry.names[k]) for k in rows]
        scales = np.array([geometry.scales[k] for k in rows])
        moves = self._basis.T @ slopes.by_dh.reshape(-1, len(self._every))[:, places] * scales
        lift = np.linalg.pinv(moves, rcond=RANK_TOLERANCE)
        information = lift.T @ information_about(np.array(geometry.information), rows) @ lift
        return self._basis.T @ (slopes.tips - self._tips).ravel(), information

    def _table(self, geometry: GeometryRecord) -> Array:
        """The DH table (links, 4); what the record lacks is as in arm.toml."""
        flat = self._arm.dh.ravel().copy()
        for name, value in zip(geometry.names, geometry.values, strict=True):
            if name in self._every:
                flat[self._every.index(name)] = value
        return flat.reshape(-1, 4)


def _fitted(view: _View, seen: list[tuple[Array, Array]], days: Array, passed: Array, unit: float) -> DriftLine:
    """`passed`: what has passed until each calibration, -1 to 0; `unit`: what the rate is per, in days."""
    size = len(seen[-1][0])
    normal, moment = np.zeros((2 * size, 2 * size)), np.zeros(2 * size)
    rows = [np.array([1.0, time]) for time in passed]
    for at, (value, info) in zip(rows, seen, strict=True):
        normal += np.kron(np.outer(at, at), info)
        moment += np.kron(at, info @ value)
    covariance: Array = np.asarray(np.linalg.pinv(normal, rcond=KNOWN, hermitian=True), dtype=np.float64)
    solution = (covariance @ moment).reshape(2, size)
    residuals = [(value - at @ solution, info) for at, (value, info) in zip(rows, seen, strict=True)]
    chi_squared = sum(float(residual @ info @ residual) for residual, info in residuals)
    freedom = sum(_rank(info) for _, info in seen) - _rank(normal)
    scatter = math.sqrt(max(1.0, chi_squared / freedom)) if freedom else 1.0
    by_day = np.repeat([1.0, 1.0 / unit], size)
    of_both: Array = covariance * np.outer(by_day, by_day) * scatter**2
    return DriftLine(
        poses_count=view.count,
        days=float(-days.min()),
        count=len(seen),
        start=np.asarray(solution[0]),
        rate=np.asarray(solution[1] / unit),
        covariance=of_both,
        scatter=scatter,
        freedom=freedom,
        chi_squared=chi_squared,
        toward=view.toward,
        zeros_rad=view.zeros_rad,
        unseen=2 * size - _rank(normal),
        is_tool_free=view.is_tool_free,
    )


def _rank(information: Array) -> int:
    values = np.linalg.eigvalsh(information)
    return int((values > KNOWN * values.max()).sum())


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

    line: DriftLine
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


def by_zeros(line: DriftLine, days: float) -> tuple[tuple[Rate, ...], bool]:
    """The line's rate over so many `days` as changes of the joints' zeros, and whether they leave more than uncertainty."""
    from scipy.stats import chi2

    determined = np.flatnonzero(np.isfinite(line.toward).all(axis=0))
    toward, info = line.toward[:, determined], line.information
    covariance = np.linalg.pinv(toward.T @ info @ toward, rcond=KNOWN, hermitian=True)
    speeds = covariance @ toward.T @ info @ line.rate
    rest = line.rate - toward @ speeds
    freedom = max(0, len(line.rate) - len(determined))
    zeros = tuple(
        _zero(line, joint, days * float(speed), days * math.sqrt(variance))
        for joint, speed, variance in zip(determined.tolist(), speeds, np.diag(covariance), strict=True)
    )
    return zeros, freedom > 0 and float(chi2.sf(float(rest @ info @ rest), freedom)) < 1.0 - SURE


def _is_steady(line: DriftLine) -> bool:
    from scipy.stats import chi2

    return not line.freedom or float(chi2.sf(line.chi_squared, line.freedom)) >= UNSTEADY


def _odd(arm: Arm, entries: Sequence[Entry]) -> Entry | None:
    """The only calibration without which LEAST or more others lie on a line."""
    odd = []
    for entry in (entry for entry in entries if entry.geometry is not None):
        line = line_of(arm, [other for other in entries if other is not entry])
        if line is not None and line.count >= LEAST and line.freedom and _is_steady(line):
            odd.append(entry)
    return odd[0] if len(odd) == 1 else None


def _zero(line: DriftLine, joint: int, change: float, sd: float) -> Rate:
    half, sure = (_quantile(level, line.freedom) * sd for level in (LEVEL, SURE))
    return Rate(f"joint {joint + 1}: zero", "rad", float(line.zeros_rad[joint]), change, half, abs(change) > sure, line.count)


def _quantile(level: float, freedom: int) -> float:
    """Of Student's t; of the normal distribution where nothing checks the standard deviations."""
    from scipy.stats import norm, t

    upper = 0.5 + 0.5 * level
    return float(t.ppf(upper, freedom) if freedom else norm.ppf(upper))


def quantity_rates(entries: Sequence[Entry]) -> tuple[Rate, ...]:
    """Of every quantity that entries of at least two days have, by name."""
    names = sorted({name for entry in entries for name in entry.quantities})
    rates = (_quantity_rate(name, [entry for entry in entries if name in entry.quantities]) for name in names)
    return tuple(rate for rate in rates if rate is not None)


def _quantity_rate(name: str, entries: Sequence[Entry]) -> Rate | None:
    """Weighted least squares; equal weights, and their scatter alone, where a standard deviation is unknown."""
    days = np.array([entry.day for entry in entries]) - entries[-1].day
    if len(set(days.tolist())) < 2:
        return None
    values = np.array([entry.quantities[name].value for entry in entries])
    sds = np.array([entry.quantities[name].sd or math.nan for entry in entries])
    is_known, freedom = bool(np.isfinite(sds).all()), len(entries) - 2
    speed, variance, squares = _straight(days, values, 1.0 / sds**2 if is_known else np.ones(len(values)))
    scatter = squares / freedom if freedom else (1.0 if is_known else math.inf)
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


@dataclass(frozen=True, slots=True)
class ZeroStep:
    """The calibrations on its two sides; changes of zeros; has_rest: other geometry changed; since: the calibrations behind it;
    alone: the only calibration of a side, which may be a spoilt one instead.
    """

    before: Entry
    after: Entry
    changes: tuple[Rate, ...]
    has_rest: bool
    since: tuple[Entry, ...]
    alone: Entry | None


def step_of(arm: Arm, entries: Sequence[Entry], line: DriftLine) -> ZeroStep | None:
    """The step that explains the calibrations far better than their line; None if none does. Entries are sorted by date."""
    known = [entry for entry in entries if entry.geometry is not None]
    places = [k for k in range(1, len(known)) if known[k].day > known[k - 1].day]
    splits = [(step, k) for k in places if (step := line_of(arm, known, known[k].day)) is not None]
    step, place = min(splits, key=lambda split: split[0].chi_squared)
    if _excess(step) > LEFT_MOST * _excess(line):
        return None
    changes, has_rest = by_zeros(step, 1.0)
    sides = known[:place], known[place:]
    alone = next((side[0] for side in reversed(sides) if len(side) == 1), None)
    return ZeroStep(known[place - 1], known[place], changes, has_rest, tuple(sides[1]), alone)


def _excess(line: DriftLine) -> float:
    """Chi-squared beyond what the calibrations' own intervals explain."""
    return max(0.0, line.chi_squared - line.freedom)


@dataclass(frozen=True, slots=True)
class Due:
    """Days after the last calibration. `days`: until then the tip keeps the tolerance with a probability of 1 - RISK.

    middle_days: in the median. furthest_days: later than that is not said; both are at most this. now_m: root mean square of
    what the last calibration itself leaves uncertain.
    """

    days: float
    middle_days: float
    furthest_days: float
    now_m: float

    @property
    def is_open(self) -> bool:
        """Whether the tolerance is kept for as long as the record can say."""
        return self.days >= self.furthest_days


def due(line: DriftLine, tolerance_m: float) -> Due | None:
    """By the drift of the geometry, root mean square over the workspace; None with fewer than LEAST calibrations, or where they
    identified the tool, too: of what another place of the tool does, nothing is known.
    """
    if line.count < LEAST or line.is_tool_free:
        return None
    start, speed = _drawn(line)
    constant, mixed, square = (
        np.einsum("dr,dr->d", one, other) / line.poses_count for one, other in ((start, start), (start, speed), (speed, speed))
    )
    days = _first_day(constant, mixed, square, tolerance_m)
    furthest = FURTHEST * line.days
    early, middle = (min(float(np.quantile(days, share, method="lower")), furthest) for share in (RISK, 0.5))
    return Due(early, middle, furthest, math.sqrt(float(constant.mean())))


def _drawn(line: DriftLine) -> tuple[Array, Array]:
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
