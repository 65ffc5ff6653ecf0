"""Results of an evaluation: fourteen criteria, each with figures or missing input; as text, JSON and page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array, norms
from calib.iso9283.pose_criteria import pose_repeatability
from calib.report.page import PLANNED, Cell, Section, bullets, page, svg, table
from calib.report.report import inputs_section
from calib.results import Provenance, entries, write_json
from control.files import write_whole
from control.plain_text import aligned

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing


FORMAT = "iso9283/1"


@dataclass(frozen=True, slots=True)
class Figure:
    """One value: the standard's symbol, SI unit (or %), place, and remarks.

    `is_headline`: represents its symbol in the table, such as the worst of the poses.
    """

    symbol: str
    value: float
    unit: str
    where: str
    count: int
    is_headline: bool = False
    remark: str = ""


@dataclass(frozen=True, slots=True)
class Criterion:
    """One of the fourteen: number as counted here, name, the standard's clause, figures, and what is missing."""

    number: int
    name: str
    clause: str
    figures: tuple[Figure, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def headlines(self) -> tuple[Figure, ...]:
        """The figures that represent this criterion."""
        return tuple(figure for figure in self.figures if figure.is_headline)


@dataclass(frozen=True, slots=True)
class PathTrace:
    """A commanded path (m, 3) and the attained points (n, m, 3), for a picture; m."""

    name: str
    commanded_m: Array
    attained_m: Array


@dataclass(frozen=True, slots=True)
class SettlingTrace:
    """Distances (k,) [m] from the attained pose over time_s (k,) of one approach, and the limit band."""

    name: str
    time_s: Array
    distance_m: Array
    band_m: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All fourteen criteria, notes on their evaluation, and data for the pictures.

    clouds: attained positions (n, 3) minus the commanded one, by pose.
    """

    criteria: tuple[Criterion, ...]
    notes: tuple[str, ...]
    clouds: Mapping[str, Array] = field(default_factory=dict)
    paths: tuple[PathTrace, ...] = ()
    settling: tuple[SettlingTrace, ...] = ()


CRITERIA = (
    (1, "Pose accuracy and pose repeatability", "7.2"),
    (2, "Multi-directional pose accuracy variation", "7.2"),
    (3, "Distance accuracy and distance repeatability", "7.3"),
    (4, "Position stabilization time", "7.4"),
    (5, "Position overshoot", "7.5"),
    (6, "Drift of pose characteristics", "7.6"),
    (7, "Exchangeability", "7.7"),
    (8, "Path accuracy and path repeatability", "8.2, 8.3"),
    (9, "Path accuracy on reorientation", "8.4"),
    (10, "Cornering deviations", "8.5"),
    (11, "Path velocity characteristics", "8.6"),
    (12, "Minimum posing time", "9"),
    (13, "Static compliance", "10"),
    (14, "Weaving deviations", "11"),
)


def criterion(number: int, figures: Sequence[Figure], needs: Sequence[str]) -> Criterion:
    """One criterion by number."""
    _, name, clause = CRITERIA[number - 1]
    return Criterion(number, name, clause, tuple(figures), tuple(dict.fromkeys(needs)))


def with_headlines(figures: Sequence[Figure], symbols: Sequence[str] | None = None) -> list[Figure]:
    """Make the largest figure of each symbol (of all, or of those named) the headline."""
    worst: dict[str, Figure] = {}
    for figure in figures:
        if figure.symbol not in worst or abs(figure.value) > abs(worst[figure.symbol].value):
            worst[figure.symbol] = figure
    return [replace(f, is_headline=worst[f.symbol] is f and (symbols is None or f.symbol in symbols)) for f in figures]


def write_document(path: Path, evaluation: Evaluation, arm: str, made: Provenance) -> None:
    """Write iso9283.json; SI units, radians."""
    criteria = [
        entries(row, "number", "name", "clause", "needs")
        | {
            "values": {f.symbol: entries(f, "value", "unit", "where") for f in row.headlines},
            "figures": [
                entries(f, "symbol", "value", "unit", "where", "count", *(("remark",) if f.remark else ())) for f in row.figures
            ],
        }
        for row in evaluation.criteria
    ]
    write_json(path, made.heading(FORMAT, arm=arm) | {"criteria": criteria, "notes": evaluation.notes})


SHOWN = {"m": (1e3, "mm", 3), "m/s": (1.0, "m/s", 4), "m/N": (1e6, "µm/N", 3), "rad": (1e3, "mrad", 3)}


def write_page(path: Path, evaluation: Evaluation, arm: str, made: Provenance) -> None:
    """Write iso9283.html."""
    title = "Performance criteria of ISO 9283:1998"
    write_whole(path, page(title, arm, made.line, _sections(evaluation, made)))


def _sections(evaluation: Evaluation, made: Provenance) -> Iterator[Section]:
    criteria = evaluation.criteria
    had = sum(bool(c.figures) for c in criteria)
    yield Section(f"{had} of {len(criteria)} criteria", _summary(criteria) + bullets(evaluation.notes))
    if evaluation.clouds:
        yield Section("Poses: attained positions about their barycentres", cloud_picture(evaluation.clouds))
    if evaluation.paths:
        drawn = path_picture(evaluation.paths) + deviation_picture(evaluation.paths)
        yield Section("Paths", drawn)
    if evaluation.settling:
        yield Section("Coming to rest", settling_picture(evaluation.settling))
    yield Section("Every figure", _figures(criteria))
    yield inputs_section(made.inputs)


def shown(value: float, unit: str) -> str:
    """Format a value in a readable unit."""
    scale, name, digits = SHOWN.get(unit, (1.0, unit, 3))
    return f"{scale * value:.{digits}f} {name}"


def _summary(criteria: Sequence[Criterion]) -> str:
    rows: list[Sequence[Cell]] = []
    for c in criteria:
        values = "; ".join(f"{f.symbol} = {shown(f.value, f.unit)} ({f.where})" for f in c.headlines)
        texts = (c.name, c.clause, values or "–", "; ".join(c.needs))
        rows.append((str(c.number), *(("text", cell) for cell in texts)))
    return _left(table(("", "criterion", "clause", "largest value", "still needs"), rows))


def _figures(criteria: Sequence[Criterion]) -> str:
    rows: list[Sequence[Cell]] = [
        (f"{c.number}  {f.symbol}", shown(f.value, f.unit), ("text", f.where), str(f.count), ("text", f.remark))
        for c in criteria
        for f in c.figures
    ]
    return _left(table(("criterion, symbol", "value", "where", "cycles", "remark"), rows))


def _left(content: str) -> str:
    """A table with left-aligned headings."""
    return f'<div class="inputs">{content}</div>'


def summary_text(criteria: Sequence[Criterion]) -> str:
    """The criteria as lines of plain text."""
    lines = []
    for c in criteria:
        lines.append(f"{c.number:2d}  {c.name}")
        rows = [(f.symbol, f"{f.where}; {f.count} cycles", shown(f.value, f.unit)) for f in c.headlines]
        lines += [aligned(rows, left=2, indent="      ")] if rows else []
        lines += [f"      needs {need}" for need in c.needs]
    return "\n".join(lines)


STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#CC79A7", ":"), ("#000000", "-"), ("#E69F00", "--"))
MOST_CLOUDS = 5


def cloud_picture(clouds: Mapping[str, Array]) -> str:
    """Attained positions about their barycentre at each pose, from above and from the side, with RP as a circle."""
    shown = dict(sorted(clouds.items())[:MOST_CLOUDS])
    return svg((2.3 * max(len(shown), 2), 4.6), lambda figure: _draw_clouds(figure, shown))


def deviation_picture(paths: Sequence[PathTrace]) -> str:
    """Distance of the barycentre line from the commanded path, and scatter about it, along each path."""
    return svg((10.4, 3.6), lambda figure: _draw_deviations(figure, paths))


def path_picture(paths: Sequence[PathTrace]) -> str:
    """Commanded paths and the attained ones in their own plane."""
    return svg((10.4, 4.4), lambda figure: _draw_paths(figure, paths))


def settling_picture(traces: Sequence[SettlingTrace]) -> str:
    """Distance from the attained pose over time, with the limit band."""
    return svg((10.4, 3.2), lambda figure: _draw_settling(figure.add_axes((0.06, 0.16, 0.92, 0.74)), traces))


def _draw_clouds(figure: Drawing, clouds: Mapping[str, Array]) -> None:
    axes = figure.subplots(2, len(clouds), squeeze=False)
    figure.subplots_adjust(0.06, 0.1, 0.99, 0.94, wspace=0.3, hspace=0.32)
    for column, (name, deviation) in enumerate(clouds.items()):
        about = 1e3 * (deviation - deviation.mean(axis=0))
        radius = 1e3 * pose_repeatability(deviation) if len(deviation) > 1 else 0.0
        for row, (i, j, names) in enumerate(((0, 1, "xy"), (0, 2, "xz"))):
            panel = axes[row][column]
            panel.plot(about[:, i], about[:, j], "o", ms=3, color=STYLES[0][0], alpha=0.6)
            angle = np.linspace(0.0, 2.0 * np.pi, 90)
            panel.plot(radius * np.cos(angle), radius * np.sin(angle), "--", lw=1.0, color=STYLES[1][0])
            panel.set_aspect("equal", adjustable="datalim")
            panel.set(xlabel=f"{names[0]} [mm]", ylabel=f"{names[1]} [mm]" if not column else "")
        axes[0][column].set_title(f"{name}: RP {radius:.3f} mm", loc="left", fontsize=9)


def _draw_deviations(figure: Drawing, paths: Sequence[PathTrace]) -> None:
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(0.06, 0.32, 0.98, 0.92, wspace=0.16)
    for k, trace in enumerate(paths):
        colour, style = STYLES[k % len(STYLES)]
        share = np.linspace(0.0, 100.0, len(trace.commanded_m))
        mean = trace.attained_m.mean(axis=0)
        left.plot(share, 1e3 * norms(mean - trace.commanded_m), style, color=colour, lw=1.4, label=trace.name)
        if len(trace.attained_m) > 1:
            lengths = np.linalg.norm(trace.attained_m - mean, axis=2)
            radius = lengths.mean(axis=0) + 3.0 * lengths.std(axis=0, ddof=1)
            right.plot(share, 1e3 * radius, style, color=colour, lw=1.4)
    left.set(xlabel="distance along the path [%]", ylabel="[mm]", ylim=(0.0, None))
    right.set(xlabel="distance along the path [%]", ylabel="[mm]", ylim=(0.0, None))
    left.set_title("commanded path to barycentre line (AT: largest)", loc="left")
    right.set_title("scatter about the barycentre line (RT: largest)", loc="left")
    figure.legend(loc="lower center", ncols=4, fontsize=8)


def _draw_paths(figure: Drawing, paths: Sequence[PathTrace]) -> None:
    chosen = {trace.name.split(" at ")[0]: trace for trace in reversed(paths)}  # the slowest of each
    axes = figure.subplots(1, len(chosen), squeeze=False)[0]
    figure.subplots_adjust(0.06, 0.12, 0.98, 0.92, wspace=0.2)
    for one, trace in zip(axes, reversed(chosen.values()), strict=True):
        _draw_in_plane(one, trace)
    axes[0].legend(fontsize=8)


def _draw_in_plane(axes: Axes, trace: PathTrace) -> None:
    centre = trace.commanded_m.mean(axis=0)
    plane = np.linalg.svd(trace.commanded_m - centre, full_matrices=False)[2][:2]
    if np.ptp((trace.commanded_m - centre) @ plane[1]) < 1e-6:  # a line: drawn in the plane of its largest deviation
        off = trace.attained_m.mean(axis=(0, 1)) - centre
        off = off - (off @ plane[0]) * plane[0]
        plane = np.vstack((plane[0], off / max(float(np.linalg.norm(off)), 1e-12)))
    commanded = 1e3 * (trace.commanded_m - centre) @ plane.T
    axes.plot(*commanded.T, "--", color=PLANNED, lw=1.6, label="commanded")
    for k, attained in enumerate(trace.attained_m):
        seen = 1e3 * (attained - centre) @ plane.T
        axes.plot(*seen.T, "-", color=STYLES[0][0], lw=0.9, label="attained" if k == 0 else None)
    is_line = np.ptp(commanded[:, 1]) < 1e-3
    if not is_line:
        axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="along the path [mm]" if is_line else "in the path's plane [mm]", ylabel="[mm]")
    scales = "  (scales differ)" if is_line else ""
    axes.set_title(f"{trace.name}, {len(trace.attained_m)} cycles{scales}", loc="left")


def _draw_settling(axes: Axes, traces: Sequence[SettlingTrace]) -> None:
    for k, trace in enumerate(traces):
        colour, style = STYLES[k]
        axes.plot(trace.time_s, 1e3 * trace.distance_m, style, color=colour, lw=1.2, label=trace.name)
        axes.axhline(1e3 * trace.band_m, color=colour, ls=":", lw=1.2, label=f"limit band {1e3 * trace.band_m:.3f} mm")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(bottom=1e-3)
    axes.set(xlabel="time since departure [s]", ylabel="distance [mm]")
    axes.set_title("approach to P1: distance from the attained pose", loc="left")
    axes.legend(fontsize=8, ncols=2)
