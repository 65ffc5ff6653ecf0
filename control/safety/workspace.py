"""The workspace that an arm may use: above the floor and the table, outside of its own base. Pure functions of positions.

It knows no joints and no trajectories: corners of the arm in, a clearance out. What the arm must not meet is listed here, so
further obstacles are further lines of `clearances`. All formulas hold for plain floats (the
control cycle) and for arrays (a whole motion).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from control.errors import ArmError
from control.model.arm import Arm
from control.model.table import board_cavities

Point = Sequence[Any]  # x, y, z: floats, or arrays of one length
BOARD_MARGIN_m = 0.03  # the board reaches this far beyond its outermost cavity
FOREARM_SHARES = (0.25, 0.5, 0.75)  # points of the last link that are held above the board, besides its ends
_NOTHING_m2 = 1e-12  # below it a segment has no length


class Clearance(NamedTuple):
    """How far away something is [m], below 0: inside; and what. Infinite where nothing is near."""

    distance_m: float
    what: str


@dataclass(frozen=True, slots=True)
class LinkThickness:
    """What the corners do not say: how thick the body is that ends at each [m], and where it gets free of the base.

    The body before the corner `first_free` hangs on the base and always meets it. The tip is a point: it may touch.
    """

    radii_m: tuple[float, ...]
    first_free: int = 0
    thickest_m: float = field(init=False)
    at_corners_m: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        at_corners_m = (*(max(pair) for pair in pairwise(self.radii_m)), 0.0)
        object.__setattr__(self, "at_corners_m", at_corners_m)
        object.__setattr__(self, "thickest_m", max(self.radii_m))


def _lines(corners: int) -> LinkThickness:
    return LinkThickness((0.0,) * corners)


class _Library(NamedTuple):
    """What floats and arrays do differently."""

    least: Callable[[Any, Any], Any]
    greatest: Callable[[Any, Any], Any]
    where: Callable[[Any, Any, Any], Any]
    lowest: Callable[[Sequence[Any]], float]


_FLOATS = _Library(min, max, lambda is_so, yes, no: yes if is_so else no, min)
_ARRAYS = _Library(np.minimum, np.maximum, np.where, lambda heights: float(np.min(heights)))


@dataclass(frozen=True, slots=True)
class TiltedBoard:
    """A calibration board that may be tilted about its centre: it covers a disc of the table."""

    origin_m: tuple[float, float, float]
    radius_m: float
    roll_slope: float
    pitch_slope: float


@dataclass(frozen=True, slots=True)
class Workspace:
    """Floor, board and base of an arm. `tolerance_m`: how far the model may be wrong about floor and board."""

    floor_z_m: float
    tolerance_m: float
    board: TiltedBoard | None
    base_top_m: float
    base_radius_m: float

    @staticmethod
    def of(arm: Arm) -> "Workspace":
        """The workspace of an arm.toml: [limits] floor_z_m, floor_clearance_m, floor_tolerance_m, base_radius_m, and [table]."""
        limits = arm.limits
        return Workspace(
            limits.floor_z_m + limits.floor_clearance_m,
            limits.floor_tolerance_m,
            _board_of(arm),
            max(arm.links[0].d_m, 0.0),
            limits.base_radius_m,
        )

    def clearance(self, corners: Sequence[Point], body: LinkThickness | None = None) -> Clearance:
        """The least clearance of an arm whose body runs along `corners` (floats). ArmError if one is not finite.

        `body`: without it, lines.
        """
        least_m, about = math.inf, ""
        for corner in corners:
            if (total := sum(corner)) - total != 0.0:
                raise ArmError(f"workspace: expected finite positions of the arm, got {corners}")
        for distance_m, what in self._clearances(corners, body or _lines(len(corners)), _FLOATS):
            if distance_m < least_m:
                least_m, about = distance_m, what
        return Clearance(least_m, about)

    def is_far(self, corners: Sequence[Point], body: LinkThickness, way_m: float) -> bool:
        """Whether the arm surely meets nothing, however each of its points (floats) moves by up to `way_m`.

        Quick, for the cycle: where it is False, `clearance` tells. False, too, if a position is not finite.
        """
        total, lowest_m = 0.0, math.inf
        for x, y, z in corners:
            total += x + y + z
            if z < lowest_m:
                lowest_m = z
        around_m = body.thickest_m + way_m
        lowest_m -= around_m
        if total - total != 0.0 or not lowest_m >= self.floor_z_m - self.tolerance_m:
            return False
        reach_m = self.base_radius_m
        return (
            reach_m == 0.0
            or lowest_m > self.base_top_m + reach_m
            or _is_beside_axis(corners[body.first_free :], reach_m + around_m)
        )

    def clearances(self, corners: Sequence[Any], body: LinkThickness | None = None) -> Iterator[tuple[Any, str]]:
        """For arrays: the clearances [m] of what may be near at all, and what each is about."""
        return self._clearances(corners, body or _lines(len(corners)), _ARRAYS)

    def _clearances(self, corners: Sequence[Point], body: LinkThickness, of: _Library) -> Iterator[tuple[Any, str]]:
        lowest_m = of.lowest([corner[2] for corner in corners]) - body.thickest_m
        if not lowest_m >= self.floor_z_m - self.tolerance_m:
            yield from self._above_ground(corners, body, of)
        if self.base_radius_m > 0.0 and not lowest_m > self.base_top_m + self.base_radius_m:
            free = body.first_free
            for (start, end), radius_m in zip(pairwise(corners[free:]), body.radii_m[free + 1 :], strict=True):
                yield (_distance_to_axis(self.base_top_m, start, end, of) - self.base_radius_m - radius_m, _BASE)

    def _above_ground(self, corners: Sequence[Point], body: LinkThickness, of: _Library) -> Iterator[tuple[Any, str]]:
        last = len(corners) - 1
        for number, ((x, y, z), radius_m) in enumerate(zip(corners, body.at_corners_m, strict=True)):
            yield z - radius_m - self._ground(x, y, of), _TIP if number == last else _BODY
        if last > 0:
            forearm_m = body.radii_m[last]
            (ax, ay, az), (bx, by, bz) = corners[-2], corners[-1]
            for share in FOREARM_SHARES:
                x, y, z = ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)
                yield z - forearm_m - self._ground(x, y, of), _BODY

    def _ground(self, x: Any, y: Any, of: _Library) -> Any:
        """The lowest height [m] that is allowed at a place: the floor, or the board's plane, flat or tilted, if that is lower."""
        floor_m, board = self.floor_z_m - self.tolerance_m, self.board
        if board is None:
            return floor_m
        u, v = x - board.origin_m[0], y - board.origin_m[1]
        plane_m = of.least(of.least(board.roll_slope * v, -board.pitch_slope * u), 0.0) + board.origin_m[2]
        is_over = u * u + v * v <= board.radius_m**2
        return of.where(is_over, of.least(plane_m - self.tolerance_m, floor_m), floor_m)


_TIP = "the tip would be below the floor or table"
_BODY = "the arm would be below the floor or table"
_BASE = "the arm would meet its own base"


def _board_of(arm: Arm) -> TiltedBoard | None:
    table = arm.table
    if table is None or not table.known_pose or table.origin_m is None:
        return None
    reach_m = max((math.hypot(x, y) for x, y, _ in board_cavities(table).values()), default=0.0)
    return TiltedBoard(table.origin_m, reach_m + BOARD_MARGIN_m, math.tan(table.roll_tilt_rad), math.tan(table.pitch_tilt_rad))


def _is_beside_axis(corners: Sequence[Point], distance_m: float) -> bool:
    """Whether all lines between corners lie beyond an upright plane at a distance from the base's axis; it faces the last one."""
    if len(corners) < 2:
        return True
    x, y, _ = corners[-1]
    least = distance_m * math.hypot(x, y)
    for px, py, _ in corners:  # noqa: SIM110  a loop costs the cycle half of what `all` does
        if not x * px + y * py > least:
            return False
    return True


def _distance_to_axis(top_m: float, start: Point, end: Point, of: _Library) -> Any:
    """Distance [m] of a segment from the part of the base's axis between the origin and `top_m`."""
    (px, py, pz), (qx, qy, qz) = start, end
    ux, uy, uz = qx - px, qy - py, qz - pz
    level2 = ux * ux + uy * uy
    length2 = level2 + uz * uz + _NOTHING_m2
    # Nearest points of two segments: s along the segment, t along the axis (Ericson, Real-Time Collision Detection, 5.1.9).
    along = ux * px + uy * py + uz * pz
    s = of.least(of.greatest((uz * pz - along) / (level2 + _NOTHING_m2), 0.0), 1.0)
    height = of.least(of.greatest(pz + s * uz, 0.0), top_m)
    s = of.least(of.greatest((height * uz - along) / length2, 0.0), 1.0)
    x, y, z = px + s * ux, py + s * uy, pz + s * uz - height
    return (x * x + y * y + z * z) ** 0.5
