"""What `armwright trend` says of an arm's history: what changed at once, what drifts, when the next calibration is due; in
sentences, as text and as JSON.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from calib.drift import LEAST, Due, GeometryTrend, Rate, ZeroStep, due, geometry_trend, quantity_rates, step_of
from calib.history import Entry
from calib.results import entries
from control.model.arm import Arm
from control.plain_text import aligned

MILLI = 1e3
CLOCKS_DIFFER = datetime.timedelta(days=1)  # of computers, and of dates that name no zone


@dataclass(frozen=True, slots=True)
class Trend:
    """All that `armwright trend` says. step: what changed at once, if that explains the record; geometry: of the calibrations
    since then, None if they are fewer than two; due: None if not asked for, or not to be told; now: when it is said.
    """

    arm: str
    entries: tuple[Entry, ...]
    geometry: GeometryTrend | None
    quantities: tuple[Rate, ...]
    tolerance_m: float | None
    due: Due | None
    step: ZeroStep | None
    now: datetime.datetime

    @property
    def rates(self) -> tuple[Rate, ...]:
        """Of zeros and named effects."""
        return (*(self.geometry.zeros if self.geometry else ()), *self.quantities)


def trend_of(arm: Arm, entries: Sequence[Entry], tolerance_m: float | None = None, now: datetime.datetime | None = None) -> Trend:
    """The trend of an arm's history, sorted by date."""
    geometry = geometry_trend(arm, entries)
    step = None if geometry is None or geometry.is_steady else step_of(arm, entries, geometry.line)
    if step is not None:
        geometry = geometry_trend(arm, step.since)
    when = due(geometry.line, tolerance_m) if geometry is not None and tolerance_m is not None else None
    moment = now or datetime.datetime.now(datetime.UTC)
    return Trend(arm.name, tuple(entries), geometry, quantity_rates(entries), tolerance_m, when, step, moment)


def sentences(trend: Trend) -> Iterator[str]:
    """What the trend says, the most useful first."""
    calibrations = sum(entry.geometry is not None for entry in trend.entries)
    gaps = sum(bool(entry.quantities) for entry in trend.entries)
    yield f"Arm {trend.arm}: {_count(calibrations, 'calibration')} and {_count(gaps, 'gap')} on record."
    yield from _about_dates(trend)
    if trend.step is not None:
        yield from _about_step(trend.step)
        calibrations = len(trend.step.since)
    few = [what for what, count in (("calibrations", calibrations), ("gaps", gaps)) if 1 < count < LEAST]
    if calibrations < 2 and not trend.quantities:
        yield "Drift shows between two calibrations of different days: calibrate again with --history, some weeks later."
        return
    if few:
        yield (
            f"A line through two points always fits: with {LEAST} {' and '.join(few)} or more, the rates are checked"
            " against their scatter."
        )
    drifting = [rate for rate in trend.rates if rate.drifts]
    for rate in drifting:
        yield f"{rate.name} drifts by {_rate(rate)} a year."
    if trend.rates and not drifting:
        yield "No drift is seen beyond what the records leave uncertain."
    yield from _about_geometry(trend)
    yield from _about_due(trend)


def _count(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _about_dates(trend: Trend) -> Iterator[str]:
    ahead = [str(one.measured.date()) for one in trend.entries if one.measured > trend.now + CLOCKS_DIFFER]
    if ahead:
        yield (
            f"Dated in the future: {', '.join(ahead)} (today is {trend.now.date()}). Correct `measured` of these lines of the"
            " history: rates and dates below count them as they are."
        )


def _about_step(step: ZeroStep) -> Iterator[str]:
    changes = [f"{one.name} by {_rate(one)}" for one in step.changes if one.drifts]
    if step.has_rest:
        changes.append("other geometry")
    count = _count(len(step.since), "calibration")
    yield (
        f"Between {step.before.measured.date()} and {step.after.measured.date()} the arm changed at once:"
        f" {', '.join(changes)}. Look for what slipped, was hit or was exchanged. The rest is about the {count} since then."
    )
    if step.alone is not None:
        yield (
            f"Only the calibration of {step.alone.measured.date()} is on its side of that: if it was spoilt, take its line out"
            " of the history."
        )


def _about_geometry(trend: Trend) -> Iterator[str]:
    geometry = trend.geometry
    if geometry is None:
        return
    if geometry.rest_drifts:
        yield "Geometry changes beyond the joints' zeros: look for a loose link, a bent part, or a base that moved."
    if geometry.odd is not None:
        yield (
            f"The calibration of {geometry.odd.measured.date()} contradicts the others, which lie on a line: if it was spoilt,"
            " take its line out of the history; if the arm was changed and changed back, keep in mind when."
        )
    if not geometry.is_steady:
        yield (
            f"The calibrations scatter {geometry.line.scatter:.1f} times as much as their intervals say: the change is not"
            " steady, or something else changes, such as the temperature. The intervals count this scatter."
        )
    if geometry.line.unseen:
        yield "Some of the geometry is not determined by these calibrations: its drift would not be seen."


def _about_due(trend: Trend) -> Iterator[str]:
    if trend.tolerance_m is None:
        return
    limit = f"{MILLI * trend.tolerance_m:.3g} mm"
    if trend.geometry is not None and trend.geometry.line.is_tool_free:
        yield (
            f"No date is promised for {limit}: calibrations on record identified the tool, too (--free tool), and another place"
            " of the tool looks like a zero of the last joint that drifts. Calibrate with the tool that you know, such as that of"
            " the calibrated arm.toml."
        )
        return
    if trend.due is None:
        yield (f"The next date cannot be estimated for {limit} yet: that needs at least {LEAST} calibrations on different days.")
        return
    last = [one for one in trend.entries if one.geometry is not None][-1].measured
    if trend.due.days <= 0.0:
        steady = trend.geometry is None or trend.geometry.is_steady
        yield (
            f"{'The calibrations leave' if steady else 'That scatter leaves'} {MILLI * trend.due.now_m:.3g} mm uncertain on the"
            f" day of the last one (root mean square over the workspace): {limit} cannot be promised on any day."
            f" {'More poses, or more calibrations, are needed.' if steady else 'Find its cause first.'}"
        )
    elif trend.due.is_open:
        yield (
            f"The tip drifts by less than {limit} for at least {trend.due.furthest_days:.0f} days after {last.date()}"
            " (root mean square over the workspace, 95 % probability); the record is too short to say more."
        )
    else:
        by = last + datetime.timedelta(days=trend.due.days)
        middle = trend.due.middle_days
        most = "beyond what the record can say" if middle >= trend.due.furthest_days else f"{middle:.0f} days"
        yield (
            f"Calibrate again by {by.date()}, {trend.due.days:.0f} days after the last: until then the tip drifts by less than"
            f" {limit} (root mean square over the workspace) with a probability of 95 %. Median: {most}."
            f"{' That date has passed.' if by < trend.now else ''}"
        )


def as_text(trend: Trend) -> str:
    """What the command prints."""
    rows = [(one.name, _value(one), _rate(one), str(one.count)) for one in trend.rates]
    head = ("", "last", "change in a year (95 %)", "records")
    table = ("", aligned([head, *rows], indent="  ")) if rows else ()
    return "\n".join((*sentences(trend), *table)) + "\n"


def trend_json(trend: Trend) -> dict[str, object]:
    """For programs; SI units, changes per year."""
    geometry = trend.geometry
    return {
        "format": "trend/1",
        "arm": trend.arm,
        "entries": len(trend.entries),
        "rates": [
            entries(row, "name", "value", "drifts") | {"per_year": row.change, "half_interval": row.half, "records": row.count}
            for row in trend.rates
        ],
        "step": trend.step
        and {
            "between": [entry.measured.isoformat() for entry in (trend.step.before, trend.step.after)],
            "changes": [
                {"name": row.name, "change": row.change, "half_interval": row.half, "is_sure": row.drifts}
                for row in trend.step.changes
            ],
            "other_geometry": trend.step.has_rest,
        },
        "scatter": geometry.line.scatter if geometry else None,
        "other_geometry_drifts": geometry.rest_drifts if geometry else None,
        "tolerance_m": trend.tolerance_m,
        "due": trend.due
        and {
            "days": trend.due.days,
            "median_days": trend.due.middle_days,
            "not_said_beyond_days": trend.due.furthest_days,
            "now_rms_m": trend.due.now_m,
        },
        "in_words": tuple(sentences(trend)),
    }


def _rate(rate: Rate) -> str:
    if not math.isfinite(rate.half):
        return "cannot be told"
    scale, unit = (MILLI, " mrad") if rate.unit == "rad" else (1.0, "")
    low, high = rate.change - rate.half, rate.change + rate.half
    return f"{scale * rate.change:.3g}{unit} ({scale * low:.3g} to {scale * high:.3g})"


def _value(one: Rate) -> str:
    return f"{MILLI * one.value:.3f} mrad" if one.unit == "rad" else f"{one.value:.4g}"
