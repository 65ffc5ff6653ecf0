"""The pictures of `armwright plot`: their names, how they are drawn, the data that each needs; written to files or shown.

Colours are Okabe and Ito's, and curves never differ by colour alone. Each axis has its unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.report.page import PICTURE_STYLE as STYLE
from console.visualisation.metrics import tip_error_m
from console.visualisation.series import SHORTEST, Array, Series, envelope, orders, spectrum, with_gaps
from console.visualisation.snapshots import tips_of
from control.errors import ArmError
from control.files import make_whole
from control.plain_text import Advance, silent
from procedures.folders import require_new

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

MEASURED, SET, LIMIT, RUNS = "#0072B2", "#D55E00", "#5B6470", "#B9C0C8"
JOINT_COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
JOINT_LINES: Final[tuple[Any, ...]] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)), (0, (8, 3)))
PATH_POINTS: Final = 20_000
RUN_MARKS_MOST: Final = 40
LEAST_s: Final = 1e-7  # on a logarithmic axis
CAMERA_MARKS_MOST: Final = 1500
LEAST_ORDER, MOST_ORDER = 0.5, 16.0  # per motor turn; lower orders are the motion itself
ABOVE: Final[dict[str, Any]] = {"loc": "upper right", "ncols": 6, "fontsize": 8, "bbox_to_anchor": (0.985, 1.0)}
CAMERA_MARKS: Final[dict[str, Any]] = {
    "linestyle": "none",
    "marker": "x",
    "markersize": 3,
    "markeredgewidth": 0.7,
    "color": "#009E73",
    "label": "camera",
}
ENCODER_PATH: Final[dict[str, Any]] = {"color": MEASURED, "linewidth": 2.0, "label": "by the encoders"}
COMMANDED_PATH: Final[dict[str, Any]] = {"color": SET, "linewidth": 0.9, "linestyle": "--", "label": "commanded"}


def columns_of(joints: Sequence[int]) -> int:
    """Joints are below each other, in two columns if there are many."""
    return 1 if len(joints) <= 4 else 2


def joint_axes(figure: FigureBase, joints: Sequence[int]) -> list[Axes]:
    """One axes per joint, with time below the lowest."""
    columns = columns_of(joints)
    rows = math.ceil(len(joints) / columns)
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    margin = 0.075 if columns == 1 else 0.07
    height_in = 0.85 + 1.45 * rows
    figure.subplots_adjust(left=margin, right=0.985, top=1 - 0.42 / height_in, bottom=0.5 / height_in, hspace=0.28, wspace=0.16)
    axes = [ax for row in grid for ax in row]
    for spare in axes[len(joints) :]:
        spare.set_visible(False)
    for ax in axes[max(0, len(joints) - columns) : len(joints)]:
        ax.set_xlabel("time [s]")
        ax.tick_params(labelbottom=True)
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
    place = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 6, "borderaxespad": 0.1, "fontsize": 8}
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


def draw_supply(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Supply voltage and temperature of every drive."""
    axes = figure.subplots(2, 1, sharex=True)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.86, bottom=0.12, hspace=0.22)
    for ax, values, label in ((axes[0], series.supply_V, "supply [V]"), (axes[1], series.temperature_C, "temperature [°C]")):
        mark_runs(ax, series)
        for joint in joints:
            shown = np.where(values[:, joint - 1] > 0.0, values[:, joint - 1], np.nan)
            curve(ax, series, shown, **style_of(joint), label=series.joint_name(joint))
        ax.set_ylabel(label)
    legend(axes[0])
    axes[1].set_xlabel("time [s]")


def draw_spectra(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Amplitude spectral densities over frequency; amplitude of the current over the motor's angle."""
    axes = figure.subplots(1, 3)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.86, bottom=0.15, wspace=0.3)
    errors = series.following_error_rad
    for joint in joints:
        style = {**style_of(joint), "label": series.joint_name(joint), "linewidth": 1.0}
        _loglog(axes[0], *spectrum(series.t_s, 1e3 * errors[:, joint - 1], series.period_s), style)
        _loglog(axes[1], *spectrum(series.t_s, series.current_A[:, joint - 1], series.period_s), style)
        if drive := series.drive(joint):
            turns = series.q_rad[:, joint - 1] * drive.gear_ratio / (2.0 * math.pi)
            order, amplitude = orders(turns, series.current_A[:, joint - 1])
            is_cyclic = (order >= LEAST_ORDER) & (order <= MOST_ORDER)
            axes[2].plot(order[is_cyclic], 1e3 * amplitude[is_cyclic], **style)
    axes[0].set(xlabel="frequency [Hz]", ylabel="following error [mrad/√Hz]")
    axes[1].set(xlabel="frequency [Hz]", ylabel="current [A/√Hz]")
    axes[2].set(xlabel="order [per motor turn]", ylabel="current [mA]", xlim=(0, MOST_ORDER))
    head(axes[0], "following error")
    head(axes[1], "current")
    head(axes[2], "current over the motor's angle")
    for one in axes:
        say_if_empty(one)
    figure.legend(*axes[1].get_legend_handles_labels(), **ABOVE)


def _loglog(axes: Axes, frequency: Array, density: Array, style: dict[str, Any]) -> None:
    if len(frequency) and (density > 0.0).any():
        axes.loglog(frequency, np.where(density > 0.0, density, np.nan), **style)


def draw_tip(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Top and side view of the tip: commanded, by the model, by the camera; the camera's distance over time."""
    from control.kinematics.kinematics import ForwardKinematics

    grid = figure.add_gridspec(2, 2, height_ratios=[1.7, 1])
    figure.subplots_adjust(left=0.075, right=0.985, top=0.9, bottom=0.09, hspace=0.3, wspace=0.2)
    if series.arm is None:
        return
    step = max(1, len(series) // PATH_POINTS)
    kinematics = ForwardKinematics(series.arm)
    placed = np.where(series.is_placed[:, None], 1.0, np.nan)
    paths = [tips_of(kinematics, (placed * angles)[::step]) for angles in (series.joint_rad, series.joint_set_rad)]
    camera = series.tip_m[np.isfinite(series.tip_m).all(axis=1)]
    camera = camera[:: 1 + len(camera) // CAMERA_MARKS_MOST]
    for column, (i, j, seen) in enumerate(((0, 1, "top view"), (0, 2, "side view"))):
        axes = figure.add_subplot(grid[0, column])
        if len(camera):
            axes.plot(1e3 * camera[:, i], 1e3 * camera[:, j], **CAMERA_MARKS)
        for path, looks in zip(paths, (ENCODER_PATH, COMMANDED_PATH), strict=True):
            axes.plot(1e3 * path[:, i], 1e3 * path[:, j], **looks)
        axes.set(xlabel=f"{'xyz'[i]} [mm]", ylabel=f"{'xyz'[j]} [mm]")
        axes.set_aspect("equal", adjustable="datalim")
        head(axes, seen)
        if column == 0:
            figure.legend(*axes.get_legend_handles_labels(), **ABOVE)
    axes = figure.add_subplot(grid[1, :])
    mark_runs(axes, series)
    error = 1e3 * tip_error_m(series)
    seen_rows = np.isfinite(error)
    if seen_rows.any():
        t, shown = envelope(series.t_s[seen_rows], error[seen_rows])
        axes.plot(t, shown, color="#009E73", linewidth=0.6, marker=".", markersize=2)
        head(axes, f"camera minus model: rms {rms(error[seen_rows]):.3g} mm")
    say_if_empty(axes)
    axes.set(xlabel="time [s]", ylabel="distance [mm]")


def draw_lateness(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Lateness, duration and age of counts over time and as a distribution; what was missed, and why."""
    axes = figure.subplots(1, 3, width_ratios=[2, 1, 1])
    figure.subplots_adjust(left=0.075, right=0.985, top=0.84, bottom=0.17, wspace=0.3)
    for values, label, colour, line in (
        (series.late_s, "late", MEASURED, "-"),
        (series.busy_s, "busy", SET, "--"),
        (series.age_s, "age of counts", "#009E73", ":"),
    ):
        ordered_s = np.sort(values[np.isfinite(values)])
        if not len(ordered_s):
            continue
        curve(axes[0], series, 1e6 * values, color=colour, linestyle=line, label=label, linewidth=0.7)
        if ordered_s[-1] <= LEAST_s:  # nothing is late on a stepped clock
            continue
        share = 1.0 - np.arange(len(ordered_s)) / len(ordered_s)
        pick = np.unique(np.concatenate([np.geomspace(1, len(ordered_s), 300).astype(int), [1]]))
        axes[1].loglog(1e6 * np.maximum(ordered_s[-pick], LEAST_s), share[-pick], color=colour, linestyle=line, label=label)
    for total, label, colour in (
        (series.missed, "deadlines missed", LIMIT),
        (np.nancumsum(series.switches), "switches", MEASURED),
        (np.nancumsum(series.page_faults), "page faults", SET),
    ):
        if np.isfinite(total).any():
            curve(axes[2], series, total - np.nanmin(total), color=colour, label=label)
    axes[0].set(xlabel="time [s]", ylabel="duration [µs]")
    axes[1].set(xlabel="more than [µs]", ylabel="share of cycles [1]")
    axes[2].set(xlabel="time [s]", ylabel="so far [1]")
    legend(axes[0])
    legend(axes[2])
    for ax in axes:
        say_if_empty(ax)


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


def draw_tracking(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Set-point and measured angle."""
    for k, (axes, joint) in enumerate(zip(joint_axes(figure, joints), joints, strict=True)):
        mark_runs(axes, series)
        curve(axes, series, np.degrees(series.q_rad[:, joint - 1]), color=MEASURED, label="measured", linewidth=2.2)
        curve(
            axes, series, np.degrees(series.q_set_rad[:, joint - 1]), color=SET, linestyle="--", label="set-point", linewidth=0.9
        )
        axes.set_ylabel("angle [deg]")
        head(axes, series.joint_name(joint))
        if k == 0:
            legend(axes)


def draw_errors(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Following error, with its root mean square."""
    errors = 1e3 * series.following_error_rad
    for axes, joint in zip(joint_axes(figure, joints), joints, strict=True):
        error = errors[:, joint - 1]
        mark_runs(axes, series)
        axes.axhline(0.0, color=LIMIT, linewidth=0.6)
        curve(axes, series, error, color=MEASURED)
        axes.set_ylabel("error [mrad]")
        valid = error[np.isfinite(error)]
        figures = f": rms {rms(valid):.3g}, largest {np.abs(valid).max():.3g} mrad" if len(valid) else ""
        head(axes, f"{series.joint_name(joint)}{figures}")


def draw_currents(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Motor current and its limit."""
    for axes, joint in zip(joint_axes(figure, joints), joints, strict=True):
        current, drive = series.current_A[:, joint - 1], series.drive(joint)
        mark_runs(axes, series)
        curve(axes, series, current, color=MEASURED)
        axes.set_ylabel("current [A]")
        valid = current[np.isfinite(current)]
        figures = f": rms {rms(valid):.3g}, peak {np.abs(valid).max():.3g} A" if len(valid) else ""
        _limit(axes, valid, drive.current_limit_A if drive else None, "A")
        head(axes, f"{series.joint_name(joint)}{figures}")


def draw_voltages(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Commanded motor voltage and the supply that bounds it; gaps where the circuit was open."""
    for axes, joint in zip(joint_axes(figure, joints), joints, strict=True):
        voltage, supply = series.voltage_V[:, joint - 1], series.supply_V[:, joint - 1]
        drive = series.drive(joint)
        mark_runs(axes, series)
        curve(axes, series, voltage, color=MEASURED)
        axes.set_ylabel("voltage [V]")
        most = np.nanmax(supply) if (np.nan_to_num(supply) > 0.0).any() else drive.supply_V if drive else None
        valid = voltage[np.isfinite(voltage)]
        _limit(axes, valid, most, "V")
        head(axes, f"{series.joint_name(joint)}: peak {np.abs(valid).max():.3g} V" if len(valid) else series.joint_name(joint))


def _limit(axes: Axes, values: Array, limit: float | None, unit: str) -> None:
    """Lines at +-limit if the values come near it; else its value as text, so that the curve fills its axes."""
    if limit is None:
        return
    if len(values) and np.abs(values).max() > 0.5 * limit:
        for side in (-limit, limit):
            if values.min() < 0.0 or side > 0.0:
                axes.axhline(side, color=LIMIT, linestyle=(0, (4, 2)), linewidth=1.0)
        axes.margins(y=0.12)
    axes.annotate(f"limit ±{limit:.3g} {unit}", (1.0, 1.02), xycoords="axes fraction", ha="right", fontsize=8, color=LIMIT)


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
        """Its height [in]."""
        rows = math.ceil(len(joints) / columns_of(joints)) if self.is_per_joint else self.rows
        return 0.85 + self.row_in * rows


def _is_any(values: Array) -> bool:
    return bool(np.isfinite(values).any())


def _has_spectrum(series: Series) -> bool:
    return len(series) > SHORTEST and (_is_any(series.following_error_rad) or _is_any(series.current_A))


PICTURES: Final = (
    Picture("tracking", "Set-point and measured angle", draw_tracking, lambda s: len(s) > 0),
    Picture("errors", "Following error", draw_errors, lambda s: _is_any(s.following_error_rad)),
    Picture("currents", "Motor current", draw_currents, lambda s: _is_any(s.current_A)),
    Picture("voltages", "Commanded motor voltage", draw_voltages, lambda s: _is_any(s.voltage_V)),
    Picture("supply", "Supply and temperature", draw_supply, lambda s: _is_any(s.supply_V) or _is_any(s.temperature_C), False, 2),
    Picture("spectra", "Spectra", draw_spectra, _has_spectrum, False, 1, 2.6),
    Picture("tip", "Tip", draw_tip, lambda s: s.arm is not None and _is_any(s.q_rad), False, 1, 5.6),
    Picture("lateness", "Cycle timing", draw_lateness, lambda s: _is_any(s.late_s), False, 1, 2.0),
)


WIDTH_in: Final = 10.4
DOTS_PER_in: Final = 110
WITHOUT_WINDOWS: Final = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")
FORMS: Final = (".png", ".svg", ".pdf")


def write_each(
    folder: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int], report: Advance = silent
) -> list[Path]:
    """Write one PNG per picture to `folder`; return the files. `report` gets each title and the share done."""
    files = [folder / f"{picture.name}.png" for picture in pictures]
    require_new(folder, [file.name for file in files])
    folder.mkdir(parents=True, exist_ok=True)
    for k, (file, picture) in enumerate(zip(files, pictures, strict=True)):
        report(picture.title, k / len(pictures))
        _save(file, [picture], series, joints)
    return files


def write_sheet(file: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> list[Path]:
    """All pictures below each other in one file."""
    require_new(file.parent, [file.name])
    file.parent.mkdir(parents=True, exist_ok=True)
    _save(file, pictures, series, joints)
    return [file]


def show(pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> None:
    """Show a window per picture; returns when all are closed. ArmError if no window can be opened."""
    import matplotlib
    import matplotlib.pyplot as plt

    backend = plt.get_backend()
    if backend.lower() in WITHOUT_WINDOWS:
        raise ArmError(
            f"cannot open a window (matplotlib found no display or toolkit, backend {backend}): write files with"
            " --out DIR, FILE.png or FILE.svg"
        )
    with matplotlib.rc_context(STYLE):
        for picture in pictures:
            figure = plt.figure(picture.title, figsize=(WIDTH_in, picture.height_in(joints)))
            _draw(figure, picture, series, joints)
        plt.show()


def _save(file: Path, pictures: Sequence[Picture], series: Series, joints: Sequence[int]) -> None:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    heights = [picture.height_in(joints) for picture in pictures]
    with rc_context(STYLE):
        figure: Figure = Figure(figsize=(WIDTH_in, sum(heights)))
        parts: list[FigureBase] = [figure]
        if len(pictures) > 1:
            stacked = figure.subfigures(len(pictures), 1, squeeze=False, height_ratios=heights)
            parts = [row[0] for row in stacked]
        for part, picture in zip(parts, pictures, strict=True):
            _draw(part, picture, series, joints)
        about = {"Date": None} if file.suffix == ".svg" else None
        make_whole(file, lambda beside: figure.savefig(beside, dpi=DOTS_PER_in, metadata=about))


def _draw(on: FigureBase, picture: Picture, series: Series, joints: Sequence[int]) -> None:
    on.suptitle(f"{picture.title}: {series.name}", x=0.01, y=0.995, ha="left", va="top", fontsize=10)
    picture.draw(on, series, joints)
