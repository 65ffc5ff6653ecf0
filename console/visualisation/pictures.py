"""The pictures of `armwright plot`: their names, how they are drawn, and the data that each needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from console.visualisation.arm_pictures import draw_lateness, draw_spectra, draw_supply, draw_tip
from console.visualisation.axes import columns_of
from console.visualisation.joint_pictures import draw_currents, draw_errors, draw_tracking, draw_voltages
from console.visualisation.series import Array, Series
from console.visualisation.thinning import SHORTEST

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

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
    Picture(
        "supply", "Supply and temperature", draw_supply,
        lambda s: _is_any(s.supply_V) or _is_any(s.temperature_C), False, 2,
    ),
    Picture("spectra", "Spectra", draw_spectra, _has_spectrum, False, 1, 2.6),
    Picture("tip", "Tip", draw_tip, lambda s: s.arm is not None and _is_any(s.q_rad), False, 1, 5.6),
    Picture("lateness", "Cycle timing", draw_lateness, lambda s: _is_any(s.late_s), False, 1, 2.0),
)  # fmt: skip
