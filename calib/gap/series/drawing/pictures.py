"""Pictures of what time series leave: the gap as the model grew, residuals in time, and along what names them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array
from calib.gap.drawn_law import law_picture
from calib.gap.effects.catalogue import comes_round
from calib.gap.finding import EffectName, NamedEffect
from calib.gap.residuals.rows import ChannelRows
from calib.gap.series.outcome import DynamicOutcome
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg
from calib.report.page import Section, bullets, paragraph

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNITS = {"current_A": (1e3, "mA"), "voltage_as_A": (1e3, "mA"), "tip_m": (1e3, "mm")}
TITLES = {
    "current_A": "current of joint {joint}: what the motion needs, less what was measured",
    "voltage_as_A": "current of joint {joint} from its voltage, less what was measured",
    "tip_m": "tip, all three axes",
}
MOST_CELLS = 4  # drawn in time
HIGHEST_ORDER = 24.0  # periods per motor turn
FEWEST_ROWS = 60
DOT, FEW_DOT, FEW_DOTS = 1.8, 4.0, 200  # sizes of dots, and up to how many they are large
POINTS = 1500  # of a cloud: more are not seen, and the page stays small


def dynamic_sections(outcome: DynamicOutcome) -> Iterator[Section]:
    """The gap by channel, which run and channel show most, and what is left along what was named."""
    yield Section("Time series: the gap by channel", _about(outcome) + gap_picture(outcome))
    cells = _worst_cells(outcome)
    if cells:
        run = _worst_run(outcome, cells[0])
        title = f"Time series: residuals in time, run {outcome.run_names[run]}"
        text = paragraph("The run with the largest residual; rows beside reversals and gaps are not used.")
        yield Section(title, text + time_picture(outcome, run, cells))
    for law in outcome.laws:
        yield Section(f"Time series: {law.name}: data, law and departure", law_picture(law))
    for effect in outcome.finding.effects:
        drawn = along_picture(outcome, effect)
        if drawn:
            yield Section(f"Time series: along {effect.name}", drawn)
    if not outcome.finding.effects and outcome.finding.unknown is not None and cells:
        yield Section(f"Time series: residual in {cells[0]}", _along(outcome, cells[0], None, "residual"))


def _about(outcome: DynamicOutcome) -> str:
    kept = ", ".join(name for name in outcome.run_names if name in outcome.split.report_runs)
    text = (
        f"The noise floor comes from {outcome.rows.floor_source}; runs {kept} were held out for the report."
    )
    return paragraph(text) + (bullets(outcome.warnings) if outcome.warnings else "")


def gap_picture(outcome: DynamicOutcome) -> str:
    """Every cell before and after, on the held-out runs; a sentence where there is none."""
    if not math.isfinite(outcome.finding.gap_before):
        return paragraph("No row of the held-out runs counts: there is no gap to draw.")
    return svg((10.4, 3.2), lambda figure: _draw_cells(figure, outcome))


def time_picture(outcome: DynamicOutcome, run: int, cells: Sequence[ChannelRows]) -> str:
    """Residuals of a run in time, before and after, one row of axes a cell."""
    return svg((10.4, 1.7 * len(cells) + 0.4), lambda figure: _draw_time(figure, outcome, run, cells))


def along_picture(outcome: DynamicOutcome, effect: NamedEffect) -> str:
    """The residual of the cell that an effect shows in, along what the effect follows; empty where no cell shows it."""
    cell = _cell_of(outcome, effect.name)
    if cell is None:
        return ""
    return _along(outcome, cell, effect, str(effect.name))


def _along(outcome: DynamicOutcome, cell: ChannelRows, effect: NamedEffect | None, title: str) -> str:
    if effect is not None and comes_round(effect.name.effect):
        return svg((10.4, 3.0), lambda figure: _draw_spectrum(figure, outcome, cell, effect))
    return svg((10.4, 3.0), lambda figure: _draw_clouds(figure, outcome, cell, title))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _times(axes: Axes) -> None:
    """A logarithmic axis whose ticks are plain numbers."""
    from matplotlib.ticker import NullFormatter, StrMethodFormatter

    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _draw_cells(figure: Figure, outcome: DynamicOutcome) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.07, right=0.99, top=0.89, bottom=0.24)
    picked = outcome.split.reporting
    cells = [cell for cell in outcome.rows.cells if picked[cell.rows].any()]
    place = np.arange(len(cells))
    for residual, colour, mark, shift, label in (
        (outcome.before, BEFORE, "s", -0.06, "before"),
        (outcome.after, AFTER, "o", 0.06, "after"),
    ):
        each = [_rms(residual[cell.rows][picked[cell.rows]]) for cell in cells]
        axes.plot(place + shift, each, mark, color=colour, ms=6, label=label)
    axes.set_xticks(place, [_short(cell) for cell in cells], rotation=20, ha="right", size=8)
    axes.set_xlim(-0.6, len(cells) - 0.4)
    _times(axes)
    axes.axhline(1.0, color=PLANNED, lw=1.0, ls="--")
    axes.legend(loc="best", fontsize=8)
    axes.set(ylabel="RMS over the noise")
    axes.set_title("by channel, held-out runs")


def _short(cell: ChannelRows) -> str:
    words = {"current_A": "current {}", "voltage_as_A": "voltage {}", "tip_m": "tip"}
    return words.get(cell.channel, cell.channel + " {}").format(cell.joint + 1)


def _worst_cells(outcome: DynamicOutcome) -> list[ChannelRows]:
    """The cells with most before, those that agree with the model at the end."""
    found = [cell for cell in outcome.rows.cells if outcome.before[cell.rows].size]
    return sorted(found, key=lambda cell: -_rms(outcome.before[cell.rows]))[:MOST_CELLS]


def _worst_run(outcome: DynamicOutcome, cell: ChannelRows) -> int:
    run, residual = outcome.rows.run[cell.rows], outcome.before[cell.rows]
    return max((int(k) for k in np.unique(run)), key=lambda k: _rms(residual[run == k]))


def _draw_time(figure: Figure, outcome: DynamicOutcome, run: int, cells: Sequence[ChannelRows]) -> None:
    all_axes = np.atleast_1d(figure.subplots(len(cells), 1, sharex=True))
    inch = 1.0 / figure.get_figheight()
    figure.subplots_adjust(left=0.07, right=0.99, top=1 - 0.25 * inch, bottom=0.45 * inch, hspace=0.38)
    for axes, cell in zip(all_axes, cells, strict=True):
        mine = outcome.rows.run[cell.rows] == run
        t = outcome.rows.t_s[cell.rows][mine]
        factor, unit = UNITS[cell.channel]
        for residual, colour, label, mark in (
            (outcome.before, BEFORE, "before", "."),
            (outcome.after, AFTER, "after", "."),
        ):
            values = factor * cell.floor * residual[cell.rows][mine]
            size = DOT if len(t) > FEW_DOTS else FEW_DOT
            axes.plot(t, values, mark, ms=size, color=colour, label=label, mew=0)
        axes.set_ylabel(f"[{unit}]")
        axes.set_title(TITLES[cell.channel].format(joint=cell.joint + 1), fontsize=9, fontweight="normal")
    all_axes[0].legend(loc="upper right", fontsize=8, markerscale=2, ncols=2)
    all_axes[-1].set_xlabel("time [s]")


def _draw_clouds(figure: Figure, outcome: DynamicOutcome, cell: ChannelRows, title: str) -> None:
    """The residual against speed, angle and transmitted torque."""
    table, factor_unit = outcome.rows, UNITS[cell.channel]
    joint = max(cell.joint, 0) + 1
    sides = (
        (table.speed_rad_s, f"speed of joint {joint} [rad/s]"),
        (np.degrees(table.q_rad), f"q{joint} [deg]"),
        (table.load_Nm, f"transmitted torque of joint {joint} [N m]"),
    )
    all_axes = figure.subplots(1, 3, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.16, wspace=0.06)
    count = outcome.before[cell.rows].size
    keep = np.arange(0, count, max(1, count // POINTS))
    for axes, (along, label) in zip(all_axes, sides, strict=True):
        at = along[cell.rows][keep]
        for residual, colour, name in ((outcome.before, BEFORE, "before"), (outcome.after, AFTER, "after")):
            values = factor_unit[0] * cell.floor * residual[cell.rows][keep]
            axes.plot(at, values, ".", ms=2.0, color=colour, alpha=0.6, mew=0, label=name)
        axes.set_xlabel(label)
    all_axes[0].set_ylabel(f"{_short(cell)} [{factor_unit[1]}]")
    all_axes[0].legend(loc="best", fontsize=8, markerscale=4)
    all_axes[0].set_title(f"{title}: {_short(cell)}, before and after")


def _draw_spectrum(figure: Figure, outcome: DynamicOutcome, cell: ChannelRows, effect: NamedEffect) -> None:
    """Amplitude over periods per motor turn: by angle, not by time."""
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    figure.subplots_adjust(left=0.07, right=0.99, top=0.88, bottom=0.16, wspace=0.16)
    turn = outcome.rows.q_rad[cell.rows] * outcome.gear_ratios[cell.joint]
    orders = np.arange(0.5, HIGHEST_ORDER, 0.05)
    factor, unit = UNITS[cell.channel]
    for residual, colour, name in ((outcome.before, BEFORE, "before"), (outcome.after, AFTER, "after")):
        size = factor * cell.floor * _amplitudes(residual[cell.rows], turn, orders)
        left.plot(orders, size, color=colour, lw=1.2, ls="-" if colour == BEFORE else "--", label=name)
    order = effect.parameters["order"][0]
    left.set(xlabel="periods per motor turn", ylabel=f"amplitude [{unit}]")
    left.set_title(f"{effect.name}: spectrum over the motor's angle")
    left.legend(loc="best", fontsize=8)
    keep = np.arange(0, len(turn), max(1, len(turn) // POINTS))
    phase = np.degrees((order * turn) % (2.0 * np.pi))[keep]
    for residual, colour in ((outcome.before, BEFORE), (outcome.after, AFTER)):
        right.plot(
            phase,
            factor * cell.floor * residual[cell.rows][keep],
            ".",
            ms=2.0,
            color=colour,
            alpha=0.6,
            mew=0,
        )
    right.set(xlabel=f"{order:g} times the motor's angle [deg]", ylabel=f"[{unit}]", xlim=(0, 360))


def _amplitudes(residual: Array, turn: Array, orders: Array) -> Array:
    """Least squares of each order alone, nearly: sine and cosine are orthogonal over many turns."""
    keep = np.arange(0, len(turn), max(1, len(turn) // (2 * POINTS)))
    waves = np.exp(1j * orders[:, None] * turn[None, keep])
    return np.asarray(2.0 * np.abs(waves @ residual[keep]) / len(keep))


def _cell_of(outcome: DynamicOutcome, name: EffectName) -> ChannelRows | None:
    """Where an effect took most: its own joint's cells first."""
    taken = [
        (float(np.sum(outcome.before[cell.rows] ** 2) - np.sum(outcome.after[cell.rows] ** 2)), cell)
        for cell in outcome.rows.cells
        if outcome.before[cell.rows].size >= FEWEST_ROWS
    ]
    own = [one for one in taken if name.joint is None or one[1].joint in (name.joint - 1, -1)]
    most, found = max(own or taken, key=lambda one: one[0], default=(0.0, None))
    return found if most > 0.0 else None
