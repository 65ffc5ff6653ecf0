"""Pictures of the report: how the gap shrank, and what is left along whatever may name it.

Poses and time series show themselves in the same few pictures: a size by place (a recording, a channel), what is left against
what it may follow, and a law or a map over its own variable. A stage is a model in a word, with what it leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array, rms
from calib.gap.finding import DrawnLaw, NamedEffect
from calib.gap.maps.choose import DrawnMap
from calib.gap.poses.linear import along_joint
from calib.gap.poses.outcome import StaticGap
from calib.gap.residuals.rows import ChannelRows
from calib.gap.series.find import DynamicOutcome
from calib.gap.words import unit_of
from calib.report.page import AFTER, BEFORE, PLANNED, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Stage = tuple[str, Array]
Side = tuple[Array, str]  # what a residual may follow, and its label
COLOURS, MARKS = (BEFORE, AFTER), "so"
NO_TORQUE_Nm = 1e-6
SHOWN = 0.98  # of the points that an axis must hold
DOTS_MOST = 2500  # more are not seen, and the page stays small
ARROWS_MOST = 250  # more hide each other
ARROW_SHARE = 0.08  # of the workspace: a long arrow
NAMES_MOST = 40  # recordings on one axis
HIGHEST_ORDER = 24.0  # periods per motor turn
FEW_DOTS = 200  # up to which they are large
MAP_LABELS = {
    "angle_rad": ("its angle [deg]", 180.0 / math.pi),
    "motor_turn_rad": ("turn of the motor [deg]", 180.0 / math.pi),
    "load_Nm": ("its load [N m]", 1.0),
    "speed_rad_s": ("its speed [rad/s]", 1.0),
}
TITLES = {
    "current_A": "current of joint {joint}: what the motion needs, less what was measured",
    "voltage_as_A": "current of joint {joint} from its voltage, less what was measured",
    "tip_m": "tip, all three axes",
}


def ladder_picture(steps: Sequence[tuple[str, float]], judged_on: str) -> str:
    """A waterfall: what each step takes off the gap, and what the last one leaves above the noise."""

    def draw(figure: Figure) -> None:
        axes, count = figure.subplots(), len(steps) + 1
        figure.subplots_adjust(left=0.26, right=0.95, top=0.98, bottom=0.5 / (0.9 + 0.36 * count))
        gaps = [gap for _, gap in steps]
        least, most = min(0.5, 0.8 * min(gaps)), max(2.0, 1.5 * max(gaps))
        begins, ends = [least, *gaps[1:], min(1.0, gaps[-1])], [gaps[0], *gaps[:-1], max(1.0, gaps[-1])]
        colours = [BEFORE, *([AFTER] * (len(steps) - 1)), PLANNED]
        for at, (begin, end, colour) in enumerate(zip(begins, ends, colours, strict=True)):
            axes.barh(at, end - begin, left=begin, color=colour, height=0.62)
            axes.text(max(begin, end) * 1.04, at, f"{([*gaps, gaps[-1]])[at]:.2f}", va="center", size=8)
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.axvline(1.0, color=PLANNED, lw=1.2, ls="--")
        axes.set_xlim(least, most)
        names = [name if k == 0 else f"+ {name}" for k, (name, _) in enumerate(steps)]
        axes.set_yticks(list(range(count)), [*names, "left, beside the noise"])
        axes.invert_yaxis()
        axes.set_xlabel(f"gap over noise on {judged_on} (dashed: 1, noise only); a bar is the reduction by its step")

    return svg((10.4, 0.9 + 0.36 * (len(steps) + 1)), draw)


def by_place(names: Sequence[str], stages: Sequence[tuple[str, Sequence[float]]], title: str) -> str:
    """Root mean squares over the noise, place by place, of every stage."""

    def draw(figure: Figure) -> None:
        from matplotlib.ticker import NullFormatter, StrMethodFormatter

        axes, place = figure.subplots(), np.arange(len(names))
        figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.34)
        for (label, each), colour, mark, shift in zip(stages, COLOURS, MARKS, (-0.06, 0.06), strict=False):
            axes.plot(place + shift, each, mark, color=colour, ms=5, label=label)
        axes.axhline(1.0, color=PLANNED, lw=1.0, ls="--")
        axes.set_xticks(place, list(names), rotation=35, ha="right", size=7)
        axes.set_xlim(-0.6, len(names) - 0.4)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("RMS over the noise")
        axes.legend(loc="best", fontsize=7)
        axes.set_title(title)

    return svg((10.4, 3.4), draw)


def against(sides: Sequence[Side], stages: Sequence[Stage], label: str, title: str = "") -> str:
    """What is left at every stage, (m,), against each of some things that it may follow."""
    columns = 2 if len(sides) == 4 else max(len(sides), 1)
    rows = math.ceil(len(sides) / columns)
    thinning = slice(None, None, max(1, len(stages[0][1]) // DOTS_MOST))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
        figure.subplots_adjust(left=0.07, right=0.99, top=0.92, bottom=0.14, wspace=0.05, hspace=0.3)
        reach = 1.25 * float(np.nanquantile(np.abs(np.concatenate([residual for _, residual in stages])), SHOWN))
        for axes, (at, side) in zip(panels.ravel(), sides, strict=True):
            for (name, residual), colour, mark in zip(stages, COLOURS, MARKS, strict=False):
                axes.plot(at[thinning], residual[thinning], mark, ms=2.4, color=colour, alpha=0.55, mew=0, label=name)
            axes.axhline(0.0, color=PLANNED, lw=0.8)
            axes.set(xlabel=side, ylim=(-reach, reach) if reach > 0.0 else None)
            if side.startswith("last direction"):
                axes.set_xticks((-1, 0, 1))
        for axes in panels[:, 0]:
            axes.set_ylabel(label)
        panels[0, 0].legend(loc="best", fontsize=7, markerscale=2)
        panels[0, 0].set_title(title)

    return svg((10.4, 3.2 * max(rows, 1)), draw)


def law_picture(law: DrawnLaw) -> str:
    """A named effect over its own variable: data, the textbook's law, and the law as this part has it."""
    curves = (("law with its departure", law.whole, "x", AFTER), ("law", law.law, ".", PLANNED))
    return _over(law.at, law.data, curves, law.variable, f"{law.name.effect} [{law.unit}]")


def map_picture(drawn: DrawnMap) -> str:
    """Data and table over the table's variable."""
    label, times = MAP_LABELS[drawn.map.over]
    unit, factor = ("mrad", 1e3) if drawn.map.corrects == "angle_rad" else ("N m", 1.0)
    order = np.argsort(drawn.at)
    curve = ("map", factor * drawn.table[order], "." if drawn.map.by_direction else "-", AFTER)
    return _over(
        times * drawn.at[order],
        factor * drawn.data[order],
        (curve,),
        f"joint {drawn.map.joint}: {label}",
        f"{drawn.map.corrects.split('_')[0]} [{unit}]",
    )


def _over(at: Array, data: Array, curves: Sequence[tuple[str, Array, str, str]], xlabel: str, ylabel: str) -> str:
    """Data less all other terms, and curves (label, values, mark, colour): nearly all data, and the whole of the curves."""
    thinning = slice(None, None, max(1, len(at) // DOTS_MOST))
    ends = [np.nanquantile(data, (1.0 - SHOWN, SHOWN)), *(values for _, values, _, _ in curves)]
    low, high = min(float(end.min()) for end in ends), max(float(end.max()) for end in ends)
    margin = 0.08 * max(high - low, 1e-12)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        figure.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=0.15)
        measured = "measured, less all other terms"
        axes.plot(at[thinning], data[thinning], "o", ms=2.6, color=BEFORE, alpha=0.45, mew=0, label=measured)
        for label, values, mark, colour in curves:
            axes.plot(at[thinning], values[thinning], mark, ms=2.8, lw=1.4, color=colour, alpha=0.8, label=label)
        axes.set(xlabel=xlabel, ylabel=ylabel, ylim=(low - margin, high + margin))
        axes.legend(loc="best", fontsize=7, markerscale=1.6)

    return svg((10.4, 3.5), draw)


# Of static poses.


def _compared(gap: StaticGap) -> list[Stage]:
    """The geometry alone, and with everything named where there is anything."""
    last = [(f"with {gap.stages[-1][0]}", gap.stages[-1][1])] if len(gap.stages) > 2 else []
    return [gap.stages[1], *last]


def recordings_picture(gap: StaticGap) -> str:
    """Root mean square of every recording over the floor, with the geometry alone and with everything named."""
    points = gap.points
    has_load, has_side = bool(np.nan_to_num(points.payload_kg).any()), bool(points.direction.any())
    words = []
    for setup, payload, direction in zip(points.setup, points.payload_kg, points.direction, strict=True):
        side = "".join("-0+"[int(last) + 1] for last in direction)
        words.append(", ".join([setup, *([f"{payload:g} kg"] * has_load), *([side] * has_side)]))
    labels = np.array(words if len(set(words)) <= NAMES_MOST else points.setup)
    names = list(dict.fromkeys(labels.tolist()))
    stages = [(name, [rms(residual[labels == label]) / gap.floor.tip_m for label in names]) for name, residual in _compared(gap)]
    held_out = set() if gap.split.is_by_pose else set(labels[gap.split.report].tolist())
    title = "by recording; * held out" if held_out else "by recording; some poses of each are held out"
    return by_place([f"{label}{'  *' if label in held_out else ''}" for label in names], stages, title)


def joint_picture(gap: StaticGap, joint: int) -> str:
    """What is left along one joint (1-based) against its angle, time, load and last direction: those that vary."""
    points, count, j = gap.points, len(gap.points), joint - 1
    has_time = bool(np.isfinite(points.t_s).all())
    apart = 0.2 * (np.arange(count) % 40 / 39.0 - 0.5)  # points of one direction side by side
    direction = points.direction[:, j]
    load, hangs = np.nan_to_num(points.payload_kg), "payload [kg]"
    if gap.load_Nm is not None and float(np.abs(gap.load_Nm[:, j]).max()) > NO_TORQUE_Nm:
        load, hangs = gap.load_Nm[:, j], f"gravity torque of joint {joint} [N m]"
    sides = [
        (np.degrees(points.q_rad[:, j]), f"q{joint} [deg]"),
        (points.t_s if has_time else np.arange(count, dtype=float), "time [s]" if has_time else "pose"),
        (load, hangs),
        (direction + apart * bool(np.ptp(direction)), f"last direction of joint {joint}"),
    ]
    by_joint = gap.by_joint[:, :, j]
    stages = [(name, 1e3 * along_joint(by_joint, residual)) for name, residual in _compared(gap)]
    varying = [(at, label) for at, label in sides if float(np.ptp(at)) > 0.0]
    return against(varying, stages, f"residual along joint {joint} [mrad]")


def places_picture(gap: StaticGap) -> str:
    """What is left at every pose as an arrow, from above and from the side, before and after at the same scale."""
    stages = _compared(gap)
    thinning = slice(None, None, max(1, len(gap.points) // ARROWS_MOST))
    place = gap.problem.references_m[thinning]
    longest = float(np.quantile(np.linalg.norm(stages[0][1][thinning], axis=1), 0.95))
    times = ARROW_SHARE * float(np.ptp(place, axis=0).max()) / max(longest, 1e-9)

    def draw(figure: Figure) -> None:
        rows = len(stages)  # a row each stage; from above, and from the side
        panels = figure.subplots(rows, 2, squeeze=False)
        figure.subplots_adjust(left=0.07, right=0.985, top=1 - 0.07 / rows, bottom=0.13 / rows, wspace=0.16)
        for column, (view, a, b) in enumerate((("from above", 0, 1), ("from the side", 0, 2))):
            for axes, (name, residual), colour in zip(panels[:, column], stages, COLOURS, strict=False):
                _arrows(axes, place[:, [a, b]], times * residual[thinning][:, [a, b]], colour)
                axes.set_ylabel(f"{'xyz'[b]} [m]")
                axes.set_title(f"{view}, {name}: {1e3 * rms(residual):.3f} mm", size=9)
                note = f"arrows {times:.0f} times too long"
                axes.text(0.01, 0.97, note, transform=axes.transAxes, size=7, va="top")
        for axes in panels[-1]:
            axes.set_xlabel("x [m]")

    return svg((10.4, 3.8 * len(stages)), draw)


def _arrows(axes: Axes, place: Array, arrow: Array, colour: str) -> None:
    axes.plot(*place.T, ".", ms=1.6, color=PLANNED)
    axes.quiver(*place.T, *arrow.T, angles="xy", scale_units="xy", scale=1.0, color=colour, width=0.0026)
    axes.margins(2.0 * ARROW_SHARE)
    axes.set(aspect="equal", adjustable="datalim")


# Of time series.


def _short(cell: ChannelRows) -> str:
    words = {"current_A": "current {}", "voltage_as_A": "voltage {}", "tip_m": "tip"}
    return words.get(cell.channel, cell.channel + " {}").format(cell.joint + 1)


def _stages(outcome: DynamicOutcome, cell: ChannelRows) -> list[Stage]:
    """What is left of a cell's rows, in the unit that is drawn."""
    size = unit_of(cell.channel)[1] * cell.floor
    return [("before", size * outcome.before[cell.rows]), ("after", size * outcome.after[cell.rows])]


def channels_picture(outcome: DynamicOutcome) -> str:
    """Every cell before and after, on the held-out runs."""
    picked = outcome.split.reporting
    cells = [cell for cell in outcome.rows.cells if picked[cell.rows].any()]
    stages = [
        (name, [rms(residual[cell.rows][picked[cell.rows]]) for cell in cells])
        for name, residual in (("before", outcome.before), ("after", outcome.after))
    ]
    return by_place([_short(cell) for cell in cells], stages, "by channel, held-out runs")


def time_picture(outcome: DynamicOutcome, run: int, cells: Sequence[ChannelRows]) -> str:
    """Residuals of a run in time, before and after, one row of axes a cell."""

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(cells), 1, sharex=True, squeeze=False)[:, 0]
        inch = 1.0 / figure.get_figheight()
        figure.subplots_adjust(left=0.07, right=0.99, top=1 - 0.25 * inch, bottom=0.45 * inch, hspace=0.38)
        for axes, cell in zip(panels, cells, strict=True):
            mine = outcome.rows.run[cell.rows] == run
            t_s = outcome.rows.t_s[cell.rows][mine]
            for (name, residual), colour in zip(_stages(outcome, cell), COLOURS, strict=True):
                size = 1.8 if len(t_s) > FEW_DOTS else 4.0
                axes.plot(t_s, residual[mine], ".", ms=size, color=colour, label=name, mew=0)
            axes.set_ylabel(f"[{unit_of(cell.channel)[0]}]")
            axes.set_title(TITLES[cell.channel].format(joint=cell.joint + 1), fontsize=9, fontweight="normal")
        panels[0].legend(loc="upper right", fontsize=8, markerscale=2, ncols=2)
        panels[-1].set_xlabel("time [s]")

    return svg((10.4, 1.7 * len(cells) + 0.4), draw)


def motion_picture(outcome: DynamicOutcome, cell: ChannelRows, title: str) -> str:
    """The residual of a cell against its joint's speed, angle and transmitted torque."""
    table, joint = outcome.rows, max(cell.joint, 0) + 1
    sides = (
        (table.speed_rad_s[cell.rows], f"speed of joint {joint} [rad/s]"),
        (np.degrees(table.q_rad[cell.rows]), f"q{joint} [deg]"),
        (table.load_Nm[cell.rows], f"transmitted torque of joint {joint} [N m]"),
    )
    label = f"{_short(cell)} [{unit_of(cell.channel)[0]}]"
    return against(sides, _stages(outcome, cell), label, f"{title}: {_short(cell)}, before and after")


def spectrum_picture(outcome: DynamicOutcome, cell: ChannelRows, effect: NamedEffect) -> str:
    """Amplitude over periods per motor turn: by angle, not by time; and over the phase of the order that was named."""
    turn = outcome.rows.q_rad[cell.rows] * outcome.physics.gear_ratios[cell.joint]
    orders, order = np.arange(0.5, HIGHEST_ORDER, 0.05), effect.parameters["order"][0]
    thinning = slice(None, None, max(1, len(turn) // DOTS_MOST))
    waves = np.exp(1j * orders[:, None] * turn[None, thinning])
    phase, unit = np.degrees((order * turn) % math.tau), unit_of(cell.channel)[0]

    def draw(figure: Figure) -> None:
        spectrum_axes, phase_axes = figure.subplots(1, 2, width_ratios=(3, 2))
        figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.16, wspace=0.16)
        for (name, residual), colour, style in zip(_stages(outcome, cell), COLOURS, ("-", "--"), strict=True):
            # least squares of each order alone, nearly: sine and cosine are orthogonal over many turns
            size = 2.0 * np.abs(waves @ residual[thinning]) / len(residual[thinning])
            spectrum_axes.plot(orders, size, color=colour, lw=1.2, ls=style, label=name)
            phase_axes.plot(phase[thinning], residual[thinning], ".", ms=2.0, color=colour, alpha=0.6, mew=0)
        spectrum_axes.set(xlabel="periods per motor turn", ylabel=f"amplitude [{unit}]")
        spectrum_axes.set_title(f"{effect.name}: spectrum over the motor's angle")
        spectrum_axes.legend(loc="best", fontsize=8)
        phase_axes.set(xlabel=f"{order:g} times the motor's angle [deg]", ylabel=f"[{unit}]", xlim=(0, 360))

    return svg((10.4, 3.0), draw)
