"""The report of `armwright demo gap`: from the measurements to the corrected arm."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from calib.gap.report import GapReport, gap_parts
from calib.report.page import Section, list_section, page, paragraph, table, tiles, verdict
from calib.report.report_sections import paths_section, verification_section
from control.files import write_whole
from procedures.demo.gap import Circle
from procedures.demo.gap_hidden import ON_TIP


def findings(circle: Circle) -> tuple[str, ...]:
    """Sentences: the named effects, whether they are correct, and the improvement."""
    named = ", ".join(str(one.name) for one in circle.named) or "nothing"
    right = "correct" if circle.is_right else "not correct"
    alone, after = (
        1e3 * summary.mean_m
        for summary in (circle.geometry_alone.of("all").before, circle.corrected.of("all").after)
    )
    before = 1e3 * circle.corrected.of("all").before.mean_m
    found = circle.outcome.finding
    gap_after = f"{found.gap_after:.2f}" if math.isfinite(found.gap_after) else "not measured"
    notes = [
        f"Named by the run: {named}. Hidden: {circle.hidden}. The result is {right}.",
        f"The gap on {found.judged_on}: {found.gap_before:.2f} times the noise before, {gap_after} after.",
        f"Mean tip error at {len(circle.corrected.point)} held-out places: {before:.2f} mm with the nominal model,"
        f" {alone:.2f} mm with identified geometry and the correction off, {after:.2f} mm with the correction on.",
    ]
    following = tuple(1e3 * value for value in circle.following_rad)
    if circle.hidden.effect not in ON_TIP:
        notes.append(
            f"Following error on the paths: {following[0]:.3f} mrad before, {following[1]:.3f} mrad with the named"
            " effects fed forward."
        )
    return tuple(notes)


def write_page(circle: Circle, out: Path) -> Path:
    """report.html."""
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    program = f"armwright {version('armwright')}"
    path = out / "report.html"
    about = f"{date} · {program} · mock arm with a hidden effect"
    content = page("The gap, closed on the arm", circle.nominal.name, about, _parts(circle, date, program))
    write_whole(path, content)
    return path


def _parts(circle: Circle, date: str, program: str) -> Iterator[Section | str]:
    yield verdict(findings(circle))
    yield tiles(_tiles(circle))
    yield list_section("Procedure", _steps(circle))
    yield _revealed(circle)
    yield verification_section(
        circle.geometry_alone,
        "at held-out places: correction off (before) and on (after)",
    )
    yield paths_section(circle.paths)
    outcome = circle.outcome
    notes = (*outcome.agreement, *outcome.warnings)
    yield from gap_parts(GapReport(outcome.finding, outcome.static, outcome.dynamic, notes, date, program))


def _tiles(circle: Circle) -> Iterator[tuple[str, str, str]]:
    yield (
        "before",
        f"{1e3 * circle.corrected.of('all').before.mean_m:.2f} mm",
        "mean tip error, nominal model",
    )
    yield (
        "before",
        f"{1e3 * circle.geometry_alone.of('all').before.mean_m:.2f} mm",
        "geometry identified, correction off",
    )
    yield "after", f"{1e3 * circle.corrected.of('all').after.mean_m:.2f} mm", "correction on"
    yield (
        "after",
        f"{1e3 * circle.following_rad[1]:.3f} mrad",
        (f"following error on the paths ({1e3 * circle.following_rad[0]:.3f} before)"),
    )


def _steps(circle: Circle) -> Iterator[str]:
    minutes = sum(plan.duration_s for plan in circle.plans) / 60.0
    motions = sum(len(plan.runs) for plan in circle.plans)
    more = f", then {motions} motions, since the poses named no effect" if motions else ""
    yield (
        f"Recorded {len(circle.plans[0].visits)} poses on the mock arm with the nominal model{more}: {minutes:.1f}"
        " minutes of arm time."
    )
    yield "Moved to held-out places and along a circle and a line with the nominal model; the camera measured."
    yield (
        "Analysed the recordings with the nominal arm.toml alone; named the missing effects and added them to a new"
        " arm.toml."
    )
    yield "Started the runtime with the new arm.toml and moved to the same places with the correction off, then on."


def _revealed(circle: Circle) -> Section:
    found = {one.name.effect: one for one in circle.named if one.name.joint == circle.hidden.joint}
    same = found.get(circle.hidden.effect)
    rows = []
    for key, value in circle.hidden.parameters.items():
        known, sd = (
            same.parameters.get(key, (float("nan"), float("nan"))) if same else (float("nan"), float("nan"))
        )
        rows.append(
            (
                ("text", key),
                f"{value:.4g}",
                "–" if known != known else f"{known:.4g}",
                "–" if sd != sd else f"{sd:.2g}",
            )
        )
    head = (("text", "parameter"), "hidden", "found", "sd")
    return Section(
        "Hidden effect",
        paragraph(f"{circle.hidden}; the run had no access to it.") + table(head, rows),
    )
