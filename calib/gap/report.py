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
    finding = report.finding
    yield verdict(in_words(finding))
    yield tiles(_tiles(finding))
    if report.warnings:
        yield Section("Notes", bullets(report.warnings))
    yield from _ladders(report)
    yield _effects(finding)
    yield from _remainder(finding)
    if report.static is not None:
        yield from _static(report.static)
    if report.dynamic is not None:
        yield from dynamic_sections(report.dynamic)
    if report.maps is not None:
        yield from map_sections(report.maps)
    yield _nameable(finding)
    yield from _open_questions(finding)


def _tiles(finding: GapFinding) -> Iterator[tuple[str, str, str]]:
    yield "before", f"{finding.gap_before:.2f}", f"times the noise before, on {finding.judged_on}"
    yield "after", _number(finding.gap_after, ".2f"), "times the noise that the new arm.toml leaves"
    names = [effect for effect in finding.effects if effect.name.effect != "link_geometry"]
    yield "", str(len(names)), f"effect{'s' if len(names) != 1 else ''} named, apart from the geometry"
    yield "", "yes" if finding.unknown is not None else "no", "a residual that no known effect explains"


def _ladders(report: GapOutcome) -> Iterator[Section]:
    """One per level: their channels differ in kind."""
    for level, name in ((report.static, "Static poses"), (report.dynamic, "Time series")):
        if level is not None:
            steps = steps_of(level.finding)
            drawn = ladder_picture(steps, level.finding.judged_on) if steps else ""
            content = drawn or paragraph("The gap could not be determined.")
            yield Section(f"{name}: the gap after each step", content + channels_table(level.finding))


def _effects(finding: GapFinding) -> Section:
    if not finding.effects:
        return Section("Added to the model", paragraph("Nothing."))
    rows = [row for effect in (*finding.effects, *finding.refitted) for row in _parameter_rows(effect)]
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


def _remainder(finding: GapFinding) -> Iterator[Section]:
    """What has no single name."""
    if not finding.remainder:
        return
    header = (("text", "where"), "share of the excess [%]", ("text", "root mean square"))
    rows = [(("text", r.where), _number(100.0 * r.share, ".1f"), ("text", in_units(r.size_si))) for r in finding.remainder]
    yield Section("Unexplained residual", table(header, rows))


def _open_questions(finding: GapFinding) -> Iterator[Section]:
    if finding.open_questions:
        lines = [f"{question.question} {question.next_experiment}" for question in finding.open_questions]
        yield Section("Open questions, and the recording that would decide each", bullets(lines))
    elif finding.next_experiment:
        yield Section("The next experiment", paragraph(finding.next_experiment))


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
    named = [effect.name.acts_on for effect in gap.finding.effects]
    joints = [joint for joint in dict.fromkeys(named) if joint is not None and joint <= gap.points.joint_count]
    if gap.finding.unknown is not None:
        joints += [j for j in range(1, gap.points.joint_count + 1) if f"joint {j}:" in gap.finding.unknown.where]
    return list(dict.fromkeys(joints)) or [int(np.argmax(np.ptp(gap.points.q_rad, axis=0))) + 1]


def _nameable(finding: GapFinding) -> Section:
    rows = [
        (
            str(nameable.name),
            f"{nameable.detectability:.1f}",
            f"{nameable.needed_sd:.1f}",
            ("text", listed(nameable.confusable_with) if nameable.confusable_with else ""),
            ("text", "yes" if nameable.is_nameable else "no"),
        )
        for nameable in sorted(finding.nameable, key=lambda nameable: (nameable.name.effect, nameable.name.joint or 0))
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


def steps_of(finding: GapFinding) -> list[tuple[str, float]]:
    """The nominal model, then with one effect more at a time, last with what the file had, identified anew, and with maps of what
    sets share; the gap after each, where there is one.
    """
    steps = [("nominal model", finding.gap_before), *((str(effect.name), effect.gap_after) for effect in finding.effects)]
    if finding.refitted:
        steps.append(("what arm.toml had, identified anew", finding.gap_after))
    if finding.maps is not None:
        steps.append(("what sets share", finding.gap_after))
    return [(name, gap) for name, gap in steps if math.isfinite(gap) and gap > 0.0]


def channels_table(finding: GapFinding) -> str:
    """Noise, gap before and after of every channel in its own unit."""
    rows = []
    for channel, floor in finding.noise_floor.items():
        unit, factor = unit_of(channel)
        values = (floor, finding.before_si.get(channel, math.nan), finding.after_si.get(channel, math.nan))
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
    finding, before, table_ = outcome.finding, outcome.before, outcome.rows
    held_out = ", ".join(name for name in outcome.run_names if name in outcome.split.report_runs)
    about = paragraph(f"The noise floor comes from {table_.floor_source}; runs {held_out} were held out for the report.")
    notes = bullets(outcome.warnings) if outcome.warnings else ""
    if math.isfinite(finding.gap_before):
        drawn = channels_picture(outcome)
    else:
        drawn = paragraph("No row of the held-out runs counts: there is no gap to draw.")
    yield Section("Time series: the gap by channel", about + notes + drawn)
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
    for effect in finding.effects:
        if (cell := _cell_of(outcome, effect.name)) is not None:
            is_wave = comes_round(effect.name.effect)
            drawn = spectrum_picture(outcome, cell, effect) if is_wave else motion_picture(outcome, cell, str(effect.name))
            yield Section(f"Time series: along {effect.name}", drawn)
    if not finding.effects and finding.unknown is not None and cells:
        yield Section(f"Time series: residual in {cells[0]}", motion_picture(outcome, cells[0], "residual"))


def _cell_of(outcome: DynamicOutcome, name: EffectName) -> ChannelRows | None:
    """Where an effect took most: its own joint's cells first."""
    reductions = [
        (float(np.sum(outcome.before[cell.rows] ** 2) - np.sum(outcome.after[cell.rows] ** 2)), cell)
        for cell in outcome.rows.cells
        if outcome.before[cell.rows].size >= ROWS_LEAST
    ]
    of_joint = [reduction for reduction in reductions if name.joint is None or reduction[1].joint in (name.joint - 1, -1)]
    largest, cell = max(of_joint or reductions, key=lambda reduction: reduction[0], default=(0.0, None))
    return cell if largest > 0.0 else None


def map_sections(maps: MapsFound) -> Iterator[Section]:
    """What measured maps are good for, and each table beside what was measured; none where no map helped: a note says that."""
    if not maps.drawn:
        return
    header = (("text", "on recordings that were not fitted"), ("before", "without maps"), ("after", "with maps"))
    rows: list[tuple[str | tuple[str, str], ...]] = []
    for check in maps.checks:
        unit, factor = unit_of(check.channel)
        what = "tip" if check.joint is None else f"torque of joint {check.joint}"
        values = (f"{factor * size:.3g}" for size in (check.before, check.after))
        rows.append((("text", f"{what}, root mean square [{unit}]"), *values))
    about = "What departs from its law or has no name, as it was measured. A map corrects; it explains nothing and names nothing."
    yield Section("Measured maps", paragraph(about) + table(header, rows))
    for drawn in maps.drawn:
        yield Section(f"Measured map: {drawn.map}", map_picture(drawn))
