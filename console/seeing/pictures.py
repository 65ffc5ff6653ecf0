"""The figures of `armwright plot`: one function a picture, each on a (sub)figure of its own.

Colours are Okabe and Ito's, and no curve differs from another by colour alone. Each axis has its unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from console.seeing.merit import drive_of, tip_error_m
from console.seeing.series import Array, Series
from console.seeing.thinning import SHORTEST, envelope, orders, spectrum, with_gaps
from console.seeing.traces import tips_of

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
LEAST_ORDER, MOST_ORDER = 0.5, 16.0  # per motor turn; below is the motion itself
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
Draw = Callable[["FigureBase", Series, Sequence[int]], None]


@dataclass(frozen=True, slots=True)
class Picture:
    """One figure: its name, title, how it is drawn, its height [in] per row, and whether a series has anything for it.

    `is_per_joint`: one row a joint; else `rows` rows.
    """

    name: str
    title: str
    draw: Draw
    has: Callable[[Series], bool]
    is_per_joint: bool = True
    rows: int = 1
    row_in: float = 1.45

    def height_in(self, joints: Sequence[int]) -> float:
        """How high it wants to be."""
        rows = math.ceil(len(joints) / columns_of(joints)) if self.is_per_joint else self.rows
        return 0.85 + self.row_in * rows


def columns_of(joints: Sequence[int]) -> int:
    """Joints stand below each other, in two columns where there are many."""
    return 1 if len(joints) <= 4 else 2


def _rows(figure: FigureBase, joints: Sequence[int]) -> list[Axes]:
    """An axes a joint, time below the lowest."""
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


def _line(axes: Axes, series: Series, values: Array, **style: Any) -> None:
    """A curve over time, thinned, with gaps where the recording has gaps."""
    t, shown = with_gaps(*envelope(series.t_s, values), _step(series))
    looks: dict[str, Any] = {"linewidth": 1.0, "solid_joinstyle": "round"} | style
    axes.plot(t, shown, **looks)


def _step(series: Series) -> float:
    """Time between drawn points."""
    is_thinned = len(series) > 8000
    return max(series.period_s, (series.t_s[-1] - series.t_s[0]) / 2000 if is_thinned else 0.0)


def _mark_runs(axes: Axes, series: Series) -> None:
    """A thin line where a run begins, unless there are so many that they would hide the curves."""
    begins = np.flatnonzero(np.diff(series.run)) + 1
    if len(begins) <= RUN_MARKS_MOST:
        for k in begins:
            axes.axvline(series.t_s[k], color=RUNS, linewidth=0.7, zorder=0)


def _legend(axes: Axes, **more: Any) -> None:
    """Above the right end of the axes, where it hides no curve."""
    place = {
        "loc": "lower right",
        "bbox_to_anchor": (1.0, 1.0),
        "ncols": 6,
        "borderaxespad": 0.1,
        "fontsize": 8,
    }
    axes.legend(**place | more)


def _name(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize=9, pad=3)


def draw_tracking(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Set-point and measured angle."""
    for k, (axes, joint) in enumerate(zip(_rows(figure, joints), joints, strict=True)):
        _mark_runs(axes, series)
        _line(axes, series, series.q_rad[:, joint - 1], color=MEASURED, label="measured", linewidth=2.2)
        _line(
            axes,
            series,
            series.q_set_rad[:, joint - 1],
            color=SET,
            linestyle="--",
            label="set-point",
            linewidth=0.9,
        )
        axes.set_ylabel("angle [rad]")
        _name(axes, f"joint {joint}")
        if k == 0:
            _legend(axes)


def draw_errors(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Following error, its root mean square said."""
    errors = 1e3 * series.following_error_rad
    for axes, joint in zip(_rows(figure, joints), joints, strict=True):
        error = errors[:, joint - 1]
        _mark_runs(axes, series)
        axes.axhline(0.0, color=LIMIT, linewidth=0.6)
        _line(axes, series, error, color=MEASURED)
        axes.set_ylabel("error [mrad]")
        found = error[np.isfinite(error)]
        figures = f": rms {_rms(found):.3g}, largest {np.abs(found).max():.3g} mrad" if len(found) else ""
        _name(axes, f"joint {joint}{figures}")


def draw_currents(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Motor current and its limit."""
    for axes, joint in zip(_rows(figure, joints), joints, strict=True):
        current, drive = series.current_A[:, joint - 1], drive_of(series.arm, joint)
        _mark_runs(axes, series)
        _line(axes, series, current, color=MEASURED)
        axes.set_ylabel("current [A]")
        found = current[np.isfinite(current)]
        figures = f": rms {_rms(found):.3g}, peak {np.abs(found).max():.3g} A" if len(found) else ""
        _limit(axes, found, drive.current_limit_A if drive else None, "A")
        _name(axes, f"joint {joint}{figures}")


def draw_voltages(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Commanded motor voltage and the supply that bounds it; gaps where the circuit was open."""
    for axes, joint in zip(_rows(figure, joints), joints, strict=True):
        voltage, supply = series.voltage_V[:, joint - 1], series.supply_V[:, joint - 1]
        drive = drive_of(series.arm, joint)
        _mark_runs(axes, series)
        _line(axes, series, voltage, color=MEASURED)
        axes.set_ylabel("voltage [V]")
        most = np.nanmax(supply) if (np.nan_to_num(supply) > 0.0).any() else drive.supply_V if drive else None
        found = voltage[np.isfinite(voltage)]
        _limit(axes, found, most, "V")
        _name(axes, f"joint {joint}: peak {np.abs(found).max():.3g} V" if len(found) else f"joint {joint}")


def _limit(axes: Axes, values: Array, limit: float | None, unit: str) -> None:
    """Lines at +-limit where the values come near it; else its size in words, so that the curve fills its axes."""
    if limit is None:
        return
    if len(values) and np.abs(values).max() > 0.5 * limit:
        for side in (-limit, limit):
            if values.min() < 0.0 or side > 0.0:
                axes.axhline(side, color=LIMIT, linestyle=(0, (4, 2)), linewidth=1.0)
        axes.margins(y=0.12)
    axes.annotate(
        f"limit ±{limit:.3g} {unit}",
        (1.0, 1.02),
        xycoords="axes fraction",
        ha="right",
        fontsize=8,
        color=LIMIT,
    )


def draw_supply(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Supply voltage and temperature of every drive."""
    axes = figure.subplots(2, 1, sharex=True)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.86, bottom=0.12, hspace=0.22)
    for one, values, label in (
        (axes[0], series.supply_V, "supply [V]"),
        (axes[1], series.temperature_C, "temperature [°C]"),
    ):
        _mark_runs(one, series)
        for joint in joints:
            shown = np.where(values[:, joint - 1] > 0.0, values[:, joint - 1], np.nan)
            _line(one, series, shown, **_style(joint), label=f"joint {joint}")
        one.set_ylabel(label)
    _legend(axes[0])
    axes[1].set_xlabel("time [s]")


def _style(joint: int) -> dict[str, Any]:
    k = joint - 1
    return {"color": JOINT_COLOURS[k % len(JOINT_COLOURS)], "linestyle": JOINT_LINES[k % len(JOINT_LINES)]}


def draw_spectra(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Amplitude spectral densities over frequency; amplitude of the current over the motor's angle."""
    axes = figure.subplots(1, 3)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.86, bottom=0.15, wspace=0.3)
    errors = series.following_error_rad
    for joint in joints:
        style = {**_style(joint), "label": f"joint {joint}", "linewidth": 1.0}
        _loglog(axes[0], *spectrum(series.t_s, 1e3 * errors[:, joint - 1], series.period_s), style)
        _loglog(axes[1], *spectrum(series.t_s, series.current_A[:, joint - 1], series.period_s), style)
        if drive := drive_of(series.arm, joint):
            turns = series.q_rad[:, joint - 1] * drive.gear_ratio / (2.0 * math.pi)
            order, amplitude = orders(turns, series.current_A[:, joint - 1])
            is_cyclic = (order >= LEAST_ORDER) & (order <= MOST_ORDER)
            axes[2].plot(order[is_cyclic], 1e3 * amplitude[is_cyclic], **style)
    axes[0].set(xlabel="frequency [Hz]", ylabel="following error [mrad/√Hz]")
    axes[1].set(xlabel="frequency [Hz]", ylabel="current [A/√Hz]")
    axes[2].set(xlabel="order [per motor turn]", ylabel="current [mA]", xlim=(0, MOST_ORDER))
    _name(axes[0], "following error")
    _name(axes[1], "current")
    _name(axes[2], "current over the motor's angle")
    for one in axes:
        _say_if_empty(one)
    figure.legend(*axes[1].get_legend_handles_labels(), **ABOVE)


def _loglog(axes: Axes, frequency: Array, density: Array, style: dict[str, Any]) -> None:
    if len(frequency) and (density > 0.0).any():
        axes.loglog(frequency, np.where(density > 0.0, density, np.nan), **style)


def _say_if_empty(axes: Axes) -> None:
    if not any(len(np.atleast_1d(np.asarray(line.get_xdata()))) for line in axes.lines):
        text = "not enough of it\nin this recording"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=LIMIT)


def draw_tip(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """The tip from above and from the side: commanded, by the model, by the camera; the camera's distance over time."""
    from control.model.kinematics import Kinematics

    grid = figure.add_gridspec(2, 2, height_ratios=[1.7, 1])
    figure.subplots_adjust(left=0.075, right=0.985, top=0.9, bottom=0.09, hspace=0.3, wspace=0.2)
    if series.arm is None:
        return
    step = max(1, len(series) // PATH_POINTS)
    kinematics = Kinematics(series.arm)
    placed = np.where(series.is_placed[:, None], 1.0, np.nan)
    paths = [tips_of(kinematics, (placed * angles)[::step]) for angles in (series.q_rad, series.q_set_rad)]
    camera = series.tip_m[np.isfinite(series.tip_m).all(axis=1)]
    camera = camera[:: 1 + len(camera) // CAMERA_MARKS_MOST]
    for column, (i, j, seen) in enumerate(((0, 1, "from above"), (0, 2, "from the side"))):
        axes = figure.add_subplot(grid[0, column])
        if len(camera):
            axes.plot(1e3 * camera[:, i], 1e3 * camera[:, j], **CAMERA_MARKS)
        for path, looks in zip(paths, (ENCODER_PATH, COMMANDED_PATH), strict=True):
            axes.plot(1e3 * path[:, i], 1e3 * path[:, j], **looks)
        axes.set(xlabel=f"{'xyz'[i]} [mm]", ylabel=f"{'xyz'[j]} [mm]")
        axes.set_aspect("equal", adjustable="datalim")
        _name(axes, seen)
        if column == 0:
            figure.legend(*axes.get_legend_handles_labels(), **ABOVE)
    axes = figure.add_subplot(grid[1, :])
    _mark_runs(axes, series)
    error = 1e3 * tip_error_m(series)
    seen_rows = np.isfinite(error)
    if seen_rows.any():
        t, shown = envelope(series.t_s[seen_rows], error[seen_rows])
        axes.plot(t, shown, color="#009E73", linewidth=0.6, marker=".", markersize=2)
        _name(axes, f"camera from model: rms {_rms(error[seen_rows]):.3g} mm")
    _say_if_empty(axes)
    axes.set(xlabel="time [s]", ylabel="distance [mm]")


def draw_lateness(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """How late cycles began and how long they took, over time and as shares; deadlines missed."""
    axes = figure.subplots(1, 3, width_ratios=[2, 1, 1])
    figure.subplots_adjust(left=0.075, right=0.985, top=0.84, bottom=0.17, wspace=0.3)
    for values, label, colour, line in (
        (series.late_s, "late", MEASURED, "-"),
        (series.busy_s, "busy", SET, "--"),
    ):
        found = np.sort(values[np.isfinite(values)])
        if not len(found):
            continue
        _line(axes[0], series, 1e6 * values, color=colour, linestyle=line, label=label, linewidth=0.7)
        if found[-1] <= LEAST_s:  # on a stepped clock nothing is ever late
            continue
        share = 1.0 - np.arange(len(found)) / len(found)
        pick = np.unique(np.concatenate([np.geomspace(1, len(found), 300).astype(int), [1]]))
        axes[1].loglog(
            1e6 * np.maximum(found[-pick], LEAST_s), share[-pick], color=colour, linestyle=line, label=label
        )
    if np.isfinite(series.missed).any():
        _line(axes[2], series, series.missed - np.nanmin(series.missed), color=LIMIT)
    axes[0].set(xlabel="time [s]", ylabel="duration [µs]")
    axes[1].set(xlabel="more than [µs]", ylabel="share of cycles [1]")
    axes[2].set(xlabel="time [s]", ylabel="deadlines missed [1]")
    _legend(axes[0])
    for one in axes:
        _say_if_empty(one)


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _is_any(values: Array) -> bool:
    return bool(np.isfinite(values).any())


def _has_spectrum(series: Series) -> bool:
    return len(series) > SHORTEST and (_is_any(series.following_error_rad) or _is_any(series.current_A))


PICTURES: Final = (
    Picture("tracking", "Set-point and measured angle", draw_tracking, lambda s: len(s) > 0),
    Picture("errors", "Following error", draw_errors, lambda s: _is_any(s.following_error_rad)),
    Picture("currents", "Motor current", draw_currents, lambda s: _is_any(s.current_A)),
    Picture("voltages", "Commanded motor voltage", draw_voltages, lambda s: _is_any(s.voltage_V)),
    Picture(
        "supply", "Supply and temperature", draw_supply,
        lambda s: _is_any(s.supply_V) or _is_any(s.temperature_C), False, 2,
    ),
    Picture("spectra", "Spectra", draw_spectra, _has_spectrum, False, 1, 2.6),
    Picture("tip", "Tip", draw_tip, lambda s: s.arm is not None and _is_any(s.q_rad), False, 1, 5.6),
    Picture("lateness", "Punctuality of the loop", draw_lateness, lambda s: _is_any(s.late_s), False, 1, 2.0),
)  # fmt: skip
