"""Sections of a report: procedure, inputs, identified parameters, errors before and after."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from calib.arm_problem.frames import rotation_vector
from calib.arm_problem.parallel_axes import in_the_same_rows
from calib.arrays import norms
from calib.identify.estimates import Estimate
from calib.identify.identification import Identification
from calib.report.page import Cell, Section, bullets, escaped, folded, heading, pair, paragraph, table
from calib.report.pictures import histogram_picture, path_picture, setup_picture, vector_picture
from calib.results import InputFile
from calib.validation.statistics import ErrorSummary, digits_mm
from calib.validation.verify import (
    PARTS,
    Comparison,
    TrackPair,
    compare_tracks,
    findings,
    improvement_percent,
)
from control.errors import ArmError
from control.model.arm import Arm

NO_EFFECT = 0.999  # undetermined share from which a parameter is reported to have no effect
# Display of parameters by unit: unit, scale, format.
UNITS = {"m": ("mm", 1e3, ".3f"), "rad": ("deg", math.degrees(1.0), ".4f"), "1": ("", 1.0, ".6f")}


def done_section(steps: Iterable[str], notes: Sequence[str] = ()) -> Section:
    """The steps in order, and notes."""
    return Section(
        "What was done",
        bullets(steps, "ol") + (heading("To note") + bullets(notes) if notes else ""),
    )


def inputs_section(inputs: Sequence[InputFile]) -> Section:
    """The files that the result depends on."""
    rows: list[Sequence[Cell]] = [(file.name, ("text", file.what), ("text", file.sha256)) for file in inputs]
    return Section("Inputs", f'<div class="inputs">{table(("file", "what it is", "SHA-256"), rows)}</div>')


def parameters_section(found: Identification) -> Section:
    """All parameters with their standard deviations, and what the data do not determine."""
    header = ("parameter", "unit", "nominal", "identified", "deviation", "sd", "bound", "")
    before, after = found.objective_before, found.objective_after
    return Section(
        "Parameters",
        f"<p>Objective {escaped(found.objective)}: {before:.6g} before, {after:.6g} after (SI units). Residual"
        f" {1e3 * found.noise_m:.3f} mm per axis (standard deviation).</p>"
        + heading("What the data determine")
        + bullets(found.in_words())
        + table(header, [_parameter_row(estimate) for estimate in of_the_arm(found)])
        + paragraph(
            "sd: standard deviation of the part of this parameter that the data determine. Where parameters move together,"
            " only their combination is meaningful; the values are those nearest to nominal.",
            "soft small",
        ),
    )


def of_the_arm(found: Identification) -> tuple[Estimate, ...]:
    """The estimates without those of boards and base, which are meaningful only as whole frames."""
    free = [frame for frame in found.solution.frames if frame.is_free]
    of_frames = {name for frame in free for name in frame.parameter_names}
    return tuple(one for one in found.estimates if one.parameter.name not in of_frames)


def frames_section(found: Identification) -> Section:
    """Identified poses of boards and base."""
    rows = [
        (
            frame.name,
            *(f"{1e3 * value:.3f}" for value in frame.origin_m.tolist()),
            *(f"{math.degrees(value):.3f}" for value in rotation_vector(frame.rotation).tolist()),
        )
        for frame in found.solution.frames
        if frame.is_free
    ]
    header = ("frame", "x [mm]", "y [mm]", "z [mm]", "rx [deg]", "ry [deg]", "rz [deg]")
    return Section(
        "Poses of boards and base",
        paragraph("Identified with the parameters; origin and rotation vector in the arm's base frame.")
        + table(header, rows),
    )


def _parameter_row(estimate: Estimate) -> Sequence[Cell]:
    parameter = estimate.parameter
    unit, scale, form = UNITS.get(parameter.unit, (parameter.unit, 1.0, ".5g"))
    is_open = estimate.undetermined_share > NO_EFFECT
    sd = "" if math.isnan(estimate.sd) or is_open else f"{scale * estimate.sd:{form}}"
    bound = f"± {scale * parameter.bound:.4g}" if math.isfinite(parameter.bound) else "none"
    return (
        parameter.name,
        unit,
        f"{scale * parameter.nominal:{form}}" if parameter.has_bound else "unknown",
        ("after", f"{scale * estimate.value:z{form}}"),
        f"{scale * estimate.deviation:+z{form}}" if parameter.has_bound else "",
        sd,
        bound,
        ("text", _remark(estimate)),
    )


def _remark(estimate: Estimate) -> str:
    remarks = []
    if estimate.undetermined_share > NO_EFFECT:
        remarks.append("no effect, kept at nominal")
    elif not estimate.is_determined:
        remarks.append("moves together with others")
    if estimate.is_at_bound:
        remarks.append("at its bound")
    return ", ".join(remarks)


def dh_section(nominal: Arm, calibrated: Arm) -> Section:
    """DH parameters and tool before and after: SpringerPlus 5:1771, Table 5; or that their rows are not the same."""
    title = "DH parameters before and after"
    try:
        nominal, calibrated = in_the_same_rows(nominal, calibrated)
    except ArmError as problem:
        return Section(title, paragraph(f"{problem}."))
    rows: list[Sequence[Cell]] = []
    keys = (("d_m", "m"), ("theta_rad", "rad"), ("L_m", "m"), ("alpha_rad", "rad"))
    links = zip(nominal.links, calibrated.links, strict=True)
    for number, (before, after) in enumerate(links, start=1):
        was, now = ([getattr(link, key) for key, _ in keys] for link in (before, after))
        units = [unit for _, unit in keys]
        rows.append((f"link {number}", ("before", "original"), *_spelled(was, units)))
        rows.append(("", ("after", "calibrated"), *_spelled(now, units)))
        moved = [b - a for a, b in zip(was, now, strict=True)]
        rows.append(("", ("soft", "difference"), *_spelled(moved, units, "+")))
    header = ("", "", "d [mm]", "theta [deg]", "L [mm]", "alpha [deg]")
    tool = _tool(nominal, calibrated)
    return Section(title, table(header, rows) + (paragraph(tool) if tool else ""))


def _spelled(values: Sequence[float], units: Sequence[str], sign: str = "") -> list[str]:
    return [
        f"{UNITS[unit][1] * value:{sign}z{UNITS[unit][2]}}" for value, unit in zip(values, units, strict=True)
    ]


def _tool(nominal: Arm, calibrated: Arm) -> str:
    before, after = nominal.tool.position_m, calibrated.tool.position_m
    if before == after:
        return ""
    was, now = (", ".join(f"{1e3 * part:.3f}" for part in place) for place in (before, after))
    return f"Tip in the last frame: {was} mm nominal, {now} mm calibrated."


SHOWN = 24  # most points listed unfolded
SUMMARY = ("mean [mm]", "95 % of the mean [mm]", "RMS [mm]", "max [mm]", "sd [mm]")


def verification_section(comparison: Comparison, where: str) -> Section:
    """Errors at points, described by `where`: SpringerPlus 5:1771, Table 4."""
    return Section(
        f"Error before and after, {where}",
        comparison_table(comparison)
        + bullets(findings(comparison))
        + vector_picture(comparison)
        + pair(histogram_picture(comparison), setup_picture(comparison))
        + _points(comparison),
    )


def calibration_section(comparison: Comparison) -> Section:
    """Errors at the points of the fit."""
    return Section(
        "At the calibration points",
        paragraph(
            "The fit used these points, so their errors are biased low; judge by points not used.", "soft"
        )
        + comparison_table(comparison)
        + vector_picture(comparison)
        + pair(histogram_picture(comparison), setup_picture(comparison)),
    )


def paths_section(pairs: Sequence[TrackPair]) -> Section:
    """Trajectories that calibration did not use: Table 6, Figs. 6, 7 and 10."""
    along = compare_tracks(pairs)
    figures = "".join(heading(f"{pair.name}, board {pair.setup}") + path_picture(pair) for pair in pairs)
    if along is None:
        return Section("Ideal and actual trajectories", paragraph("No path was run."))
    return Section(
        "Ideal and actual trajectories",
        comparison_table(along, "parts")
        + bullets(findings(along))
        + paragraph(
            f"Each path counts as {PARTS} parts, each with its mean error vector: errors of neighbouring camera frames are"
            " correlated and would make the interval too narrow.",
            "soft small",
        )
        + figures,
    )


def comparison_table(comparison: Comparison, counted: str = "points") -> str:
    """Each setup, and all: figures before and after, improvement."""
    rows: list[Sequence[Cell]] = []
    for entry in comparison.by_setup():
        rows.append((entry.setup, str(entry.before.count), ("before", "before"), *_figures(entry.before), ""))
        rows.append(
            ("", "", ("after", "after"), *_figures(entry.after), f"{entry.improvement_percent:.1f} %")
        )
    return table(("setup", counted, "", *SUMMARY, "improved"), rows)


def _figures(summary: ErrorSummary) -> tuple[str, ...]:
    interval = "" if math.isnan(summary.mean_half_width_m) else f"± {1e3 * summary.mean_half_width_m:.3f}"
    spread = "" if math.isnan(summary.sd_m) else f"{1e3 * summary.sd_m:.3f}"
    return (
        f"{1e3 * summary.mean_m:.3f}",
        interval,
        f"{1e3 * summary.rms_m:.3f}",
        f"{1e3 * summary.max_m:.3f}",
        spread,
    )


def _points(comparison: Comparison) -> str:
    """Every point with its own interval, folded if there are many."""
    rows: list[Sequence[Cell]] = []
    before, after = norms(comparison.before_m), norms(comparison.after_m)
    for k, (setup, point) in enumerate(zip(comparison.setup, comparison.point, strict=True)):
        x, y, z = (f"{1e3 * v:.1f}" for v in comparison.tip_m[k])
        rows.append(
            (
                setup,
                ("text", point),
                x,
                y,
                z,
                ("before", _with_interval(before[k], comparison.before_half_width_m[k])),
                ("after", _with_interval(after[k], comparison.after_half_width_m[k])),
                f"{improvement_percent(before[k], after[k]):.1f} %",
            )
        )
    header = (
        "setup",
        ("text", "point"),
        "x [mm]",
        "y [mm]",
        "z [mm]",
        "before [mm]",
        "after [mm]",
        "improved",
    )
    has_repeats = bool(np.isfinite(comparison.after_half_width_m).any())
    title = f"all {len(rows)} points{' (± is 95 % from the repeats at the point)' if has_repeats else ''}"
    return folded(title, table(header, rows), is_open=len(rows) <= SHOWN)


def _with_interval(distance_m: float, half_width_m: float) -> str:
    if math.isnan(half_width_m):
        return f"{1e3 * distance_m:.3f}"
    digits = max(3, digits_mm(half_width_m))
    return f"{1e3 * distance_m:.{digits}f} ± {1e3 * half_width_m:.{digits}f}"
