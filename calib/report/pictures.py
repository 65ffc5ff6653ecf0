"""The report's pictures of errors before and after, at points and along trajectories."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array, norms
from calib.report.page import AFTER, BEFORE, NAMES, PLANNED, label_plane, svg
from calib.validation.verify import Comparison, Track, TrackPair

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "o^sDvP"
ARROW_SHARE = 0.16  # length of a typical arrow as a share of the points' extent
DRAWN_MOST = 1000  # points: more would hide each other, in a file of many megabytes
ARROW_LIMIT = 3.0  # longest arrow in typical errors


def vector_picture(comparison: Comparison) -> str:
    """Error vectors at the points, seen from above and from the side, before and after, each with a scale arrow.

    Of very many points, some: the picture says how many.
    """
    return svg((10.4, 7.4), lambda figure: _draw_vectors(figure, comparison.thinned(DRAWN_MOST)))


def histogram_picture(comparison: Comparison) -> str:
    """Histogram of errors before and after, on one logarithmic axis."""
    return _small(lambda axes: _draw_histogram(axes, comparison))


def setup_picture(comparison: Comparison) -> str:
    """Mean error of each setup with its 95 % interval, and all points."""
    return _small(lambda axes: _draw_setups(axes, comparison))


def _small(draw: Callable[[Axes], None]) -> str:
    def on(figure: Figure) -> None:
        figure.subplots_adjust(left=0.12, right=0.98, top=0.9, bottom=0.15)
        draw(figure.subplots())

    return svg((5.1, 3.2), on)


def _draw_vectors(figure: Figure, comparison: Comparison) -> None:
    axes = figure.subplots(2, 2, squeeze=False, height_ratios=[1.25, 1])
    figure.subplots_adjust(left=0.065, right=0.985, top=0.9, bottom=0.07, wspace=0.17, hspace=0.3)
    for column, (errors, colour, when) in enumerate(
        ((comparison.before_m, BEFORE, "before"), (comparison.after_m, AFTER, "after"))
    ):
        for row, (i, j, seen) in enumerate(((0, 1, "from above"), (0, 2, "from the side"))):
            _draw_arrows(axes[row][column], comparison, errors, (i, j), colour)
            label_plane(axes[row][column], i, j, f"{when}, {seen}")
    _name_setups(figure, axes[0][0], comparison)


def _draw_arrows(axes: Axes, comparison: Comparison, errors: Array, plane: tuple[int, int], colour: str) -> None:
    """Points, arrows, a scale, and limits that hold them."""
    i, j = plane
    tips, shown = 1e3 * comparison.tip_m, 1e3 * errors
    typical, magnified = _magnification(tips, shown)
    _mark_setups(axes, comparison, tips[:, i], tips[:, j])
    reach = magnified * _cut(shown, ARROW_LIMIT * typical)
    arrows = axes.quiver(
        tips[:, i],
        tips[:, j],
        reach[:, i],
        reach[:, j],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.0042,
        zorder=3,
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.update_datalim(np.vstack((tips, tips + reach))[:, plane])
    axes.margins(0.06)
    axes.autoscale_view()
    length_mm = _round_length(typical)
    is_cut = float(norms(shown).max()) > ARROW_LIMIT * typical
    words = f"{length_mm:g} mm, drawn {magnified:.3g} times{', the longest cut' if is_cut else ''}"
    place = {"labelpos": "E", "coordinates": "axes", "fontproperties": {"size": 8}}
    axes.quiverkey(arrows, 0.58, 1.05, magnified * length_mm, words, **place)


def _cut(errors: Array, limit: float) -> Array:
    """Errors (m, 3) cut to a limit, so that one tip in the wrong cavity does not shrink all others to dots."""
    return np.asarray(errors * np.minimum(1.0, limit / np.maximum(norms(errors), 1e-12))[:, None])


def _magnification(tips: Array, errors: Array) -> tuple[float, float]:
    """A typical error, and the magnification."""
    extent = float(max(np.ptp(tips[:, 0]), np.ptp(tips[:, 1]), 1.0))
    typical = float(np.percentile(norms(errors), 95)) or 1e-9
    return typical, ARROW_SHARE * extent / typical


def _mark_setups(axes: Axes, comparison: Comparison, x: Array, y: Array) -> None:
    """The points, each setup with a marker of its own."""
    for k, setup in enumerate(comparison.setups):
        rows = [n for n, name in enumerate(comparison.setup) if name == setup]
        marker = MARKERS[k % len(MARKERS)]
        axes.plot(x[rows], y[rows], marker, ms=3.2, mfc="white", mec=PLANNED, label=setup, zorder=2)


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length * (1.0 + 1e-9)))


def _name_setups(figure: Figure, axes: Axes, comparison: Comparison) -> None:
    if len(comparison.setups) > 1:
        handles, labels = axes.get_legend_handles_labels()
        place = (0.99, 1.0)
        figure.legend(handles, labels, loc="upper right", bbox_to_anchor=place, ncols=min(6, len(labels)))


def _draw_histogram(axes: Axes, comparison: Comparison) -> None:
    before, after = 1e3 * norms(comparison.before_m), 1e3 * norms(comparison.after_m)
    both = np.concatenate((before, after))
    low, high = max(float(both.min()), 1e-4), max(float(both.max()), 2e-4)
    bins = np.geomspace(0.9 * low, 1.1 * high, 28)
    for errors, colour, label, hatch in ((before, BEFORE, "before", "////"), (after, AFTER, "after", None)):
        axes.hist(
            np.maximum(errors, low), bins=bins.tolist(), color=colour, alpha=0.75, label=label, hatch=hatch, edgecolor="white"
        )
        axes.axvline(float(errors.mean()), color=colour, lw=1.5, ls="--" if label == "before" else "-")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="distance between commanded and measured tip [mm]", ylabel="points")
    axes.set_title("errors (lines: means)", loc="left")
    axes.legend()


def _draw_setups(axes: Axes, comparison: Comparison) -> None:
    """Every point, and the means with their intervals over them."""
    entries = [comparison.of(name) for name in comparison.setups]
    drawn = comparison.thinned(DRAWN_MOST)
    place = {name: float(k) for k, name in enumerate(comparison.setups)}
    at = np.array([place[name] for name in drawn.setup])
    for shift, errors_m, summaries, colour, marker, when in (
        (-0.17, drawn.before_m, [e.before for e in entries], BEFORE, "s", "before"),
        (0.17, drawn.after_m, [e.after for e in entries], AFTER, "o", "after"),
    ):
        axes.plot(at + shift, 1e3 * norms(errors_m), ".", color=colour, alpha=0.3, ms=4)
        axes.errorbar(
            np.arange(len(summaries)) + shift,
            [1e3 * s.mean_m for s in summaries],
            yerr=[np.nan_to_num(1e3 * s.mean_half_width_m) for s in summaries],
            fmt=marker,
            color=colour,
            mec="black",
            mew=0.6,
            capsize=5,
            label=f"{when}, mean and 95 %",
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(np.arange(len(entries), dtype=float), [e.setup for e in entries])
    axes.set_xlim(-0.6, len(entries) - 0.4)
    axes.set(xlabel="setup", ylabel="error [mm]")
    axes.set_title("error by setup", loc="left")
    axes.legend(fontsize=8)


# Ideal against actual trajectories, as Figs. 6, 7 and 10 of SpringerPlus 5:1771: three planes, and the error along the path.

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
        2, 3, height_ratios=[1.35, 1], left=0.065, right=0.985, top=0.9, bottom=0.085, wspace=0.27, hspace=0.36
    )
    planes = [figure.add_subplot(grid[0, k]) for k in range(3)]
    for axes, (i, j) in zip(planes, PLANES, strict=True):
        _draw_plane(axes, pair, i, j)
    _draw_errors(figure.add_subplot(grid[1, :]), pair)
    handles, labels = planes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", bbox_to_anchor=(0.99, 1.0), ncols=3)


def _draw_plane(axes: Axes, pair: TrackPair, i: int, j: int) -> None:
    ideal, before, after = (1e3 * path for path in (pair.after.planned_m, pair.before.measured_m, pair.after.measured_m))
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
    for track, colour, style, when in ((pair.before, BEFORE, "-.", "before"), (pair.after, AFTER, "-", "after")):
        error = 1e3 * norms(track.measured_m - track.planned_m)
        axes.plot(track.time_s, np.maximum(error, 1e-3), style, color=colour, lw=1.3, label=when)
        parts.append(f"{when} {np.mean(error):.2f} mm on average, {np.max(error):.2f} mm at most")
    axes.set(xlabel="time [s]", ylabel="|actual - ideal| [mm]", yscale="log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_title(f"error along the path: {'; '.join(parts)}", loc="left")
    axes.margins(x=0.01)
