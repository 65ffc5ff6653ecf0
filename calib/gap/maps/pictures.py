"""Measured maps in the report: what they are good for, and each table over its own variable beside what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array
from calib.gap.maps.choose import DrawnMap, MapsFound
from calib.report.drawing import AFTER, BEFORE, svg
from calib.report.page import Section, paragraph, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LABELS = {
    "angle_rad": ("its angle [deg]", 180.0 / np.pi), "motor_turn_rad": ("turn of the motor [deg]", 180.0 / np.pi),
    "load_Nm": ("its load [N m]", 1.0), "speed_rad_s": ("its speed [rad/s]", 1.0),
}  # fmt: skip
DOTS_MOST = 4000  # more only make the page large
SHOWN = 0.99  # of the points that the axis must hold


def map_sections(found: MapsFound) -> Iterator[Section]:
    """None where no map helped; a note says that."""
    if not found.drawn:
        return
    header = (
        ("text", "on recordings that were not fitted"),
        ("before", "without maps"),
        ("after", "with maps"),
    )
    rows = []
    for one in found.checks:
        words, factor = ("tip, root mean square [mm]", 1e3)
        if one.channel != "tip_m":
            words, factor = f"torque of joint {one.joint}, root mean square [N m]", 1.0
        rows.append((("text", words), f"{factor * one.before:.3g}", f"{factor * one.after:.3g}"))
    about = "What departs from its law or has no name, as it was measured. A map corrects; it explains nothing and names nothing."
    yield Section("Measured maps", paragraph(about) + table(header, rows))
    for drawn in found.drawn:
        yield Section(f"Measured map: {drawn.map}", map_picture(drawn))


def map_picture(drawn: DrawnMap) -> str:
    """Data and table over the table's variable."""
    return svg((10.4, 3.4), lambda figure: _draw(figure, drawn))


def _draw(figure: Figure, drawn: DrawnMap) -> None:
    axes = figure.subplots()
    figure.subplots_adjust(left=0.07, right=0.99, top=0.97, bottom=0.15)
    label, times = LABELS[drawn.map.over]
    unit, factor = ("mrad", 1e3) if drawn.map.corrects == "angle_rad" else ("N m", 1.0)
    some = np.arange(0, len(drawn.at), max(1, len(drawn.at) // DOTS_MOST))
    at, data, values = times * drawn.at[some], factor * drawn.data[some], factor * drawn.table[some]
    order = np.argsort(at)
    axes.plot(at, data, "o", ms=2.2, color=BEFORE, alpha=0.35, mew=0, label="measured, less all other terms")
    is_line = not drawn.map.by_direction
    axes.plot(at[order], values[order], "-" if is_line else ".", ms=2.4, lw=1.4, color=AFTER, label="map")
    low, high = _range(data, values)
    axes.set(
        xlabel=f"joint {drawn.map.joint}: {label}",
        ylabel=f"{drawn.map.corrects.split('_')[0]} [{unit}]",
        ylim=(low, high),
    )
    axes.legend(loc="best", fontsize=7)


def _range(data: Array, values: Array) -> tuple[float, float]:
    """Nearly all data, and the whole table."""
    low, high = np.quantile(data, (1.0 - SHOWN, SHOWN))
    low, high = min(float(low), float(values.min())), max(float(high), float(values.max()))
    margin = 0.08 * max(high - low, 1e-12)
    return low - margin, high + margin
