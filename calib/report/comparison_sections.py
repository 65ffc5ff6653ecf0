"""Sections of a report that compare errors before and after: at points, and along paths."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.arrays import norms
from calib.report.page import Cell, Section, bullets, folded, heading, pair, paragraph, table
from calib.report.path_pictures import path_picture
from calib.report.pictures import histogram_picture, setup_picture, vector_picture
from calib.validation.statistics import ErrorSummary, digits_mm
from calib.validation.verify import (
    PARTS,
    Comparison,
    TrackPair,
    compare_tracks,
    findings,
    improvement_percent,
)

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
