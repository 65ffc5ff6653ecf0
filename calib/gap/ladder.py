"""The gap as a waterfall from the nominal model to the noise, one step an effect, and in the channels' own units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from calib.gap.finding import GapFinding
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg
from calib.report.page import paragraph, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNITS = {
    "tip_m": ("mm", 1e3), "current_A": ("mA", 1e3), "voltage_V": ("mV", 1e3), "q_rad": ("mrad", 1e3),
    "q_loop_rad": ("mrad", 1e3), "turn_rad": ("mrad", 1e3),
}  # fmt: skip


def steps_of(found: GapFinding) -> list[tuple[str, float]]:
    """The nominal model, then with one effect more at a time, last with maps of what sets share; the gap after each, where there
    is one.
    """
    steps = [("nominal model", found.gap_before), *((str(one.name), one.gap_after) for one in found.effects)]
    if found.maps is not None:
        steps.append(("what sets share", found.gap_after))
    return [(name, gap) for name, gap in steps if math.isfinite(gap) and gap > 0.0]


def ladder_picture(found: GapFinding) -> str:
    """What each step takes off the gap, and what the last one leaves above the noise."""
    steps = steps_of(found)
    return svg((10.4, 0.9 + 0.36 * (len(steps) + 1)), lambda figure: _draw(figure, steps, found.judged_on))


def channels_table(found: GapFinding) -> str:
    """Noise, gap before and after of every channel in its own unit."""
    rows = []
    for channel, floor in found.noise_floor.items():
        unit, factor = UNITS.get(channel, (channel.rpartition("_")[2], 1.0))
        name = channel.rpartition("_")[0] or channel
        values = (floor, found.before_si.get(channel, math.nan), found.after_si.get(channel, math.nan))
        rows.append((f"{name} [{unit}]", *(_number(factor * value) for value in values)))
    return table(("channel, root mean square", "noise", ("before", "before"), ("after", "after")), rows)


def in_units(size_si: Mapping[str, float]) -> str:
    """Sizes by channel as `0.12 mm`."""
    texts = []
    for channel, value in size_si.items():
        unit, factor = UNITS.get(channel, (channel.rpartition("_")[2], 1.0))
        texts.append(f"{_number(factor * value)} {unit}")
    return ", ".join(texts)


def _number(value: float) -> str:
    return "–" if not math.isfinite(value) else f"{value:.3g}"


def _draw(figure: Figure, steps: Sequence[tuple[str, float]], judged_on: str) -> None:
    axes = figure.subplots()
    count = len(steps) + 1
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
    axes.set_xlabel(
        f"gap over noise on {judged_on} (dashed: 1, noise only); a bar is what its step takes off"
    )


def ladder(found: GapFinding) -> str:
    """Picture and table; a sentence where there is nothing to draw."""
    if not steps_of(found):
        return paragraph("The gap could not be determined.") + channels_table(found)
    return ladder_picture(found) + channels_table(found)
