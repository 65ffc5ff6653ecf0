"""report.html of the gap workflow: the answer, the gap as the model grew, what was added, what is left, what could be named."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.gap.drawn_law import law_picture
from calib.gap.finding import GapFinding, NamedEffect
from calib.gap.maps.choose import MapsFound
from calib.gap.maps.pictures import map_sections
from calib.gap.poses.outcome import StaticGap
from calib.gap.poses.pictures import joint_picture, places_picture, recordings_picture
from calib.gap.series.drawing.pictures import dynamic_sections
from calib.gap.series.outcome import DynamicOutcome
from calib.gap.words import in_words, listed
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg
from calib.report.page import Section, bullets, page, paragraph, table, tiles, verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure


MOST_PARAMETERS = 12  # rows of one effect; the geometry has more


@dataclass(frozen=True, slots=True)
class GapReport:
    """Everything that the page shows. `notes`: sentences about the data and about how poses and time series agree."""

    finding: GapFinding
    static: StaticGap | None
    dynamic: DynamicOutcome | None
    notes: tuple[str, ...]
    date: str
    program_version: str
    maps: MapsFound | None = None


def gap_page(report: GapReport) -> str:
    """The whole page."""
    about = f"{report.date} · {report.program_version} · {', '.join(report.finding.data)}"
    return page("The gap", report.finding.arm, about, gap_parts(report))


def gap_parts(report: GapReport) -> Iterator[Section | str]:
    """The page's sections, also for a longer page."""
    found = report.finding
    yield verdict(in_words(found))
    yield tiles(_tiles(found))
    if report.notes:
        yield Section("Notes", bullets(report.notes))
    yield from _ladders(report)
    yield _effects(found)
    yield from _left(found)
    if report.static is not None:
        yield from _static(report.static)
    if report.dynamic is not None:
        yield from dynamic_sections(report.dynamic)
    if report.maps is not None:
        yield from map_sections(report.maps)
    yield _nameable(found)
    yield from _open(found)


def _tiles(found: GapFinding) -> Iterator[tuple[str, str, str]]:
    yield "before", f"{found.gap_before:.2f}", f"times the noise before, on {found.judged_on}"
    after = f"{found.gap_after:.2f}" if math.isfinite(found.gap_after) else "–"
    yield "after", after, "times the noise that the new arm.toml leaves"
    names = [one for one in found.effects if one.name.effect != "link_geometry"]
    yield "", str(len(names)), f"effect{'s' if len(names) != 1 else ''} named, apart from the geometry"
    yield "", "yes" if found.unknown is not None else "no", "a residual that no known effect explains"


def _ladders(report: GapReport) -> Iterator[Section]:
    """One per level: their channels differ in kind."""
    for level, name in ((report.static, "Static poses"), (report.dynamic, "Time series")):
        if level is not None:
            yield Section(f"{name}: the gap after each step", ladder(level.finding))


def _effects(found: GapFinding) -> Section:
    if not found.effects:
        return Section("Added to the model", paragraph("Nothing."))
    rows = [row for effect in found.effects for row in _parameter_rows(effect)]
    header = (
        ("text", "effect"), ("text", "parameter"), "value", "sd", "probability", "share of the excess [%]",
        "departs from its law [%]", "gap after",
    )  # fmt: skip
    return Section("Added to the model, in this order", table(header, rows))


def _parameter_rows(effect: NamedEffect) -> Iterator[tuple[tuple[str, str] | str, ...]]:
    largest = sorted(effect.parameters.items(), key=lambda item: -abs(item[1][0]) / max(item[1][1], 1e-12))[
        :MOST_PARAMETERS
    ]
    shown = [(name, value) for name, value in effect.parameters.items() if (name, value) in largest]
    for k, (name, (value, sd)) in enumerate(shown):
        first = k == 0
        yield (
            ("text", str(effect.name) if first else ""),
            ("text", name),
            f"{value:.4g}",
            f"{sd:.2g}" if sd == sd else "–",
            *(_numbers(effect) if first else ("",) * 4),
        )
    more = len(effect.parameters) - len(shown)
    if more:
        yield ("text", ""), ("text", f"and {more} more, in gap.json"), *("",) * 6


def _numbers(effect: NamedEffect) -> tuple[str, ...]:
    return (
        _number(effect.probability, ".3f"),
        _number(100.0 * effect.share, ".1f"),
        _number(100.0 * effect.departure, ".1f"),
        _number(effect.gap_after, ".3f"),
    )


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"


def _left(found: GapFinding) -> Iterator[Section]:
    """What has no single name."""
    if not found.remainder:
        return
    header = (("text", "where"), "share of the excess [%]", ("text", "root mean square"))
    rows = [
        (("text", one.where), _number(100.0 * one.share, ".1f"), ("text", in_units(one.size_si)))
        for one in found.remainder
    ]
    yield Section("Unexplained residual", table(header, rows))


def _open(found: GapFinding) -> Iterator[Section]:
    if found.open_questions:
        lines = [f"{one.question} {one.next_experiment}" for one in found.open_questions]
        yield Section("Open questions, and the recording that would decide each", bullets(lines))
    elif found.next_experiment:
        yield Section("The next experiment", paragraph(found.next_experiment))


def _static(gap: StaticGap) -> Iterator[Section]:
    count = int(gap.split.report.sum())
    how = (
        f"{gap.split.recordings_count} recordings; {count} of {len(gap.points)} poses were held out for the report."
        if gap.split.is_divided
        else "Too few recordings to hold one out: the gap is that of the fitted poses."
    )
    yield Section(
        "Static poses, by recording",
        paragraph(
            f"Noise of one axis of the tip: {1e3 * gap.floor.tip_m:.3f} mm, from {gap.floor.source}. {how}"
        )
        + recordings_picture(gap),
    )
    yield Section("Static poses, by place", places_picture(gap))
    for law in gap.laws:
        yield Section(f"{law.name}: data, law and departure", law_picture(law))
    for joint in _joints(gap):
        yield Section(f"Static poses, along joint {joint}", joint_picture(gap, joint))


def _joints(gap: StaticGap) -> Sequence[int]:
    """The joints with findings; else the joint with the largest range."""
    named = [one.name.acts_on for one in gap.finding.effects]
    found = [joint for joint in dict.fromkeys(named) if joint is not None and joint <= gap.points.joint_count]
    if gap.finding.unknown is not None:
        found += [
            j for j in range(1, gap.points.joint_count + 1) if f"joint {j}:" in gap.finding.unknown.where
        ]
    return list(dict.fromkeys(found)) or [int(np.argmax(np.ptp(gap.points.q_rad, axis=0))) + 1]


def _nameable(found: GapFinding) -> Section:
    rows = [
        (
            str(one.name),
            f"{one.detectability:.1f}",
            f"{one.needed_sd:.1f}",
            ("text", listed(one.confusable_with) if one.confusable_with else ""),
            ("text", "yes" if one.is_nameable else "no"),
        )
        for one in sorted(found.nameable, key=lambda one: (one.name.effect, one.name.joint or 0))
    ]
    header = (
        "effect",
        "detectability [sd]",
        "needed [sd]",
        ("text", "indistinguishable from"),
        ("text", "identifiable"),
    )
    return Section(
        "Effects that this data could identify",
        paragraph(
            "Detectability: an effect's size over its standard deviation, with the geometry free; computed before any residual is"
            " used. The size is the usual one."
        )
        + table(header, rows),
    )


# The gap as a waterfall from the nominal model to the noise, one step an effect, and in the channels' own units.

UNITS = {
    "tip_m": ("mm", 1e3), "current_A": ("mA", 1e3), "voltage_V": ("mV", 1e3), "q_rad": ("mrad", 1e3),
    "q_loop_rad": ("mrad", 1e3), "turn_rad": ("mrad", 1e3),
}  # fmt: skip


def steps_of(found: GapFinding) -> list[tuple[str, float]]:
    """The nominal model, then with one effect more at a time, last with maps of what sets share; the gap after each, where there
    is one.
    """
    steps = [("nominal model", found.gap_before), *((str(one.name), one.gap_after) for one in found.effects)]
    if found.maps is not None:
        steps.append(("what sets share", found.gap_after))
    return [(name, gap) for name, gap in steps if math.isfinite(gap) and gap > 0.0]


def ladder_picture(found: GapFinding) -> str:
    """What each step takes off the gap, and what the last one leaves above the noise."""
    steps = steps_of(found)
    return svg((10.4, 0.9 + 0.36 * (len(steps) + 1)), lambda figure: _draw(figure, steps, found.judged_on))


def channels_table(found: GapFinding) -> str:
    """Noise, gap before and after of every channel in its own unit."""
    rows = []
    for channel, floor in found.noise_floor.items():
        unit, factor = UNITS.get(channel, (channel.rpartition("_")[2], 1.0))
        name = channel.rpartition("_")[0] or channel
        values = (floor, found.before_si.get(channel, math.nan), found.after_si.get(channel, math.nan))
        rows.append((f"{name} [{unit}]", *(_number(factor * value, ".3g") for value in values)))
    return table(("channel, root mean square", "noise", ("before", "before"), ("after", "after")), rows)


def in_units(size_si: Mapping[str, float]) -> str:
    """Sizes by channel as `0.12 mm`."""
    texts = []
    for channel, value in size_si.items():
        unit, factor = UNITS.get(channel, (channel.rpartition("_")[2], 1.0))
        texts.append(f"{_number(factor * value, '.3g')} {unit}")
    return ", ".join(texts)


def _draw(figure: Figure, steps: Sequence[tuple[str, float]], judged_on: str) -> None:
    axes = figure.subplots()
    count = len(steps) + 1
    figure.subplots_adjust(left=0.26, right=0.95, top=0.98, bottom=0.5 / (0.9 + 0.36 * count))
    gaps = [gap for _, gap in steps]
    least, most = min(0.5, 0.8 * min(gaps)), max(2.0, 1.5 * max(gaps))
    begins, ends = [least, *gaps[1:], min(1.0, gaps[-1])], [gaps[0], *gaps[:-1], max(1.0, gaps[-1])]
    colours = [BEFORE, *([AFTER] * (len(steps) - 1)), PLANNED]
    for at, (begin, end, colour) in enumerate(zip(begins, ends, colours, strict=True)):
        axes.barh(at, end - begin, left=begin, color=colour, height=0.62)
        axes.text(max(begin, end) * 1.04, at, f"{([*gaps, gaps[-1]])[at]:.2f}", va="center", size=8)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.axvline(1.0, color=PLANNED, lw=1.2, ls="--")
    axes.set_xlim(least, most)
    names = [name if k == 0 else f"+ {name}" for k, (name, _) in enumerate(steps)]
    axes.set_yticks(list(range(count)), [*names, "left, beside the noise"])
    axes.invert_yaxis()
    axes.set_xlabel(
        f"gap over noise on {judged_on} (dashed: 1, noise only); a bar is the reduction by its step"
    )


def ladder(found: GapFinding) -> str:
    """Picture and table; a sentence where there is nothing to draw."""
    if not steps_of(found):
        return paragraph("The gap could not be determined.") + channels_table(found)
    return ladder_picture(found) + channels_table(found)
