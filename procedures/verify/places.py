"""Places of a verification: points between the cavities and paths above every tilt of the board, 5 cm up.

No pose here is one of calibration's, which are in the cavities. The board need not be present.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from control.errors import MissingModel
from control.model import table as tables
from control.model.arm import Table, Vector3
from control.motion.waypoints import Waypoints

SETUPS = ("normal", "roll", "pitch")
HEIGHT_m = 0.05  # above the board: an uncalibrated arm is some 3 cm off
POINTS = 6
POINTS_RADIUS = 2.0 / 3.0  # of the outermost cavity's
CIRCLE_POINTS = 24
LINE_POINTS = 9
_LEAST_RADIUS_m = 0.02


@dataclass(frozen=True, slots=True)
class Place:
    """A verification point: the wanted tip position in the frame of table and camera.

    `near_rad`: the posture near which an arm with free joints reaches it; None: that of the point before.
    """

    setup: str
    point: str
    tip_m: Vector3
    near_rad: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Way:
    """A path to run: its name, the tilt of the board that it is parallel to, way-points in the frame of table and camera."""

    name: str
    setup: str
    waypoints: Waypoints


def places(table: Table, setups: Sequence[str], height_m: float = HEIGHT_m) -> tuple[Place, ...]:
    """Six points on a circle above each tilt, between the cavities. MissingModel if the board's pose is unknown."""
    radius = POINTS_RADIUS * _radius_m(table)
    return tuple(
        Place(setup, f"v{number + 1}", _above(table, setup, radius, (number + 0.5) / POINTS, height_m))
        for setup in setups
        for number in range(POINTS)
    )


def ways(table: Table, setups: Sequence[str], height_m: float = HEIGHT_m) -> tuple[Way, ...]:
    """A circle, and a straight line across the board's own, above each tilt."""
    return tuple(
        Way(name, setup, Waypoints(tuple(points), None))
        for setup in setups
        for name, points in (
            ("circle", _circle(table, setup, height_m)),
            ("line", _line(table, setup, height_m)),
        )
    )


def _circle(table: Table, setup: str, height_m: float) -> list[Vector3]:
    radius = _radius_m(table)
    turns = [number / CIRCLE_POINTS for number in range(CIRCLE_POINTS)]
    return [_above(table, setup, radius, turn, height_m) for turn in (*turns, 0.0)]


def _line(table: Table, setup: str, height_m: float) -> list[Vector3]:
    """Along the board's y axis; the cavities' line runs along x."""
    radius = _radius_m(table)
    shares = [2.0 * number / (LINE_POINTS - 1) - 1.0 for number in range(LINE_POINTS)]
    return [tables.to_base(table, setup, (0.0, share * radius, height_m)) for share in shares]


def _above(table: Table, setup: str, radius_m: float, turn: float, height_m: float) -> Vector3:
    angle = 2.0 * math.pi * turn
    return tables.to_base(table, setup, (radius_m * math.cos(angle), radius_m * math.sin(angle), height_m))


def _radius_m(table: Table) -> float:
    """Distance of the outermost cavity from the board's centre."""
    radius = max((math.hypot(x, y) for x, y, _ in tables.board_cavities(table).values()), default=0.0)
    if radius < _LEAST_RADIUS_m:
        raise MissingModel(
            f"the table's cavities reach {radius:.3f} m from the board's centre, expected at least {_LEAST_RADIUS_m}"
            " m for the verification points and paths"
        )
    return radius
