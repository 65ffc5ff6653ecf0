"""Plots over time in characters, with axes and numbers; lines are distinguished by their signs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from console.screen.drawing.braille import Canvas
from console.screen.drawing.history import BINS, Bin, SPAN_s
from console.screen.drawing.rows import Row, row

GUTTER = 6  # columns for the numbers of the value axis
_APART = 4  # columns between the signs of two lines


@dataclass(frozen=True, slots=True)
class Plot:
    """A plot: bins of time, the sign of each line, the selected line, and the smallest axis end."""

    bins: Sequence[Bin]
    signs: Sequence[str]
    chosen: int
    least: float
    is_signed: bool = True


def plot_rows(plot: Plot, columns: int, rows: int) -> list[Row]:
    """The plot with its value axis at the left and its time axis below; empty if there is no room."""
    if columns < GUTTER + 12 or rows < 4:
        return []
    canvas = Canvas(columns - GUTTER, rows - 1)
    top = axis_end(plot)
    bottom = -top if plot.is_signed else 0.0
    _draw_lines(canvas, plot, bottom, top)
    numbers = {0: top, rows - 2: bottom}
    if rows >= 6:
        numbers[(rows - 2) // 2] = 0.5 * (top + bottom)
    drawn = [row((_number(numbers.get(n)), "muted"), *spans) for n, spans in enumerate(canvas.lines())]
    return [*drawn, row((_time_axis(columns), "muted"))]


def axis_end(plot: Plot) -> float:
    """The smallest of 1, 2, 5 and their decades that covers all values."""
    largest = max((abs(value) for values in plot.bins if values for value in values), default=0.0)
    wanted = max(largest, plot.least)
    decade = 10.0 ** math.floor(math.log10(wanted))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= wanted * (1 - 1e-9))


def _draw_lines(canvas: Canvas, plot: Plot, bottom: float, top: float) -> None:
    def y(value: float) -> int:
        return round((top - value) / (top - bottom) * (canvas.height - 1))

    canvas.line(0, y(0.0), canvas.width - 1, y(0.0), "muted", every=4)
    first = BINS - len(plot.bins)
    xs = [round((first + n) * (canvas.width - 1) / (BINS - 1)) for n in range(len(plot.bins))]
    for j in sorted(range(len(plot.signs)), key=lambda j: j == plot.chosen):  # the selected line in front
        look = "accent" if j == plot.chosen else "muted"
        dots = [(x, y(values[j])) if values else None for x, values in zip(xs, plot.bins, strict=True)]
        for dot, following in zip(dots, dots[1:] or dots, strict=False):
            if dot is not None and following is not None:
                canvas.line(*dot, *following, look)
        if len(plot.signs) > 1:
            _draw_signs(canvas, [dot for dot in dots if dot], plot.signs[j], j, len(plot.signs), look)


def _draw_signs(
    canvas: Canvas, dots: Sequence[tuple[int, int]], sign: str, j: int, count: int, look: str
) -> None:
    """Draw a line's sign every few columns, in different columns for each line, so that coincident lines show theirs."""
    by_column = {x // 2: y // 4 for x, y in dots}
    for column, at_row in by_column.items():
        if (canvas.columns - 2 - column - _APART * (count - 1 - j)) % (_APART * max(count, 3)) == 0:
            canvas.letters(column, at_row, sign, "strong" if look == "muted" else look)


def _number(value: float | None) -> str:
    return f"{value:>{GUTTER - 1}g}┤" if value is not None else f"{'│':>{GUTTER}}"


def _time_axis(columns: int) -> str:
    start, middle, end = f"-{SPAN_s:g} s", f"-{SPAN_s / 2:g} s", "now"
    room = columns - GUTTER
    centre = max((room - len(middle)) // 2 - len(start), 1)
    text = start + " " * centre + middle
    return " " * GUTTER + (
        text + end.rjust(room - len(text)) if room > len(text) + 4 else start + end.rjust(room - len(start))
    )
