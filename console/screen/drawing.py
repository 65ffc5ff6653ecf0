"""Drawing on the screen: rows of styled text, panels, plots over time and pictures of the arm in Braille
dots.
"""

from __future__ import annotations

import math
import sys
import textwrap
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any, ClassVar

from rich.segment import Segment
from rich.style import Style
from rich.text import Text
from textual import events
from textual.color import Color
from textual.filter import LineFilter
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.theme import Theme
from textual.widget import Widget
from textual.widgets import RichLog

from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm
from control.motion.joint_limits import reaches_m

ACCENT = "#3fc1b0"
THEME = Theme(
    name="armwright",
    primary=ACCENT,
    accent=ACCENT,
    warning="#e8b04b",
    error="#e5534b",
    success=ACCENT,
    foreground="#d5dbe3",
    background="#0d1218",
    surface="#141b23",
    panel="#1d2731",
    variables={"muted": "#8593a3", "frame": "#344250"},
)


# Rows of styled text, of which panels, views and plots are made; tests can read them.
#
# A style is a name; style.tcss gives its colour. Style is never the only indication of anything.


Span = tuple[str, str]  # text, style
Row = tuple[Span, ...]
LOOKS = ("plain", "strong", "muted", "accent", "chosen", "badge", "warning", "warning-badge", "error", "error-badge")


def row(*parts: Span | str) -> Row:
    """A row of spans; a bare string has the plain style."""
    return tuple((part, "plain") if isinstance(part, str) else part for part in parts)


def text_of(rows: Iterable[Row]) -> str:
    """The rows without their styles."""
    return "\n".join("".join(text for text, _ in spans) for spans in rows)


def width_of(spans: Row) -> int:
    """Width of a row in columns."""
    return sum(len(text) for text, _ in spans)


def wrapped(text: str, look: str, width: int, sign: str = "") -> list[Row]:
    """Wrap a text to rows, with `sign` before the first and the same indent before the others."""
    lines = textwrap.wrap(text, max(width - len(sign), 8), break_on_hyphens=False) or [""]
    return [row((sign if n == 0 else " " * len(sign), look), (line, look)) for n, line in enumerate(lines)]


# Lines, marks and letters in characters: each braille character is two dots wide and four high.
#
# A character has the style of the last stroke through it. Letters are in front of all strokes.


_BITS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
_EMPTY = 0x2800
Dot = tuple[int, int]


class Canvas:
    """A picture of `columns` by `rows` characters. Points are in dots, x to the right, y downwards; others are ignored."""

    def __init__(self, columns: int, rows: int) -> None:
        self.columns, self.rows = columns, rows
        self.width, self.height = 2 * columns, 4 * rows
        self._cells = [[0] * columns for _ in range(rows)]
        self._looks = [["plain"] * columns for _ in range(rows)]
        self._letters: dict[tuple[int, int], tuple[str, str]] = {}

    def dot(self, x: int, y: int, look: str = "plain") -> None:
        """Set one dot."""
        if 0 <= x < self.width and 0 <= y < self.height:
            self._cells[y // 4][x // 2] |= _BITS[y % 4][x % 2]
            self._looks[y // 4][x // 2] = look

    def line(self, start: Dot, end: Dot, look: str = "plain", every: int = 1) -> None:
        """Draw a straight line, dotted if `every` is more than 1."""
        (x0, y0), (x1, y1) = start, end
        steps = max(abs(x1 - x0), abs(y1 - y0), 1)
        if steps > 4 * (self.width + self.height):
            return
        for step in range(0, steps + 1, every):
            self.dot(round(x0 + (x1 - x0) * step / steps), round(y0 + (y1 - y0) * step / steps), look)

    def stroke(self, start: Dot, end: Dot, look: str = "plain", half: int = 1) -> None:
        """Draw a line of thickness 2 `half` + 1 dots."""
        (x0, y0), (x1, y1) = start, end
        is_steep = abs(y1 - y0) > abs(x1 - x0)
        for offset in range(-half, half + 1):
            dx, dy = (offset, 0) if is_steep else (0, offset)
            self.line((x0 + dx, y0 + dy), (x1 + dx, y1 + dy), look)

    def letters(self, column: int, row: int, text: str, look: str = "plain") -> None:
        """Draw letters from a character on; `column`, `row` count characters."""
        for n, letter in enumerate(text):
            if 0 <= column + n < self.columns and 0 <= row < self.rows:
                self._letters[row, column + n] = (letter, look)

    def mark(self, x: int, y: int, sign: str, look: str = "plain") -> None:
        """Draw a sign on the character that contains a dot."""
        self.letters(x // 2, y // 4, sign, look)

    def lines(self) -> list[Row]:
        """The rows of the picture."""
        return [self._row(number) for number in range(self.rows)]

    def _row(self, number: int) -> Row:
        cells = [self._cell(number, column) for column in range(self.columns)]
        runs = groupby(cells, key=lambda cell: cell[1])
        return tuple(("".join(sign for sign, _ in run), look) for look, run in runs)

    def _cell(self, row: int, column: int) -> tuple[str, str]:
        if (letter := self._letters.get((row, column))) is not None:
            return letter
        cell = self._cells[row][column]
        return (chr(_EMPTY + cell), self._looks[row][column]) if cell else (" ", "plain")


_PLAIN_TERMS = ("linux", "ansi", "vt100", "vt102", "vt220", "dumb")  # no braille in their fonts
_BY_DOTS = " .:-+*oO#"  # a braille character by its number of dots
_SIGNS = "−·●■◆▸↻→←°±│┃─━╺╸▁▔▕▏┤├└┼╭╮╰╯┌┐┘"
_THEIR_ASCII = "-.o#*>~>< +||----_-||+++++++++++"
_TABLE = str.maketrans(_SIGNS, _THEIR_ASCII) | {_EMPTY + cell: _BY_DOTS[cell.bit_count()] for cell in range(256)}


def ascii_of(text: str) -> str:
    """The text with an ASCII substitute for each other character."""
    return text.translate(_TABLE).encode("ascii", "replace").decode("ascii")


def is_plain(environment: Mapping[str, str]) -> bool:
    """Whether the terminal shows only ASCII, by its encoding or its type."""
    encoding = getattr(sys.__stderr__, "encoding", None) or "ascii"  # Textual draws on stderr
    is_utf = encoding.lower().replace("-", "").startswith("utf")
    return not is_utf or environment.get("TERM", "") in _PLAIN_TERMS


class AsciiFilter(LineFilter):
    """Converts every drawn line to ASCII."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Convert the segments, keeping their lengths."""
        return [Segment(ascii_of(text), style, control) for text, style, control in segments]


BIN_s = 0.25
BINS = 120
SPAN_s = BIN_s * BINS
Message = dict[str, Any]
Bin = list[float] | None  # None: no data


class BinnedSeries:
    """Values over time, one list per bin, the latest last."""

    def __init__(self) -> None:
        self.bins: deque[Bin] = deque(maxlen=BINS)

    def begin(self, bins_later: int) -> None:
        """Start a new bin, `bins_later` after the last."""
        self.bins.extend([None] * min(bins_later, BINS))

    def add(self, values: Sequence[float]) -> None:
        """Add values to the latest bin."""
        last = self.bins[-1]
        known = [value if math.isfinite(value) else 0.0 for value in values]
        self.bins[-1] = known if last is None else [max(pair, key=abs) for pair in zip(known, last, strict=True)]

    def newest(self) -> list[float]:
        """The latest bin that is not empty."""
        return next((values for values in reversed(self.bins) if values is not None), [])


class History:
    """Tracking error and current of each joint, speed of the tip, lateness of the loop."""

    def __init__(self) -> None:
        self.error_mrad, self.current_A = BinnedSeries(), BinnedSeries()
        self.tip_mm_s, self.late_us = BinnedSeries(), BinnedSeries()
        self._bin: int | None = None
        self._tip: tuple[float, Sequence[float]] | None = None

    def add(self, status: Message) -> None:
        """Add a status; if its clock went back, it is from another runtime."""
        number = int(status["t_s"] / BIN_s)
        later = BINS if self._bin is None or number < self._bin else number - self._bin
        self._bin = number
        rows = (
            (self.error_mrad, [1e3 * error for error in status["following_error_rad"]]),
            (self.current_A, status["current_A"]),
            (self.tip_mm_s, [1e3 * self._tip_speed_m_s(status)]),
            (self.late_us, [1e6 * status["late_p99_s"]]),
        )
        for series, values in rows:
            series.begin(later)
            series.add(values)

    def _tip_speed_m_s(self, status: Message) -> float:
        tip, now_s = status["tip_set_m"], status["t_s"]
        last, self._tip = self._tip, (now_s, tip) if tip is not None else None
        if tip is None or last is None or now_s <= last[0]:
            return 0.0
        return math.dist(tip, last[1]) / float(now_s - last[0])


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

    canvas.line((0, y(0.0)), (canvas.width - 1, y(0.0)), "muted", every=4)
    first = BINS - len(plot.bins)
    xs = [round((first + n) * (canvas.width - 1) / (BINS - 1)) for n in range(len(plot.bins))]
    for j in sorted(range(len(plot.signs)), key=lambda j: j == plot.chosen):  # the selected line in front
        look = "accent" if j == plot.chosen else "muted"
        dots = [(x, y(values[j])) if values else None for x, values in zip(xs, plot.bins, strict=True)]
        for dot, following in zip(dots, dots[1:] or dots, strict=False):
            if dot is not None and following is not None:
                canvas.line(dot, following, look)
        if len(plot.signs) > 1:
            _draw_signs(canvas, plot, j, [dot for dot in dots if dot])


def _draw_signs(canvas: Canvas, plot: Plot, j: int, dots: Sequence[Dot]) -> None:
    """Draw a line's sign every few columns, in different columns for each line, so that coincident lines show theirs."""
    count, look = len(plot.signs), "accent" if j == plot.chosen else "strong"
    by_column = {x // 2: y // 4 for x, y in dots}
    for column, at_row in by_column.items():
        if (canvas.columns - 2 - column - _APART * (count - 1 - j)) % (_APART * max(count, 3)) == 0:
            canvas.letters(column, at_row, plot.signs[j], look)


def _number(value: float | None) -> str:
    return f"{value:>{GUTTER - 1}g}┤" if value is not None else f"{'│':>{GUTTER}}"


def _time_axis(columns: int) -> str:
    start, middle, end = f"-{SPAN_s:g} s", f"-{SPAN_s / 2:g} s", "now"
    room = columns - GUTTER
    centre = max((room - len(middle)) // 2 - len(start), 1)
    text = start + " " * centre + middle
    return " " * GUTTER + (text + end.rjust(room - len(text)) if room > len(text) + 4 else start + end.rjust(room - len(start)))


# Draws the arm in characters, from the side and from above: links, numbered joints, the base frame's axes,
# the board.


Point = tuple[float, float, float]
GRID = 4  # of the reach: step of a picture's edges
SIDE, TOP = (0, 2), (0, 1)  # the axes to the right and up
TIP = "◆"
NOT_HOMED = "pose not known"  # it fits into the smallest picture
_MARGIN_dots = 4  # for marks and letters at the edges
_TICKS_m = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
_TALL_dots = 64  # from this scale on, links are five dots thick instead of three
_NUMBER_dots = 14  # smallest distance of numbered ticks


@dataclass(frozen=True, slots=True)
class DrawnScene:
    """What is drawn, in the base frame [m]: the arm's corners from base to tip, its joints and their labels, the board's edge."""

    arm: Sequence[Point]
    joints: Sequence[tuple[Point, str, str]]  # position, sign, style
    board: Sequence[Point]


class Skeleton:
    """Corners of an arm in a pose, for drawing."""

    def __init__(self, arm: Arm) -> None:
        self._kinematics = ForwardKinematics(arm)
        # The frame whose z axis a joint turns about: the previous link's, or its own (Craig's convention).
        own = 1 if arm.dh_convention == "modified" else 0
        self._frames = [number + own for number, turns in enumerate(arm.joints) if turns]
        self.reach_m = reaches_m(arm)[0]
        self.board = _outline(arm)

    def scene(self, q_rad: Sequence[float], selected: int | None, is_stale: Sequence[bool]) -> DrawnScene:
        """The arm at joint angles; the selected joint (0-based) is highlighted, a stale one has a question mark."""
        frames = self._kinematics.link_transforms([q_rad])[0]
        corners: list[Point] = [(float(f[0, 3]), float(f[1, 3]), float(f[2, 3])) for f in frames]
        joints = [
            (corners[frame], "?" if is_stale[j] else str(j + 1), "chosen" if j == selected else "badge")
            for j, frame in enumerate(self._frames)
        ]
        return DrawnScene([*corners, self._kinematics.tip(*q_rad)], joints, self.board)


def view(scene: DrawnScene, axes: tuple[int, int], columns: int, rows: int, reach_m: float) -> list[Row]:
    """From the side (SIDE: x to the right, z up, the ground a line) or from above (TOP: x to the right, y up)."""
    canvas = Canvas(columns, rows)
    place, dots_m = _placed(canvas, scene, axes, reach_m)
    _draw_axes(canvas, place, dots_m, axes)
    _draw_arm(canvas, scene, place)
    if not scene.arm:
        canvas.letters(max((columns - len(NOT_HOMED)) // 2, 0), rows // 2, NOT_HOMED, "warning")
    return canvas.lines()


def _placed(canvas: Canvas, scene: DrawnScene, axes: tuple[int, int], reach_m: float) -> tuple[Callable[[Point], Dot], float]:
    """Map metres to dots, and dots per metre, with equal scales, so that the scene fills the picture.

    The edges are at whole quarters of the reach, so that small motions do not shift the picture.
    """
    points = [(0.0, 0.0, 0.0), *scene.arm, *scene.board]
    grid_m = reach_m / GRID
    spans = []
    for axis in axes:
        values = [point[axis] for point in points]
        spans.append((grid_m * math.floor(min(values) / grid_m), grid_m * math.ceil(max(values) / grid_m)))
    (left_m, right_m), (low_m, high_m) = spans
    wide, tall = canvas.width - 1 - 2 * _MARGIN_dots, canvas.height - 1 - 2 * _MARGIN_dots
    scale = max(min(wide / max(right_m - left_m, grid_m), tall / max(high_m - low_m, grid_m)), 1.0)
    edge = (canvas.width - 1 - scale * (right_m - left_m)) / 2.0
    free = (canvas.height - 1 - scale * (high_m - low_m)) / 2.0
    bottom = canvas.height - 1 - (min(free, 2 * _MARGIN_dots) if axes == SIDE else free)
    across, up = axes

    def place(point: Point) -> Dot:
        return round(edge + scale * (point[across] - left_m)), round(bottom - scale * (point[up] - low_m))

    return place, scale


def _draw_axes(canvas: Canvas, place: Callable[[Point], Dot], dots_m: float, axes: tuple[int, int]) -> None:
    """The base frame's axes across the picture, with ticks in metres; the side view's x axis is the ground."""
    x0, y0 = place((0.0, 0.0, 0.0))
    is_side = axes == SIDE
    canvas.line((0, y0), (canvas.width - 1, y0), "muted", every=1 if is_side else 3)
    canvas.line((x0, 0), (x0, canvas.height - 1 if not is_side else y0), "muted", every=3)
    number_row = y0 // 4 + 1 if is_side else canvas.rows - 1
    step_m = next((tick for tick in _TICKS_m if tick * dots_m >= _NUMBER_dots), _TICKS_m[-1])
    for n in range(1, int(max(canvas.width, canvas.height) / (step_m * dots_m)) + 1):
        for sign in (-1, 1):
            at = round(sign * n * step_m * dots_m)
            number = f"{sign * n * step_m:g}"
            for dy in (1, 2):
                canvas.dot(x0 + at, y0 + dy, "muted")
            first = (x0 + at) // 2 - len(number) // 2
            if 0 <= first < canvas.columns - 1 - len(number):
                canvas.letters(first, number_row, number, "muted")
    canvas.letters(canvas.columns - 1, y0 // 4, "x", "strong")
    canvas.letters(x0 // 2, 0, "z" if is_side else "y", "strong")


def _draw_arm(canvas: Canvas, scene: DrawnScene, place: Callable[[Point], Dot]) -> None:
    for start, end in pairwise([place(corner) for corner in scene.board]):
        canvas.line(start, end, "strong")
    for start, end in pairwise([place(corner) for corner in scene.arm]):
        canvas.stroke(start, end, "accent", half=2 if canvas.height >= _TALL_dots else 1)
    for point, sign, look in reversed(scene.joints):
        canvas.mark(*place(point), sign, look)
    if scene.arm:
        canvas.mark(*place(scene.arm[-1]), TIP, "strong")


def _outline(arm: Arm) -> list[Point]:
    """The board's edge around its cavities, level; empty if unknown."""
    if arm.table is None or not arm.table.known_pose or arm.table.origin_m is None:
        return []
    cavities = tables.board_cavities(arm.table)
    if not cavities:
        return []
    xs, ys = [c[0] for c in cavities.values()], [c[1] for c in cavities.values()]
    edge = ((min(xs), min(ys)), (max(xs), min(ys)), (max(xs), max(ys)), (min(xs), max(ys)), (min(xs), min(ys)))
    return [tables.to_base(arm.table, "normal", (x, y, 0.0)) for x, y in edge]


class Panel(Widget):
    """Rows with a title in the border."""

    COMPONENT_CLASSES: ClassVar[set[str]] = {f"look--{look}" for look in LOOKS}
    can_focus = False

    def __init__(self, id: str, title: str = "") -> None:  # noqa: A002 - as Textual calls it
        super().__init__(id=id)
        self.border_title = title
        self._shown: Sequence[Row] = ()
        # Textual works them out anew for each line, from all the widgets around this one.
        self._styles: dict[str, Style] = {}

    @property
    def text(self) -> str:
        """The contents, without styles."""
        return text_of(self._shown)

    def show(self, rows: Sequence[Row]) -> None:
        """Show these rows."""
        before, self._shown = self._shown, rows
        height = self.styles.height
        if len(before) != len(rows) and height is not None and height.is_auto:
            self.refresh(layout=True)
            return
        for y in range(max(len(before), len(rows))):
            if before[y : y + 1] != rows[y : y + 1]:
                self.refresh(Region(0, y, self.size.width, 1))

    def get_content_height(self, container: Size, viewport: Size, width: int) -> int:
        """As many lines as there are rows."""
        return len(self._shown)

    def render_line(self, y: int) -> Strip:
        """One row."""
        width = self.size.width
        base = self._style("")
        if y >= len(self._shown):
            return Strip.blank(width, base)
        segments = [Segment(text, self._style(look)) for text, look in self._shown[y]]
        return Strip(segments).adjust_cell_length(width, base)

    def notify_style_update(self) -> None:
        """The style sheet has changed what this panel looks like."""
        self._styles.clear()
        super().notify_style_update()

    def _style(self, look: str) -> Style:
        """Of a look; of the panel itself where the look has no name."""
        if look not in self._styles:
            found = self.get_component_rich_style(f"look--{look}") if look else self.rich_style
            self._styles[look] = found
        return self._styles[look]


LONGEST = 500  # entries; older ones are dropped


def clock() -> str:
    """Local time of day."""
    return time.strftime("%H:%M:%S")


class EventLog(RichLog, can_focus=False):
    """Entries with an optional time. It follows the latest entry until it is scrolled up."""

    COMPONENT_CLASSES = {f"look--{look}" for look in LOOKS}  # noqa: RUF012 - as Textual declares it

    def __init__(self, id: str, title: str) -> None:  # noqa: A002 - as Textual calls it
        super().__init__(id=id, min_width=8)
        self.border_title = title
        self._entries: deque[tuple[str, str, str]] = deque(maxlen=LONGEST)
        self._width = 0

    @property
    def text(self) -> str:
        """The entries, without wrapping."""
        return "\n".join(f"{at} {text}".strip() for at, text, _ in self._entries)

    def add(self, text: str, look: str = "plain", at: str = "") -> None:
        """Add an entry, with the time `at` before it."""
        for line in text.splitlines() or [""]:
            self._entries.append((at, line, look))
            if self._width:
                self._draw(at, line, look)

    def on_resize(self, event: events.Resize) -> None:
        """Wrap again."""
        super().on_resize(event)
        if (width := self.scrollable_content_region.width) != self._width:
            self._width = width
            self.clear()
            for entry in self._entries:
                self._draw(*entry)

    def _draw(self, at: str, text: str, look: str) -> None:
        is_following = self.is_vertical_scroll_end
        indent = len(at) + 1 if at else 0
        for n, spans in enumerate(wrapped(text, look, self._width - indent, "! " if look == "error" else "")):
            start = row((f"{at} " if n == 0 and at else " " * indent, "muted"))
            self.write(self._styled((*start, *spans)), scroll_end=is_following)

    def _styled(self, spans: Row) -> Text:
        parts = ((text, self.get_component_rich_style(f"look--{look}", partial=True)) for text, look in spans)
        return Text.assemble(*parts, no_wrap=True)
