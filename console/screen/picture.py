"""The arm in characters, from the side and from above."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from console.screen.braille import Canvas
from control.kinematics.kinematics import Kinematics
from control.model import table as tables
from control.model.arm import Arm
from control.motion.jog_limits import reaches_m

Point = tuple[float, float, float]
GRID = 4  # of the reach: how finely a picture's edges follow the arm


@dataclass(frozen=True, slots=True)
class Scene:
    """What is seen: the arm's corners from base to tip, where it is wanted, and the board."""

    arm: Sequence[Point]
    wanted: Sequence[Point]
    board: Sequence[Point]


class Skeleton:
    """Corners of an arm in a pose, for drawing."""

    def __init__(self, arm: Arm) -> None:
        self._kinematics = Kinematics(arm)
        self.reach_m = reaches_m(arm)[0]
        self.board = _outline(arm)

    def corners(self, q_rad: Sequence[float]) -> list[Point]:
        """Origins of the frames, and the tip, in the base frame."""
        frames = self._kinematics.link_transforms([q_rad])[0]
        points = [(float(f[0, 3]), float(f[1, 3]), float(f[2, 3])) for f in frames]
        return [*points, self._kinematics.tip(*q_rad)]


def side_view(scene: Scene, columns: int, rows: int, reach_m: float) -> list[str]:
    """Seen along the y axis: x to the right, z up; the floor is a dotted line."""
    canvas = Canvas(columns, rows)
    place = _placed(canvas, scene, (0, 2), reach_m)
    _, floor = place((0.0, 0.0, 0.0))
    canvas.line(0, floor, canvas.width - 1, floor, every=4)
    _draw(canvas, scene, place)
    return canvas.lines()


def top_view(scene: Scene, columns: int, rows: int, reach_m: float) -> list[str]:
    """Seen from above: x to the right, y up, as on a map."""
    canvas = Canvas(columns, rows)
    _draw(canvas, scene, _placed(canvas, scene, (0, 1), reach_m))
    return canvas.lines()


def _placed(
    canvas: Canvas, scene: Scene, axes: tuple[int, int], reach_m: float
) -> Callable[[Point], tuple[int, int]]:
    """From metres to dots, the same scale for both axes: what there is fills the picture.

    Its edges are at whole quarters of the reach, so that the picture stands still while the arm moves a little.
    """
    points = [(0.0, 0.0, 0.0), *scene.arm, *scene.wanted, *scene.board]
    grid_m = reach_m / GRID
    spans = []
    for axis in axes:
        values = [point[axis] for point in points]
        spans.append((grid_m * math.floor(min(values) / grid_m), grid_m * math.ceil(max(values) / grid_m)))
    (left, right), (low, high) = spans
    scale = min((canvas.width - 1) / max(right - left, grid_m), (canvas.height - 1) / max(high - low, grid_m))
    edge = (canvas.width - 1 - scale * (right - left)) / 2.0
    bottom = (canvas.height - 1 + scale * (high - low)) / 2.0
    across, up = axes

    def place(point: Point) -> tuple[int, int]:
        return round(edge + scale * (point[across] - left)), round(bottom - scale * (point[up] - low))

    return place


def _draw(canvas: Canvas, scene: Scene, place: Callable[[Point], tuple[int, int]]) -> None:
    for corners, every in ((scene.board, 2), (scene.wanted, 3), (scene.arm, 1)):
        dots = [place(corner) for corner in corners]
        for (x0, y0), (x1, y1) in pairwise(dots):
            canvas.line(x0, y0, x1, y1, every)
    if scene.arm:
        x, y = place(scene.arm[-1])
        for dx, dy in ((-1, -1), (1, 1), (-1, 1), (1, -1)):
            canvas.dot(x + dx, y + dy)


def _outline(arm: Arm) -> list[Point]:
    """The board's edge about its cavities, level; nothing where it is not known."""
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
