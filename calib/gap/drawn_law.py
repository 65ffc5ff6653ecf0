"""A named effect over its own variable in the report: data, the textbook's law, and the law as this part has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.report.drawing import AFTER, BEFORE, PLANNED, svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHOWN = 0.98  # of the points that the axis must hold
DOTS_MOST = 2500  # more are not seen, and the page stays small


@dataclass(frozen=True, slots=True)
class DrawnLaw:
    """What the data show of an effect at k poses or rows, its law, and the law with its departure.

    `at` (k,) with the label `variable`; data, law, whole (k,) in `unit`: mrad of the joint, mm of the tip, mA of a motor.
    """

    name: EffectName
    variable: str
    unit: str
    at: Array
    data: Array
    law: Array
    whole: Array


def law_picture(law: DrawnLaw) -> str:
    """A named effect over its own variable: data, the textbook's law, and the law as this part has it."""
    return svg((10.4, 3.6), lambda figure: _draw(figure, law))


def _draw(figure: Figure, law: DrawnLaw) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=0.14)
    some = np.arange(0, len(law.at), max(1, len(law.at) // DOTS_MOST))
    at, data, whole, textbook = (own[some] for own in (law.at, law.data, law.whole, law.law))
    axes.plot(at, data, "o", ms=2.6, color=BEFORE, alpha=0.45, mew=0, label="data, less all other terms")
    axes.plot(at, whole, "x", ms=3.0, color=AFTER, alpha=0.7, label="law with its departure")
    axes.plot(at, textbook, ".", ms=2.6, color=PLANNED, label="law")
    reach = float(np.quantile(np.abs(law.data), SHOWN)) + 0.3 * float(np.abs(law.law).max())
    middle = float(np.median(law.data)) if law.unit == "mm" else 0.0
    axes.set(
        xlabel=law.variable, ylabel=f"{law.name.effect} [{law.unit}]", ylim=(middle - reach, middle + reach)
    )
    axes.legend(loc="best", fontsize=7, markerscale=1.6)
