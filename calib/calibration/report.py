"""report.html of a calibration: the verdict, its evidence, and what the points determine."""

from __future__ import annotations

import numpy as np

from calib.arrays import frozen
from calib.calibration.calibrate import Calibrated
from calib.inputs import InputFile
from calib.report.page import Section, bullets, paragraph, table
from calib.report.report_data import ReportData
from calib.report.report_sections import frames_section
from calib.validation.holdout import HeldOut
from calib.validation.verify import Comparison, compare


def calibration_report(
    made: Calibrated, inputs: tuple[InputFile, ...], date: str, program_version: str
) -> ReportData:
    """The report of a calibration."""
    found = made.found
    return ReportData(
        title="Calibration",
        arm=made.nominal.name,
        date=date,
        program_version=program_version,
        steps=_steps(made),
        inputs=inputs,
        identification=found,
        calibration=_comparison(made),
        arms=(made.nominal, made.arm),
        notes=made.warnings,
        verdict=made.verdict.in_words(),
        sections=tuple(_sections(made)),
    )


def _steps(made: Calibrated) -> tuple[str, ...]:
    setups = ", ".join(dict.fromkeys(made.points.setup))
    bounds = sum(estimate.parameter.has_bound for estimate in made.found.estimates)
    return (
        f"Read {len(made.points)} points of the setups {setups}.",
        f"Identified {len(made.found.estimates)} parameters, {bounds} of them within bounds: {made.found.objective}.",
        "Tested every point against the others, and evaluated on held-out points.",
    )


def _comparison(made: Calibrated) -> Comparison:
    """Before and after at the points of the fit."""
    return compare(
        made.points.setup,
        made.points.point,
        frozen(made.problem.references_m),
        made.found.error_before_m,
        made.found.error_after_m,
    )


def _sections(made: Calibrated) -> list[Section]:
    sections = []
    if made.held is not None:
        sections.append(_held_section(made.held))
    suspicious = made.suspects.in_words()
    findings = suspicious or ("None: no point contradicts the others by more than the noise.",)
    sections.append(Section("Suspicious points", bullets(findings)))
    if any(frame.is_free for frame in made.found.solution.frames):
        sections.append(frames_section(made.found))
    if made.found.orientation is not None:
        sections.append(Section("Orientations", paragraph(made.found.orientation.in_words())))
    if made.found.accuracy is not None:
        sections.append(Section("Requested accuracy", paragraph(made.found.accuracy.in_words())))
    return sections


def _held_section(held: HeldOut) -> Section:
    what = "scatter of the cavity's predicted tips" if held.is_scatter else "error"
    rows = [
        (
            fold.name,
            str(len(fold.rows)),
            f"{1e3 * fold.mean_before_m:.3f}",
            f"{1e3 * fold.mean_after_m:.3f}",
            f"{1e3 * fold.rms_after_m:.3f}",
            f"{1e3 * fold.max_after_m:.3f}",
        )
        for fold in held.folds
    ]
    total = (
        "all",
        str(len(held.after_m)),
        f"{1e3 * float(held.before_m.mean()):.3f}",
        f"{1e3 * float(held.after_m.mean()):.3f}",
        f"{1e3 * float(np.sqrt(np.mean(held.after_m**2))):.3f}",
        f"{1e3 * float(held.after_m.max()):.3f}",
    )
    header = ("held out", "points", "mean before [mm]", "mean after [mm]", "RMS after [mm]", "max after [mm]")
    return Section(
        "Held-out points",
        paragraph(f"Each row: {what} at the held-out points, identified from all others.")
        + table(header, [*rows, total]),
    )
