"""The calibration table: its cavities on the board and, by the board's tilt, in the base frame.

Board frame: origin at the board's centre, x and y in the board, z up out of it. The setup "normal" has its
axes along the base frame's; "roll" turns the board about its x axis, "pitch" about its y axis (right-hand
rule), both about `origin_m`.
"""

import math

from control.errors import ArmError, MissingModel
from control.model.arm import Arm, Table, Vector3

SETUPS = ("normal", "roll", "pitch")
Rotation = tuple[Vector3, Vector3, Vector3]


def table_of(arm: Arm) -> Table:
    """The arm's table; MissingModel where its file has none."""
    if arm.table is None:
        raise MissingModel(
            f"arm {arm.name}: this needs a calibration table: add [table]. Without one a camera measures free poses: `armwright"
            " session --camera --free 24`, and others for `armwright verify --points`"
        )
    return arm.table


def board_cavities(table: Table) -> dict[str, Vector3]:
    """Cavities in the board frame [m] by name: the circle from "1" on counter-clockwise from +x, then the
    line.

    The line runs along x from its negative end, centred on the board. Cavities named in the file
    follow the pattern, if there is one.
    """
    pattern = [*_circle(table), *_line(table)]
    numbered = {str(number): point for number, point in enumerate(pattern, 1)}
    return numbered | {name: (point[0], point[1], point[2]) for name, point in table.cavities_m.items()}


def cavities(table: Table, setup: str = "normal") -> dict[str, Vector3]:
    """Cavities in the base frame [m] by name, in the order of `board_cavities`.

    Raises:
        MissingModel: the board's pose is not known (identify it first).
        ArmError: there is no such setup.
    """
    return {name: to_base(table, setup, point) for name, point in board_cavities(table).items()}


def to_base(table: Table, setup: str, point: Vector3) -> Vector3:
    """A point of the board frame in the base frame; errors as `cavities`."""
    origin, rows = board_origin(table), board_rotation(table, setup)
    x, y, z = (o + sum(r * p for r, p in zip(row, point, strict=True)) for o, row in zip(origin, rows, strict=True))
    return x, y, z


def board_origin(table: Table) -> Vector3:
    """The board's centre in the base frame, also the centre of its tilts; MissingModel if unknown."""
    if not table.known_pose or table.origin_m is None:
        raise MissingModel("the calibration board's pose is unknown: set known_pose = true and origin_m in [table]")
    return table.origin_m


def board_rotation(table: Table, setup: str) -> Rotation:
    """Rows of base_R_board; the third column is the board's normal in the base frame."""
    if setup == "normal":
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    if setup == "roll":
        c, s = math.cos(table.roll_tilt_rad), math.sin(table.roll_tilt_rad)
        return ((1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c))
    if setup == "pitch":
        c, s = math.cos(table.pitch_tilt_rad), math.sin(table.pitch_tilt_rad)
        return ((c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c))
    raise ArmError(f'table setup: expected one of {", ".join(SETUPS)}, got "{setup}"')


def _circle(table: Table) -> list[Vector3]:
    count, radius = table.circle_points, table.circle_radius_m
    if not count or radius is None:
        return []
    angles = [2.0 * math.pi * i / count for i in range(count)]
    return [(radius * math.cos(angle), radius * math.sin(angle), 0.0) for angle in angles]


def _line(table: Table) -> list[Vector3]:
    count, pitch = table.line_points, table.line_pitch_m
    if not count or pitch is None:
        return []
    return [((i - (count - 1) / 2.0) * pitch, 0.0, 0.0) for i in range(count)]
