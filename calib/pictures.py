"""The report's pictures, as SVG text. Every axis has its unit; colours are Okabe and Ito's, told apart by colour-blind
readers, and no curve differs from another by colour alone.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array, norms
from calib.errors import CalibrationError
from calib.report_data import Track
from calib.verify import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, PLANNED = "#D55E00", "#0072B2", "#5B6470"
PLANES = ((0, 1), (0, 2), (1, 2))
NAMES = "xyz"
SAMPLES_DRAWN = 1500
MARKERS = "o^sDvP"


def tracking_picture(track: Track) -> str:
    """Planned and measured tip in three planes, and the error over time with its components."""
    return _svg((10.4, 6.4), lambda figure: _draw_tracking(figure, thinned(track)))


def vector_picture(comparison: Comparison) -> str:
    """Error vectors at the points, seen from above and from the side, before and after, each with a scale arrow."""
    return _svg((10.4, 7.6), lambda figure: _draw_vectors(figure, comparison))


def histogram_picture(comparison: Comparison) -> str:
    """How often which error occurs, before and after, on one logarithmic axis."""
    return _svg((5.1, 3.2), lambda figure: _draw_histogram(figure.subplots(), comparison))


def setup_picture(comparison: Comparison) -> str:
    """Mean error of each setup with its 95 % interval, every point beside it."""
    return _svg((5.1, 3.2), lambda figure: _draw_setups(figure.subplots(), comparison))


def thinned(track: Track) -> Track:
    """At most SAMPLES_DRAWN samples, of those where the tip was seen: more only make the file large.

    CalibrationError if the tip was never seen.
    """
    seen = np.flatnonzero(np.isfinite(track.measured_m).all(axis=1))
    if not len(seen):
        raise CalibrationError(
            f"track {track.name}: the tip was measured at no time; leave it out of the report"
        )
    rows = seen[:: -(-len(seen) // SAMPLES_DRAWN)]
    return Track(track.name, track.time_s[rows], track.planned_m[rows], track.measured_m[rows])


def _svg(size_in: tuple[float, float], draw: Callable[[Figure], None]) -> str:
    """An inline <svg>; no window system, no state left behind."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(
        {
            "font.family": "sans-serif",
            "font.sans-serif": ["DejaVu Sans"],
            "font.size": 9,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.edgecolor": "#8A929C",
            "axes.grid": True,
            "grid.color": "#E3E7EC",
            "grid.linewidth": 0.7,
            "axes.axisbelow": True,
            "axes.titlesize": 10,
            "axes.titleweight": "bold",
            "axes.titlelocation": "left",
            "legend.frameon": False,
            "svg.fonttype": "path",
            "svg.hashsalt": "armwright",
        }
    ):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.S)
    return re.sub(
        r'(<svg[^>]*?) width="[^"]*"',
        r"\1",
        re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1),
        count=1,
    )


def _draw_tracking(figure: Figure, track: Track) -> None:
    axes = figure.subplot_mosaic([["a", "b", "c"], ["t", "t", "t"]], height_ratios=[1.25, 1])
    for key, (i, j) in zip("abc", PLANES, strict=True):
        _draw_plane(axes[key], track, i, j)
    _draw_error_over_time(axes["t"], track)
    handles, labels = axes["a"].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2)


def _draw_plane(axes: Axes, track: Track, i: int, j: int) -> None:
    planned, measured = 1e3 * track.planned_m, 1e3 * track.measured_m
    axes.plot(planned[:, i], planned[:, j], "--", color=PLANNED, lw=1.6, label="planned", zorder=3)
    axes.plot(measured[:, i], measured[:, j], "-", color=AFTER, lw=1.4, label="measured")
    axes.set(xlabel=f"{NAMES[i]} [mm]", ylabel=f"{NAMES[j]} [mm]", title=f"{NAMES[i]}-{NAMES[j]} plane")
    _widen(axes)


def _widen(axes: Axes) -> None:
    """Equal scales, except for a plane seen edge-on: there the thin direction gets 6 mm at least, to be seen."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    thin = min(right - left, high - low) < 0.2 * max(right - left, high - low)
    if not thin:
        axes.set_aspect("equal", adjustable="datalim")
        return
    middle, half = 0.5 * (low + high), max(3.0, 0.6 * (high - low))
    axes.set_ylim(middle - half, middle + half)
    axes.set_title(axes.get_title(loc="left") + "  (scales differ)", loc="left")


def _draw_error_over_time(axes: Axes, track: Track) -> None:
    error = 1e3 * (track.measured_m - track.planned_m)
    for k, (colour, style) in enumerate((("#E69F00", "--"), ("#009E73", "-."), ("#CC79A7", ":"))):
        axes.plot(track.time_s, error[:, k], style, color=colour, lw=1.4, label=NAMES[k])
    length = norms(error)
    rms = float(np.sqrt(np.mean(length**2)))
    axes.plot(track.time_s, length, "-", color="black", lw=1.3, label="length")
    axes.set(xlabel="time [s]", ylabel="measured - planned [mm]")
    axes.set_title(f"error over time: RMS {rms:.2f} mm, largest {np.max(length):.2f} mm", loc="left")
    axes.legend(ncols=4, loc="upper right")
    axes.margins(x=0.01, y=0.18)


def _draw_vectors(figure: Figure, comparison: Comparison) -> None:
    axes = figure.subplots(2, 2, squeeze=False, height_ratios=[1.25, 1])
    for column, (errors, colour, when) in enumerate(
        ((comparison.before_m, BEFORE, "before"), (comparison.after_m, AFTER, "after"))
    ):
        for row, (i, j, seen) in enumerate(((0, 1, "from above"), (0, 2, "from the side"))):
            _draw_arrows(axes[row][column], comparison, errors, (i, j), colour)
            axes[row][column].set(xlabel=f"{NAMES[i]} [mm]", ylabel=f"{NAMES[j]} [mm]")
            axes[row][column].set_title(f"{when}, {seen}", loc="left")
    _mark_setups(figure, axes[0][0], comparison)


def _draw_arrows(
    axes: Axes, comparison: Comparison, errors: Array, plane: tuple[int, int], colour: str
) -> None:
    i, j = plane
    tips, shown = 1e3 * comparison.tip_m, 1e3 * errors
    extent = float(max(np.ptp(tips[:, 0]), np.ptp(tips[:, 1]), 1.0))
    typical = float(np.percentile(norms(shown), 95)) or 1e-9
    magnified = 0.16 * extent / typical
    for k, setup in enumerate(comparison.setups):
        rows = [n for n, name in enumerate(comparison.setup) if name == setup]
        axes.plot(
            tips[rows, i],
            tips[rows, j],
            MARKERS[k % len(MARKERS)],
            ms=3.2,
            mfc="white",
            mec=PLANNED,
            label=setup,
            zorder=2,
        )
    arrows = axes.quiver(
        tips[:, i],
        tips[:, j],
        magnified * shown[:, i],
        magnified * shown[:, j],
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.0042,
        zorder=3,
    )
    axes.set_aspect("equal", adjustable="datalim")
    ends = np.vstack((tips, tips + magnified * shown))
    axes.update_datalim(ends[:, plane])
    axes.margins(0.06)
    axes.autoscale_view()
    length_mm = _round_length(typical)
    words = f"{length_mm:g} mm, drawn {magnified:.3g} times"
    axes.quiverkey(
        arrows,
        0.58,
        1.05,
        magnified * length_mm,
        words,
        labelpos="E",
        coordinates="axes",
        fontproperties={"size": 8},
    )


def _round_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length * (1.0 + 1e-9)))


def _mark_setups(figure: Figure, axes: Axes, comparison: Comparison) -> None:
    if len(comparison.setups) > 1:
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper right", ncols=len(labels), title="setup of the point"
        )


def _draw_histogram(axes: Axes, comparison: Comparison) -> None:
    before, after = 1e3 * norms(comparison.before_m), 1e3 * norms(comparison.after_m)
    both = np.concatenate((before, after))
    low, high = max(float(both.min()), 1e-4), max(float(both.max()), 2e-4)
    bins = np.geomspace(0.9 * low, 1.1 * high, 28)
    for errors, colour, label, hatch in ((before, BEFORE, "before", "////"), (after, AFTER, "after", None)):
        axes.hist(
            np.maximum(errors, low),
            bins=bins.tolist(),
            color=colour,
            alpha=0.75,
            label=label,
            hatch=hatch,
            edgecolor="white",
        )
        axes.axvline(float(errors.mean()), color=colour, lw=1.5, ls="--" if label == "before" else "-")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="distance between wanted and measured tip [mm]", ylabel="points")
    axes.set_title("errors (lines: means)", loc="left")
    axes.legend()


def _draw_setups(axes: Axes, comparison: Comparison) -> None:
    entries = [comparison.of(name) for name in comparison.setups]
    place = np.arange(len(entries), dtype=float)
    for shift, colour, marker, label in ((-0.17, BEFORE, "s", "before"), (0.17, AFTER, "o", "after")):
        summaries = [e.before if label == "before" else e.after for e in entries]
        errors = norms(comparison.before_m if label == "before" else comparison.after_m)
        own = np.array([comparison.setups.index(name) for name in comparison.setup], dtype=float)
        axes.plot(own + shift, 1e3 * errors, ".", color=colour, alpha=0.3, ms=4)
        axes.errorbar(
            place + shift,
            [1e3 * s.mean_m for s in summaries],
            yerr=[np.nan_to_num(1e3 * s.mean_half_width_m) for s in summaries],
            fmt=marker,
            color=colour,
            mec="black",
            mew=0.6,
            capsize=5,
            label=f"{label}, mean and 95 %",
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xticks(place, [e.setup for e in entries])
    axes.set_xlim(-0.6, len(entries) - 0.4)
    axes.set(xlabel="setup", ylabel="error [mm]")
    axes.set_title("error by setup", loc="left")
    axes.legend(fontsize=8)
