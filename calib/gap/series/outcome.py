"""What time series showed, for the workflow and its report; and the gap of rows, by channel and in SI."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import series_of
from calib.gap.finding import DrawnLaw, EffectName, GapFinding
from calib.gap.posterior.constants import SILENT_MOST
from calib.gap.residuals.rows import ChannelRows, RowTable
from calib.gap.residuals.scene import SeriesTerm
from calib.gap.series.linear import SeriesFit, residual_of
from calib.gap.series.split import Picked
from calib.gap.signals.motion import MotionGap
from calib.gap.words import unit_of
from control.model.arm import Arm
from control.model.effects import followed_joint

FAR_OFF = 20.0  # floors


def gap(residual: Array, table: RowTable, picked: Picked) -> float:
    """Root mean square over the floor; every cell counts the same, however many rows it has."""
    squares = []
    for cell in table.cells:
        values = residual[cell.rows][picked[cell.rows]]
        if len(values):
            squares.append(float(np.mean(values**2)))
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def floors_si(table: RowTable, arm: Arm) -> dict[str, float]:
    """The noise floor of each channel."""
    return _by_channel(table, arm, lambda cell: cell.floor)


def in_si(residual: Array, table: RowTable, picked: Picked, arm: Arm) -> dict[str, float]:
    """Root mean square of picked rows by channel."""

    def size(cell: ChannelRows) -> float:
        values = residual[cell.rows][picked[cell.rows]]
        return float(np.sqrt(np.mean(values**2)) * cell.floor) if len(values) else float("nan")

    return _by_channel(table, arm, size)


def in_rad(moved: Mapping[str, MotionGap], which: str) -> dict[str, float]:
    """A field of the motions that were simulated from voltages, by channel."""
    return {channel: float(getattr(motion, which)) for channel, motion in moved.items()}


def _by_channel(table: RowTable, arm: Arm, size: Callable[[ChannelRows], float]) -> dict[str, float]:
    """Root mean square over the joints of each channel, the voltage in volts."""
    squares: dict[str, list[float]] = {}
    for cell in table.cells:
        is_voltage = cell.channel == "voltage_as_A"
        factor = arm.drives[cell.joint].resistance_ohm if is_voltage else 1.0
        squares.setdefault("voltage_V" if is_voltage else cell.channel, []).append((size(cell) * factor) ** 2)
    return {channel: float(np.sqrt(np.mean(values))) for channel, values in squares.items()}


def doubts(before: Array, table: RowTable) -> Iterator[str]:
    """Hidden effects are seen in some channels; where nearly all are far off, arm and log may not belong together."""
    sizes = [float(np.sqrt(np.mean(before[cell.rows] ** 2))) for cell in table.cells if before[cell.rows].size]
    if len(sizes) >= 3 and np.mean(np.array(sizes) > FAR_OFF) >= 0.9:
        yield (
            f"nearly every channel disagrees by more than {FAR_OFF:.0f} times its noise: "
            "are the arm's file and the log of the same arm?"
        )


def left_out(resting: Picked, table: RowTable) -> Iterator[str]:
    """Said where rows are left out because a loose link is between its flanks."""
    for cell in table.cells:
        share = 1.0 - float(np.mean(resting[cell.rows])) if resting[cell.rows].size else 0.0
        if share > 0.0:
            yield (
                f"{cell}: {share:.0%} of the rows are left out: the link crosses its play or hits a flank there, and how hard it"
                " hits does not follow from the play"
            )


def grown(finding: GapFinding) -> Iterator[str]:
    """Said where the held-out runs do not bear out what the others accepted."""
    if finding.effects and finding.gap_after > finding.gap_before:
        yield (
            f"on the held-out runs the gap grows from {finding.gap_before:.2f} to {finding.gap_after:.2f}: what was named"
            " helps the other runs alone"
        )
    if finding.unexplained > SILENT_MOST and finding.unknown is None and not finding.ambiguous:
        yield (
            f"{finding.unexplained:.1f} times the noise is left on the held-out runs: errors of the nominal values, each too"
            " small for a name, explain it"
        )


ROWS_LEAST = 60  # of a cell in which a law is drawn


def drawn_laws(fit: SeriesFit, names: Collection[EffectName]) -> tuple[DrawnLaw, ...]:
    """Each of the names over its own variable, in the channel where it does most."""
    rest, by_name, scene = residual_of(fit, fit.numbers), {}, fit.point.scene
    for number, size in fit.evidence.sizes(fit.best).items():
        term, laws = fit.linear.terms[number], size * (np.arange(len(size)) < fit.linear.terms[number].laws)
        done = {k: columns @ laws for k, columns in term.response.items() if columns.shape[0] >= ROWS_LEAST}
        if term.key in names and isinstance(term.key, EffectName) and done:
            k = max(done, key=lambda k: float(np.sum(done[k] ** 2)))
            cell, whole = scene.cells[k], term.response[k] @ size
            unit, factor = unit_of(cell.channel)
            scale, (at, label) = factor * cell.floor, _variable(fit, term, term.key, k)
            data = scale * (whole + rest[cell.rows])
            by_name[term.key] = DrawnLaw(term.key, label, unit, at, data, scale * done[k], scale * whole)
    return tuple(by_name[name] for name in names if name in by_name)


def _variable(fit: SeriesFit, term: SeriesTerm, name: EffectName, k: int) -> tuple[Array, str]:
    """The law's own variable at the rows of a cell, and its label."""
    scene = fit.point.scene
    at, joint = scene.beside[k], followed_joint(name.effect, name.joint) or max(scene.cells[k].joint, 0) + 1
    j = min(joint, at.q.shape[1]) - 1
    series = series_of(name.effect)
    match series.over if series is not None else "load":
        case "motor":
            turn = term.variant * scene.rows.physics.gear_ratios[j] * at.q[:, j]
            return np.degrees(turn % (2.0 * np.pi)), f"{term.variant:g} times the motor's angle [deg]"
        case "speed":
            return at.speed[:, j], f"speed of joint {j + 1} [rad/s]"
        case "angle":
            return np.degrees(at.q[:, j]), f"q{j + 1} [deg]"
        case "current":
            return at.current_A[:, j], f"current of joint {j + 1} [A]"
        case "time":
            return at.t_s, "time in the run [s]"
        case _:
            return at.load_Nm[:, j], f"transmitted torque of joint {j + 1} [N m]"
