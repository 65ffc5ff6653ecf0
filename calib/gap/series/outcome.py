"""What time series showed, for the workflow and its report; and the gap of rows, by channel and in SI."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.drawn_law import DrawnLaw
from calib.gap.finding import GapFinding
from calib.gap.posterior.constants import SILENT_MOST
from calib.gap.residuals.rows import ChannelRows, RowTable
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.motion import MotionGap
from calib.gap.signals.physics import Physics
from calib.gap.signals.terms import Law
from control.model.arm import Arm

FAR_OFF = 20.0  # floors


@dataclass(frozen=True, slots=True)
class DynamicOutcome:
    """The finding, and what a report draws: residual rows over the floor before and after, what each row is,
    which rows report, and sentences about the log; `model`: all that is known and named, as `physics` takes it.
    """

    finding: GapFinding
    warnings: tuple[str, ...]
    rows: RowTable
    before: Array
    after: Array
    split: RowSplit
    run_names: tuple[str, ...]
    physics: Physics
    model: tuple[Law, ...]
    laws: tuple[DrawnLaw, ...] = ()

    @property
    def gear_ratios(self) -> tuple[float, ...]:
        """Motor turns a joint turn."""
        return self.physics.gear_ratios


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
    return {channel: float(getattr(one, which)) for channel, one in moved.items()}


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
    sizes = [
        float(np.sqrt(np.mean(before[cell.rows] ** 2))) for cell in table.cells if before[cell.rows].size
    ]
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
