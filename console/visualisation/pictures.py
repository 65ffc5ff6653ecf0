"""The pictures of `armwright plot`: their names, how they are drawn, and the data that each needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from console.visualisation.arm_pictures import draw_lateness, draw_spectra, draw_supply, draw_tip
from console.visualisation.axes import (
    LIMIT,
    MEASURED,
    SET,
    columns_of,
    curve,
    head,
    joint_axes,
    legend,
    mark_runs,
    rms,
)
from console.visualisation.series import Array, Series
from console.visualisation.thinning import SHORTEST

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


# Pictures with a row a joint: tracking, following errors, currents, voltages.


def draw_tracking(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Set-point and measured angle."""
    for k, (axes, joint) in enumerate(zip(joint_axes(figure, joints), joints, strict=True)):
        mark_runs(axes, series)
        curve(
            axes,
            series,
            np.degrees(series.q_rad[:, joint - 1]),
            color=MEASURED,
            label="measured",
            linewidth=2.2,
        )
        curve(
            axes,
            series,
            np.degrees(series.q_set_rad[:, joint - 1]),
            color=SET,
            linestyle="--",
            label="set-point",
            linewidth=0.9,
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
        found = error[np.isfinite(error)]
        figures = f": rms {rms(found):.3g}, largest {np.abs(found).max():.3g} mrad" if len(found) else ""
        head(axes, f"{series.joint_name(joint)}{figures}")


def draw_currents(figure: FigureBase, series: Series, joints: Sequence[int]) -> None:
    """Motor current and its limit."""
    for axes, joint in zip(joint_axes(figure, joints), joints, strict=True):
        current, drive = series.current_A[:, joint - 1], series.drive(joint)
        mark_runs(axes, series)
        curve(axes, series, current, color=MEASURED)
        axes.set_ylabel("current [A]")
        found = current[np.isfinite(current)]
        figures = f": rms {rms(found):.3g}, peak {np.abs(found).max():.3g} A" if len(found) else ""
        _limit(axes, found, drive.current_limit_A if drive else None, "A")
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
        found = voltage[np.isfinite(voltage)]
        _limit(axes, found, most, "V")
        head(
            axes,
            f"{series.joint_name(joint)}: peak {np.abs(found).max():.3g} V"
            if len(found)
            else series.joint_name(joint),
        )


def _limit(axes: Axes, values: Array, limit: float | None, unit: str) -> None:
    """Lines at +-limit if the values come near it; else its value as text, so that the curve fills its axes."""
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
