"""The result of a calibration as a page, as text for a terminal, and as entries of calibration.json.

In: what `calibrate` found and the held-out comparison. Out: the verdict, its evidence, what the points
determine, what to do next.

"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.arm_problem.observations import Frame, rotation_vector
from calib.arrays import frozen
from calib.calibration import Calibrated
from calib.identify.identification import Estimate
from calib.report.page import Section, bullets, paragraph, table
from calib.report.report import NO_EFFECT, ReportData, frames_section, of_the_arm
from calib.results import Provenance, entries
from calib.validation.holdout import HeldOut
from calib.validation.statistics import mean_half_width
from calib.validation.verify import Comparison, compare

# The result of a calibration as text for a terminal, and as entries of calibration.json.


UNIT = {"m": ("mm", 1e3, 3), "rad": ("deg", math.degrees(1.0), 4)}


def summary_text(made: Calibrated) -> str:
    """The verdict first, then the evidence."""
    fit = made.found
    lines = [
        *made.verdict.in_words(),
        "",
        f"{len(made.points)} points, {fit.objective}: mean error {1e3 * fit.mean_before_m:.3f} mm before,"
        f" {1e3 * fit.mean_after_m:.3f} mm after, at the points of the fit.",
        *(made.held.in_words() if made.held is not None else ()),
        *([fit.accuracy.in_words()] if fit.accuracy is not None else []),
        *([fit.orientation.in_words()] if fit.orientation is not None else []),
    ]
    suspicious = made.suspects.in_words()
    if suspicious:
        lines += ["", "Suspicious, but used (exclude with --without SETUP:POINT):", *suspicious]
    lines += ["", *fit.in_words(), "", parameter_text(made)]
    return "\n".join(lines) + "\n"


def parameter_text(made: Calibrated) -> str:
    """One line per parameter; then the identified poses of boards."""
    rows = estimate_lines(of_the_arm(made.found))
    free = [frame for frame in made.found.solution.frames if frame.is_free]
    if free:
        rows += ["", f"{'frame':<20}{'x [mm]':>10}{'y [mm]':>10}{'z [mm]':>10}   rotation about x, y, z [deg]"]
        rows += [_frame_line(frame) for frame in free]
    return "\n".join(rows)


def estimate_lines(estimates: Sequence[Estimate]) -> list[str]:
    """A table with a header and one line per parameter."""
    header = f"{'parameter':<20}{'unit':<9}{'nominal':>12}{'identified':>12}{'deviation':>12}{'sd':>10}"
    return [header, *map(_parameter_line, estimates)]


def _parameter_line(estimate: Estimate) -> str:
    parameter = estimate.parameter
    unit, factor, digits = UNIT.get(parameter.unit, (parameter.unit or "-", 1.0, 6))
    is_open = estimate.undetermined_share > NO_EFFECT
    sd = "" if math.isnan(estimate.sd) or is_open else f"{factor * estimate.sd:.{digits}f}"
    remark = "at its bound" if estimate.is_at_bound else "" if estimate.is_determined else "not determined alone"
    nominal = f"{factor * parameter.nominal:.{digits}f}" if parameter.has_bound else "unknown"
    deviation = f"{factor * estimate.deviation:+z.{digits}f}" if parameter.has_bound else ""
    return (
        f"{parameter.name:<20}{unit:<9}{nominal:>12}{factor * estimate.value:>z12.{digits}f}{deviation:>12}{sd:>10}"
        f"  {'no effect here' if is_open else remark}"
    ).rstrip()


def _frame_line(frame: Frame) -> str:
    x, y, z = (1e3 * frame.origin_m).tolist()
    turns = ", ".join(f"{angle:.3f}" for angle in np.degrees(rotation_vector(frame.rotation)))
    return f"{frame.name:<20}{x:>10.3f}{y:>10.3f}{z:>10.3f}   {turns}"


def judgement_json(made: Calibrated) -> dict[str, object]:
    """Entries of calibration.json besides the identification."""
    accuracy = made.found.accuracy
    return {
        "verdict": made.verdict,
        "noise_floor": made.floor and entries(made.floor, "axis_m", "mean_m", "source"),
        "held_out": None if made.held is None else _held(made.held),
        "outliers": [
            {"pose": outlier.row + 1} | entries(outlier, "setup", "point", "distance_m", "score", "words")
            for outlier in made.suspects.outliers
        ],
        "shifted_setups": [shifted.setup for shifted in made.suspects.setups],
        "suspicious": made.suspects.in_words(),
        "accuracy": accuracy and entries(accuracy, "limit_m", "mean_m", "least_m", "is_met"),
        "warnings": made.warnings,
    }


def _held(held: HeldOut) -> dict[str, object]:
    return {
        "by": held.by,
        "mean_before_m": float(held.before_m.mean()),
        "mean_after_m": float(held.after_m.mean()),
        "mean_after_half_width_m": mean_half_width(held.after_m),
        "improvement_percent": held.improvement_percent,
        "folds": [
            {"left_out": fold.name, "points": len(fold.rows)}
            | entries(fold, "measure", "mean_before_m", "mean_after_m", "rms_after_m", "max_after_m")
            for fold in held.folds
        ],
    }


# report.html of a calibration: the verdict, its evidence, and what the points determine.


def calibration_report(made: Calibrated, provenance: Provenance) -> ReportData:
    """The report of a calibration."""
    fit = made.found
    return ReportData(
        title="Calibration",
        arm=made.nominal.name,
        made=provenance,
        steps=_steps(made),
        identification=fit,
        calibration=_comparison(made),
        held=made.held,
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
        paragraph(f"Each row: {what} at the held-out points, identified from all others.") + table(header, [*rows, total]),
    )
