"""Draws the arm in characters, from the side and from above: links, numbered joints, the base frame's axes, the board."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from console.screen.drawing.braille import Canvas
from console.screen.drawing.rows import Row
from control.kinematics.kinematics import Kinematics
from control.model import table as tables
from control.model.arm import Arm
from control.motion.jog_limits import reaches_m

Point = tuple[float, float, float]
GRID = 4  # of the reach: step of a picture's edges
SIDE, TOP = (0, 2), (0, 1)  # the axes to the right and up
TIP = "◆"
NOT_HOMED = "not homed: the pose is not known"
_MARGIN_dots = 4  # for marks and letters at the edges
_TICKS_m = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
_TALL_dots = 64  # from this scale on, links are five dots thick instead of three
_NUMBER_dots = 14  # smallest distance of numbered ticks


@dataclass(frozen=True, slots=True)
class Scene:
    """What is drawn, in the base frame [m]: the arm's corners from base to tip, its joints and their labels, the board's edge."""

    arm: Sequence[Point]
    joints: Sequence[tuple[Point, str, str]]  # position, sign, style
    board: Sequence[Point]


class Skeleton:
    """Corners of an arm in a pose, for drawing."""

    def __init__(self, arm: Arm) -> None:
        self._kinematics = Kinematics(arm)
        # The frame whose z axis a joint turns about: the previous link's, or its own (Craig's convention).
        own = 1 if arm.dh_convention == "modified" else 0
        self._frames = [number + own for number, turns in enumerate(arm.joints) if turns]
        self.reach_m = reaches_m(arm)[0]
        self.board = _outline(arm)

    def scene(self, q_rad: Sequence[float], selected: int | None, is_stale: Sequence[bool]) -> Scene:
        """The arm at joint angles; the selected joint (0-based) is highlighted, a stale one has a question mark."""
        frames = self._kinematics.link_transforms([q_rad])[0]
        corners: list[Point] = [(float(f[0, 3]), float(f[1, 3]), float(f[2, 3])) for f in frames]
        joints = [
            (corners[frame], "?" if is_stale[j] else str(j + 1), "chosen" if j == selected else "badge")
            for j, frame in enumerate(self._frames)
        ]
        return Scene([*corners, self._kinematics.tip(*q_rad)], joints, self.board)


def side_view(scene: Scene, columns: int, rows: int, reach_m: float) -> list[Row]:
    """View along the y axis: x to the right, z up; the ground is a line."""
    return _view(scene, columns, rows, reach_m, SIDE)


def top_view(scene: Scene, columns: int, rows: int, reach_m: float) -> list[Row]:
    """View from above: x to the right, y up."""
    return _view(scene, columns, rows, reach_m, TOP)


def _view(scene: Scene, columns: int, rows: int, reach_m: float, axes: tuple[int, int]) -> list[Row]:
    canvas = Canvas(columns, rows)
    place, dots_m = _placed(canvas, scene, axes, reach_m)
    _draw_axes(canvas, place, dots_m, axes)
    _draw_arm(canvas, scene, place)
    if not scene.arm:
        canvas.letters(max((columns - len(NOT_HOMED)) // 2, 0), rows // 2, NOT_HOMED, "warning")
    return canvas.lines()


def _placed(
    canvas: Canvas, scene: Scene, axes: tuple[int, int], reach_m: float
) -> tuple[Callable[[Point], tuple[int, int]], float]:
    """Map metres to dots, and dots per metre, with equal scales, so that the scene fills the picture.

    The edges are at whole quarters of the reach, so that small motions do not shift the picture.
    """
    points = [(0.0, 0.0, 0.0), *scene.arm, *scene.board]
    grid_m = reach_m / GRID
    spans = []
    for axis in axes:
        values = [point[axis] for point in points]
        spans.append((grid_m * math.floor(min(values) / grid_m), grid_m * math.ceil(max(values) / grid_m)))
    (left, right), (low, high) = spans
    wide, tall = canvas.width - 1 - 2 * _MARGIN_dots, canvas.height - 1 - 2 * _MARGIN_dots
    scale = max(min(wide / max(right - left, grid_m), tall / max(high - low, grid_m)), 1.0)
    edge = (canvas.width - 1 - scale * (right - left)) / 2.0
    free = (canvas.height - 1 - scale * (high - low)) / 2.0
    bottom = canvas.height - 1 - (min(free, 2 * _MARGIN_dots) if axes == SIDE else free)
    across, up = axes

    def place(point: Point) -> tuple[int, int]:
        return round(edge + scale * (point[across] - left)), round(bottom - scale * (point[up] - low))

    return place, scale


def _draw_axes(
    canvas: Canvas, place: Callable[[Point], tuple[int, int]], dots_m: float, axes: tuple[int, int]
) -> None:
    """The base frame's axes across the picture, with ticks in metres; the side view's x axis is the ground."""
    x0, y0 = place((0.0, 0.0, 0.0))
    is_side = axes == SIDE
    canvas.line(0, y0, canvas.width - 1, y0, "muted", every=1 if is_side else 3)
    canvas.line(x0, 0, x0, canvas.height - 1 if not is_side else y0, "muted", every=3)
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


def _draw_arm(canvas: Canvas, scene: Scene, place: Callable[[Point], tuple[int, int]]) -> None:
    for start, end in pairwise([place(corner) for corner in scene.board]):
        canvas.line(*start, *end, "strong")
    for start, end in pairwise([place(corner) for corner in scene.arm]):
        canvas.stroke(*start, *end, "accent", half=2 if canvas.height >= _TALL_dots else 1)
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
    edge = (
        (min(xs), min(ys)),
        (max(xs), min(ys)),
        (max(xs), max(ys)),
        (min(xs), max(ys)),
        (min(xs), min(ys)),
    )
    return [tables.to_base(arm.table, "normal", (x, y, 0.0)) for x, y in edge]
