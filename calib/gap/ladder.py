"""The gap as the model grew: one step an effect, in multiples of the noise and in the channels' own units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from calib.gap.finding import GapFinding
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg
from calib.report.page import paragraph, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNITS = {
    "tip_m": ("mm", 1e3), "current_A": ("mA", 1e3), "voltage_V": ("mV", 1e3), "q_rad": ("mrad", 1e3),
    "q_loop_rad": ("mrad", 1e3),
}  # fmt: skip


def steps_of(found: GapFinding) -> list[tuple[str, float]]:
    """The model as it is, then with one effect more at a time; the gap after each, where there is one."""
    steps = [("as it is", found.gap_before), *((str(one.name), one.gap_after) for one in found.effects)]
    return [(name, gap) for name, gap in steps if math.isfinite(gap) and gap > 0.0]


def ladder_picture(found: GapFinding) -> str:
    """Bars of the gap over the noise, the noise itself as a line."""
    steps = steps_of(found)
    return svg((10.4, 0.9 + 0.36 * len(steps)), lambda figure: _draw(figure, steps, found.judged_on))


def channels_table(found: GapFinding) -> str:
    """Noise, gap before and after of every channel in its own unit."""
    rows = []
    for channel, floor in found.noise_floor.items():
        unit, factor = UNITS.get(channel, (channel.rpartition("_")[2], 1.0))
        name = channel.rpartition("_")[0] or channel
        values = (floor, found.before_si.get(channel, math.nan), found.after_si.get(channel, math.nan))
        rows.append((f"{name} [{unit}]", *(_number(factor * value) for value in values)))
    return table(("channel, root mean square", "noise", ("before", "before"), ("after", "after")), rows)


def _number(value: float) -> str:
    return "–" if not math.isfinite(value) else f"{value:.3g}"


def _draw(figure: Figure, steps: Sequence[tuple[str, float]], judged_on: str) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.26, right=0.95, top=0.98, bottom=0.5 / (0.9 + 0.36 * len(steps)))
    place = list(range(len(steps)))
    colours = [BEFORE, *([AFTER] * (len(steps) - 1))]
    axes.barh(place, [gap for _, gap in steps], color=colours, height=0.62, log=True)
    for at, (_, gap) in zip(place, steps, strict=True):
        axes.text(gap * 1.04, at, f"{gap:.2f}", va="center", size=8)
    axes.axvline(1.0, color=PLANNED, lw=1.2, ls="--")
    most = max(gap for _, gap in steps)
    axes.set_xlim(min(0.5, 0.8 * min(gap for _, gap in steps)), max(2.0, 1.5 * most))
    axes.set_yticks(place, [name if k == 0 else f"+ {name}" for k, (name, _) in enumerate(steps)])
    axes.invert_yaxis()
    axes.set_xlabel(f"gap over noise on {judged_on} (dashed: 1, noise only)")


def ladder(found: GapFinding) -> str:
    """Picture and table; a sentence where there is nothing to draw."""
    if not steps_of(found):
        return paragraph("The gap could not be determined.") + channels_table(found)
    return ladder_picture(found) + channels_table(found)
