"""report.html of the gap workflow: the answer, the gap as the model grew, what was added, what is left, what could be named."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import rms
from calib.gap.effects.catalogue import comes_round
from calib.gap.finding import EffectName, GapFinding, NamedEffect
from calib.gap.maps.choose import MapsFound
from calib.gap.pictures import (
    channels_picture,
    joint_picture,
    ladder_picture,
    law_picture,
    map_picture,
    motion_picture,
    places_picture,
    recordings_picture,
    spectrum_picture,
    time_picture,
)
from calib.gap.poses.outcome import StaticGap
from calib.gap.residuals.rows import ChannelRows
from calib.gap.series.find import DynamicOutcome
from calib.gap.words import in_words, listed, unit_of
from calib.report.page import Section, bullets, page, paragraph, table, tiles, verdict
from calib.results import Provenance
from control.model.arm import Arm

MOST_PARAMETERS = 12  # rows of one effect; the geometry has more


@dataclass(frozen=True, slots=True)
class GapOutcome:
    """The finding of both levels together, each level's own, and sentences about the data and the fits.

    `maps`, and the arm with everything named and them, where maps were asked for.
    """

    finding: GapFinding
    static: StaticGap | None
    dynamic: DynamicOutcome | None
    warnings: tuple[str, ...]
    maps: MapsFound | None = None
    mapped: Arm | None = None


def gap_page(report: GapOutcome, made: Provenance) -> str:
    """The whole page."""
    about = f"{made.line} · {', '.join(report.finding.data)}"
    return page("The gap", report.finding.arm, about, gap_parts(report))


def gap_parts(report: GapOutcome) -> Iterator[Section | str]:
    """The page's sections, also for a longer page."""
    found = report.finding
    yield verdict(in_words(found))
    yield tiles(_tiles(found))
    if report.warnings:
        yield Section("Notes", bullets(report.warnings))
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
    yield "after", _number(found.gap_after, ".2f"), "times the noise that the new arm.toml leaves"
    names = [one for one in found.effects if one.name.effect != "link_geometry"]
    yield "", str(len(names)), f"effect{'s' if len(names) != 1 else ''} named, apart from the geometry"
    yield "", "yes" if found.unknown is not None else "no", "a residual that no known effect explains"


def _ladders(report: GapOutcome) -> Iterator[Section]:
    """One per level: their channels differ in kind."""
    for level, name in ((report.static, "Static poses"), (report.dynamic, "Time series")):
        if level is not None:
            steps = steps_of(level.finding)
            drawn = ladder_picture(steps, level.finding.judged_on) if steps else ""
            said = drawn or paragraph("The gap could not be determined.")
            yield Section(f"{name}: the gap after each step", said + channels_table(level.finding))


def _effects(found: GapFinding) -> Section:
    if not found.effects:
        return Section("Added to the model", paragraph("Nothing."))
    rows = [row for effect in found.effects for row in _parameter_rows(effect)]
    header = (
        ("text", "effect"),
        ("text", "parameter"),
        "value",
        "sd",
        "probability",
        "share of the excess [%]",
        "departs from its law [%]",
        "gap after",
    )
    return Section("Added to the model, in this order", table(header, rows))


def _parameter_rows(effect: NamedEffect) -> Iterator[tuple[tuple[str, str] | str, ...]]:
    largest = sorted(effect.parameters.items(), key=lambda item: -abs(item[1][0]) / max(item[1][1], 1e-12))[:MOST_PARAMETERS]
    shown = [(name, value) for name, value in effect.parameters.items() if (name, value) in largest]
    figures = (
        _number(effect.probability, ".3f"),
        _number(100.0 * effect.share, ".1f"),
        _number(100.0 * effect.departure, ".1f"),
        _number(effect.gap_after, ".3f"),
    )
    for k, (name, (value, sd)) in enumerate(shown):
        first = k == 0
        yield (
            ("text", str(effect.name) if first else ""),
            ("text", name),
            f"{value:.4g}",
            _number(sd, ".2g"),
            *(figures if first else ("",) * 4),
        )
    more = len(effect.parameters) - len(shown)
    if more:
        yield ("text", ""), ("text", f"and {more} more, in gap.json"), *("",) * 6


def _number(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else "–"


def _left(found: GapFinding) -> Iterator[Section]:
    """What has no single name."""
    if not found.remainder:
        return
    header = (("text", "where"), "share of the excess [%]", ("text", "root mean square"))
    rows = [(("text", one.where), _number(100.0 * one.share, ".1f"), ("text", in_units(one.size_si))) for one in found.remainder]
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
        paragraph(f"Noise of one axis of the tip: {1e3 * gap.floor.tip_m:.3f} mm, from {gap.floor.source}. {how}")
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
        found += [j for j in range(1, gap.points.joint_count + 1) if f"joint {j}:" in gap.finding.unknown.where]
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
    header = ("effect", "detectability [sd]", "needed [sd]", ("text", "indistinguishable from"), ("text", "identifiable"))
    return Section(
        "Effects that this data could identify",
        paragraph(
            "Detectability: an effect's size over its standard deviation, with the geometry free; computed before any residual is"
            " used. The size is the usual one."
        )
        + table(header, rows),
    )


def steps_of(found: GapFinding) -> list[tuple[str, float]]:
    """The nominal model, then with one effect more at a time, last with maps of what sets share; the gap after each, where there
    is one.
    """
    steps = [("nominal model", found.gap_before), *((str(one.name), one.gap_after) for one in found.effects)]
    if found.maps is not None:
        steps.append(("what sets share", found.gap_after))
    return [(name, gap) for name, gap in steps if math.isfinite(gap) and gap > 0.0]


def channels_table(found: GapFinding) -> str:
    """Noise, gap before and after of every channel in its own unit."""
    rows = []
    for channel, floor in found.noise_floor.items():
        unit, factor = unit_of(channel)
        values = (floor, found.before_si.get(channel, math.nan), found.after_si.get(channel, math.nan))
        name = channel.rpartition("_")[0] or channel
        rows.append((f"{name} [{unit}]", *(_number(factor * value, ".3g") for value in values)))
    return table(("channel, root mean square", "noise", ("before", "before"), ("after", "after")), rows)


def in_units(size_si: Mapping[str, float]) -> str:
    """Sizes by channel as `0.12 mm`."""
    seen = ((value, *unit_of(channel)) for channel, value in size_si.items())
    return ", ".join(f"{_number(factor * value, '.3g')} {unit}" for value, unit, factor in seen)


CELLS_MOST = 4  # drawn in time
ROWS_LEAST = 60  # of a cell that is drawn


def dynamic_sections(outcome: DynamicOutcome) -> Iterator[Section]:
    """The gap by channel, which run and channel show most, and what is left along what was named."""
    found, before, table_ = outcome.finding, outcome.before, outcome.rows
    kept = ", ".join(name for name in outcome.run_names if name in outcome.split.report_runs)
    about = paragraph(f"The noise floor comes from {table_.floor_source}; runs {kept} were held out for the report.")
    said = bullets(outcome.warnings) if outcome.warnings else ""
    if math.isfinite(found.gap_before):
        drawn = channels_picture(outcome)
    else:
        drawn = paragraph("No row of the held-out runs counts: there is no gap to draw.")
    yield Section("Time series: the gap by channel", about + said + drawn)
    # the cells with most before
    cells = sorted((c for c in table_.cells if before[c.rows].size), key=lambda c: -rms(before[c.rows]))
    if cells:
        run_of, worst = table_.run[cells[0].rows], before[cells[0].rows]
        run = max((int(k) for k in np.unique(run_of)), key=lambda k: rms(worst[run_of == k]))
        text = paragraph("The run with the largest residual; rows beside reversals and gaps are not used.")
        title = f"Time series: residuals in time, run {outcome.run_names[run]}"
        yield Section(title, text + time_picture(outcome, run, cells[:CELLS_MOST]))
    for law in outcome.laws:
        yield Section(f"Time series: {law.name}: data, law and departure", law_picture(law))
    for effect in found.effects:
        if (cell := _cell_of(outcome, effect.name)) is not None:
            is_wave = comes_round(effect.name.effect)
            drawn = spectrum_picture(outcome, cell, effect) if is_wave else motion_picture(outcome, cell, str(effect.name))
            yield Section(f"Time series: along {effect.name}", drawn)
    if not found.effects and found.unknown is not None and cells:
        yield Section(f"Time series: residual in {cells[0]}", motion_picture(outcome, cells[0], "residual"))


def _cell_of(outcome: DynamicOutcome, name: EffectName) -> ChannelRows | None:
    """Where an effect took most: its own joint's cells first."""
    taken = [
        (float(np.sum(outcome.before[cell.rows] ** 2) - np.sum(outcome.after[cell.rows] ** 2)), cell)
        for cell in outcome.rows.cells
        if outcome.before[cell.rows].size >= ROWS_LEAST
    ]
    own = [one for one in taken if name.joint is None or one[1].joint in (name.joint - 1, -1)]
    most, found = max(own or taken, key=lambda one: one[0], default=(0.0, None))
    return found if most > 0.0 else None


def map_sections(found: MapsFound) -> Iterator[Section]:
    """What measured maps are good for, and each table beside what was measured; none where no map helped: a note says that."""
    if not found.drawn:
        return
    header = (("text", "on recordings that were not fitted"), ("before", "without maps"), ("after", "with maps"))
    rows: list[tuple[str | tuple[str, str], ...]] = []
    for one in found.checks:
        unit, factor = unit_of(one.channel)
        what = "tip" if one.joint is None else f"torque of joint {one.joint}"
        values = (f"{factor * size:.3g}" for size in (one.before, one.after))
        rows.append((("text", f"{what}, root mean square [{unit}]"), *values))
    about = "What departs from its law or has no name, as it was measured. A map corrects; it explains nothing and names nothing."
    yield Section("Measured maps", paragraph(about) + table(header, rows))
    for drawn in found.drawn:
        yield Section(f"Measured map: {drawn.map}", map_picture(drawn))
