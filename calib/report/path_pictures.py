"""Ideal against actual trajectories, as Figs. 6, 7 and 10 of SpringerPlus 5:1771: three planes, and the error along the path."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import norms
from calib.report.drawing import AFTER, BEFORE, NAMES, PLANNED, label_plane, svg
from calib.validation.verify import Track, TrackPair

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLANES = ((0, 1), (0, 2), (1, 2))
SAMPLES_DRAWN = 400
LEAST_SPAN_mm = 6.0  # for a plane seen edge-on, which would be too thin to see


def path_picture(pair: TrackPair) -> str:
    """Ideal and actual path before and after calibration in the planes xy, xz, yz, and the errors over time."""
    drawn = TrackPair(pair.name, pair.setup, thinned(pair.before), thinned(pair.after))
    return svg((10.4, 5.8), lambda figure: _draw(figure, drawn))


def thinned(track: Track) -> Track:
    """At most SAMPLES_DRAWN samples with a measured tip, to limit the file size.

    CalibrationError if the tip was never measured.
    """
    seen = track.seen()
    return seen.chosen(slice(None, None, -(-len(seen.time_s) // SAMPLES_DRAWN)))


def _draw(figure: Figure, pair: TrackPair) -> None:
    grid = figure.add_gridspec(
        2,
        3,
        height_ratios=[1.35, 1],
        left=0.065,
        right=0.985,
        top=0.9,
        bottom=0.085,
        wspace=0.27,
        hspace=0.36,
    )
    planes = [figure.add_subplot(grid[0, k]) for k in range(3)]
    for axes, (i, j) in zip(planes, PLANES, strict=True):
        _draw_plane(axes, pair, i, j)
    _draw_errors(figure.add_subplot(grid[1, :]), pair)
    handles, labels = planes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.99, 1.0), ncols=3)


def _draw_plane(axes: Axes, pair: TrackPair, i: int, j: int) -> None:
    ideal, before, after = (
        1e3 * path for path in (pair.after.planned_m, pair.before.measured_m, pair.after.measured_m)
    )
    axes.plot(before[:, i], before[:, j], "-.", color=BEFORE, lw=1.3, label="actual, before")
    axes.plot(after[:, i], after[:, j], "-", color=AFTER, lw=1.6, label="actual, after")
    axes.plot(ideal[:, i], ideal[:, j], "--", color=PLANNED, lw=1.2, label="ideal", zorder=3)
    label_plane(axes, i, j, f"{NAMES[i]}{NAMES[j]} plane")
    axes.locator_params(axis="x", nbins=5)  # more labels run into each other
    _widen(axes)


def _widen(axes: Axes) -> None:
    """Equal scales, except for a plane seen edge-on, which gets some width."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    if min(right - left, high - low) >= 0.2 * max(right - left, high - low):
        axes.set_aspect("equal", adjustable="datalim")
        return
    if right - left < high - low:
        axes.set_xlim(*_at_least(left, right))
    else:
        axes.set_ylim(*_at_least(low, high))
    axes.set_title(axes.get_title(loc="left") + " (scales differ)", loc="left")


def _at_least(low: float, high: float) -> tuple[float, float]:
    middle, half = 0.5 * (low + high), max(0.5 * LEAST_SPAN_mm, 0.6 * (high - low))
    return middle - half, middle + half


def _draw_errors(axes: Axes, pair: TrackPair) -> None:
    parts = []
    for track, colour, style, when in (
        (pair.before, BEFORE, "-.", "before"),
        (pair.after, AFTER, "-", "after"),
    ):
        error = 1e3 * norms(track.measured_m - track.planned_m)
        axes.plot(track.time_s, np.maximum(error, 1e-3), style, color=colour, lw=1.3, label=when)
        parts.append(f"{when} {np.mean(error):.2f} mm on average, {np.max(error):.2f} mm at most")
    axes.set(xlabel="time [s]", ylabel="|actual - ideal| [mm]", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_title(f"error along the path: {'; '.join(parts)}", loc="left")
    axes.margins(x=0.01)
