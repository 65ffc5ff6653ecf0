"""report.html: procedure and results in one file without outside resources.

`report_html` has the sections in their usual order. `report_sections` has single sections;
`page.page` makes a page of any sections.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from calib.identify.identification import Identification
from calib.report.page import Section, page, tiles, verdict
from calib.report.report_sections import (
    calibration_section,
    dh_section,
    done_section,
    inputs_section,
    parameters_section,
    paths_section,
    verification_section,
)
from calib.results import Provenance
from calib.validation.verify import Comparison, TrackPair
from control.files import write_whole
from control.model.arm import Arm

# Data of a report: plain dataclasses filled in by the caller.

UNUSED = "at points that calibration did not use"


@dataclass(frozen=True, slots=True)
class ReportData:
    """The contents of report.html. Absent parts are omitted.

    `verdict`: sentences at the top. `paths`: trajectories by the nominal and the calibrated model. `arms`: nominal
    and calibrated, for the table of their DH parameters. `sections`: more of them, after the comparisons. `verified_at`: where
    the verification was.
    """

    title: str
    arm: str
    made: Provenance
    steps: tuple[str, ...]
    paths: tuple[TrackPair, ...] = ()
    identification: Identification | None = None
    calibration: Comparison | None = None
    verification: Comparison | None = None
    arms: tuple[Arm, Arm] | None = None
    notes: tuple[str, ...] = ()
    verdict: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()
    verified_at: str = UNUSED


def write_report(path: Path, report: ReportData) -> None:
    """Write report.html, creating its folder if necessary."""
    write_whole(path, report_html(report))


def report_html(report: ReportData) -> str:
    """The whole page."""
    return page(report.title, report.arm, report.made.line, _parts(report))


def _parts(report: ReportData) -> Iterator[Section | str]:
    if report.verdict:
        yield verdict(report.verdict)
    yield tiles(_results(report))
    yield done_section(report.steps, report.notes)
    if report.verification is not None:
        yield verification_section(report.verification, report.verified_at)
    if report.paths:
        yield paths_section(report.paths)
    yield from report.sections
    if report.arms is not None:
        yield dh_section(*report.arms)
    if report.identification is not None:
        yield parameters_section(report.identification)
    if report.calibration is not None:
        yield calibration_section(report.calibration)
    if report.made.inputs:
        yield inputs_section(report.made.inputs)


def _results(report: ReportData) -> Iterator[tuple[str, str, str]]:
    """The result in a few figures."""
    judged = report.verification or report.calibration
    if judged is not None:
        entry = judged.of("all")
        where = report.verified_at if report.verification is not None else "at the calibration points"
        yield "before", f"{1e3 * entry.before.mean_m:.2f} mm", f"mean error before, {where}"
        yield "after", f"{1e3 * entry.after.mean_m:.2f} mm", f"mean error after, {where}"
        yield "", f"{entry.improvement_percent:.1f} %", f"smaller mean error, {where}"
    found = report.identification
    if found is not None:
        yield "", f"{found.rank} of {len(found.estimates)}", "parameters that the points determine"
