"""Pictures with a row a joint: tracking, following errors, currents, voltages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from console.visualisation.axes import (
    LIMIT,
    MEASURED,
    SET,
    curve,
    head,
    joint_axes,
    legend,
    mark_runs,
    rms,
)
from console.visualisation.series import Array, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase


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
