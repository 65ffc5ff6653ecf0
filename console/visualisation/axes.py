"""Layout and style of the figures of `armwright plot`.

Colours are Okabe and Ito's, and curves never differ by colour alone. Each axis has its unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from console.visualisation.series import Array, Series, envelope, with_gaps

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase

MEASURED, SET, LIMIT, RUNS = "#0072B2", "#D55E00", "#5B6470", "#B9C0C8"
JOINT_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
JOINT_LINES: Final[tuple[Any, ...]] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
PATH_POINTS: Final = 20_000
RUN_MARKS_MOST: Final = 40
LEAST_s: Final = 1e-7  # on a logarithmic axis
CAMERA_MARKS_MOST: Final = 1500
LEAST_ORDER, MOST_ORDER = 0.5, 16.0  # per motor turn; lower orders are the motion itself
ABOVE: Final[dict[str, Any]] = {
    "loc": "upper right", "ncols": 6, "fontsize": 8, "bbox_to_anchor": (0.985, 1.0),
}  # fmt: skip
CAMERA_MARKS: Final[dict[str, Any]] = {
    "linestyle": "none", "marker": "x", "markersize": 3, "markeredgewidth": 0.7, "color": "#009E73", "label": "camera",
}  # fmt: skip
ENCODER_PATH: Final[dict[str, Any]] = {"color": MEASURED, "linewidth": 2.0, "label": "by the encoders"}
COMMANDED_PATH: Final[dict[str, Any]] = {
    "color": SET, "linewidth": 0.9, "linestyle": "--", "label": "commanded",
}  # fmt: skip


def columns_of(joints: Sequence[int]) -> int:
    """Joints are below each other, in two columns if there are many."""
    return 1 if len(joints) <= 4 else 2


def joint_axes(figure: FigureBase, joints: Sequence[int]) -> list[Axes]:
    """One axes per joint, with time below the lowest."""
    columns = columns_of(joints)
    rows = math.ceil(len(joints) / columns)
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    left = 0.075 if columns == 1 else 0.07
    height_in = 0.85 + 1.45 * rows
    figure.subplots_adjust(
        left=left, right=0.985, top=1 - 0.42 / height_in, bottom=0.5 / height_in, hspace=0.28, wspace=0.16
    )
    axes = [one for row in grid for one in row]
    for spare in axes[len(joints) :]:
        spare.set_visible(False)
    for one in axes[max(0, len(joints) - columns) : len(joints)]:
        one.set_xlabel("time [s]")
        one.tick_params(labelbottom=True)
    return axes[: len(joints)]


def curve(axes: Axes, series: Series, values: Array, **style: Any) -> None:
    """A curve over time, thinned, with gaps where the recording has gaps."""
    t, shown = with_gaps(*envelope(series.t_s, values), _step(series))
    looks: dict[str, Any] = {"linewidth": 1.0, "solid_joinstyle": "round"} | style
    axes.plot(t, shown, **looks)


def _step(series: Series) -> float:
    """Time between drawn points."""
    is_thinned = len(series) > 8000
    return max(series.period_s, (series.t_s[-1] - series.t_s[0]) / 2000 if is_thinned else 0.0)


def mark_runs(axes: Axes, series: Series) -> None:
    """A thin line at the start of each run, unless there are so many that they would hide the curves."""
    begins = np.flatnonzero(np.diff(series.run)) + 1
    if len(begins) <= RUN_MARKS_MOST:
        for k in begins:
            axes.axvline(series.t_s[k], color=RUNS, linewidth=0.7, zorder=0)


def legend(axes: Axes, **more: Any) -> None:
    """A legend above the right end of the axes, where it hides no curve."""
    place = {
        "loc": "lower right",
        "bbox_to_anchor": (1.0, 1.0),
        "ncols": 6,
        "borderaxespad": 0.1,
        "fontsize": 8,
    }
    axes.legend(**place | more)


def head(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=9, pad=3)


def style_of(joint: int) -> dict[str, Any]:
    k = joint - 1
    return {"color": JOINT_COLOURS[k % len(JOINT_COLOURS)], "linestyle": JOINT_LINES[k % len(JOINT_LINES)]}


def say_if_empty(axes: Axes) -> None:
    if not any(len(np.atleast_1d(np.asarray(line.get_xdata()))) for line in axes.lines):
        text = "not enough samples\nin this recording"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=LIMIT)


def rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2)))
