"""Way-points from a file, and the circle and line of the calibration table."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from control.errors import BadTarget, MissingModel
from control.kinematics.rotation import Quaternion, checked_quaternion
from control.model import table as tables
from control.model.arm import Table
from control.motion.errors import WaypointFileError
from control.motion.setpoint import Vector
from control.tables import opened_rows

POSITION_COLUMNS = ("x_m", "y_m", "z_m")
SPEED_COLUMN = "speed_m_s"
ORIENTATION_COLUMNS = ("qw", "qx", "qy", "qz")
# No table-top arm reaches this far; a larger number is probably in millimetres.
_FARTHEST_M = 10.0
_FASTEST_M_S = 10.0
WAYPOINTS_MOST = 2_000  # planning takes 0.1 MB and some milliseconds for each
_FOREIGN_UNITS = {"_mm": "metres (column names end in _m)", "_cm": "metres (column names end in _m)"}


@dataclass(frozen=True, slots=True)
class Waypoints:
    """Points [m] in the base frame, a speed [m/s] for each or None, and their places in the file (for messages).

    `orientations`: unit quaternions of the last link frame in the base frame, or None where the orientation is free.
    """

    points: tuple[Vector, ...]
    speeds_m_s: tuple[float, ...] | None
    places: tuple[str, ...] = ()
    orientations: tuple[Quaternion, ...] | None = None

    def name(self, number: int) -> str:
        """Name of way-point `number` (1-based) for errors: its number, and file and line if known."""
        place = f" ({self.places[number - 1]})" if self.places else ""
        return f"way-point {number}{place}"


def read_waypoints(path: str | Path) -> Waypoints:
    """Read way-points from a CSV file with columns x_m, y_m, z_m and, optionally, qw, qx, qy, qz and speed_m_s.

    Raises:
        WaypointFileError: names file, line and column.
    """
    file = Path(path)
    with opened_rows(file, WaypointFileError, WAYPOINTS_MOST) as reader:
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    if not rows:
        raise WaypointFileError(
            f"{file}: expected a header line {','.join(POSITION_COLUMNS)}, got an empty file"
        )
    columns = _checked_header(file, rows[0][0], [cell.strip() for cell in rows[0][1]])
    values = [_numbers(f"{file}:{number}", columns, row) for number, row in rows[1:]]
    if len(values) < 2:
        raise WaypointFileError(f"{file}: a path needs at least two way-points, got {len(values)}")
    return Waypoints(
        points=tuple((row["x_m"], row["y_m"], row["z_m"]) for row in values),
        speeds_m_s=tuple(row[SPEED_COLUMN] for row in values) if SPEED_COLUMN in columns else None,
        places=tuple(f"{file}:{number}" for number, _ in rows[1:]),
        orientations=_orientations(values, [f"{file}:{number}" for number, _ in rows[1:]]),
    )


def _orientations(values: Sequence[dict[str, float]], places: Sequence[str]) -> tuple[Quaternion, ...] | None:
    """The unit quaternions of the lines; None without such columns."""
    if ORIENTATION_COLUMNS[0] not in values[0]:
        return None
    found = []
    for row, place in zip(values, places, strict=True):
        try:
            found.append(checked_quaternion([row[column] for column in ORIENTATION_COLUMNS]))
        except BadTarget as error:
            raise WaypointFileError(f"{place}: {error}") from None
    return tuple(found)


def circle(table: Table, setup: str = "normal", height_m: float = 0.0) -> Waypoints:
    """Once around the table's circle, from cavity 1 back to it, `height_m` above the board."""
    names = tables.circle_names(table)
    return _above_board(table, setup, [*names, *names[:1]], height_m, "circle")


def line(table: Table, setup: str = "normal", height_m: float = 0.0) -> Waypoints:
    """Along the table's line from its first cavity to its last, `height_m` above the board."""
    return _above_board(table, setup, tables.line_names(table), height_m, "line")


def _above_board(table: Table, setup: str, names: Sequence[str], height_m: float, what: str) -> Waypoints:
    """Points above the named cavities."""
    if not names:
        raise MissingModel(f"the arm's [table] has no {what}: give its number of points and its size")
    cavities = tables.board_cavities(table)
    raised = [(cavities[name][0], cavities[name][1], cavities[name][2] + height_m) for name in names]
    points = tuple(tables.to_base(table, setup, point) for point in raised)
    return Waypoints(points, None, tuple(f"cavity {name}" for name in names))


def _checked_header(file: Path, number: int, columns: list[str]) -> list[str]:
    """Return the columns; WaypointFileError for the first missing, unknown or duplicate one."""
    allowed = (*POSITION_COLUMNS, *ORIENTATION_COLUMNS, SPEED_COLUMN)
    for column in columns:
        hint = next(
            (f": write {unit}" for ending, unit in _FOREIGN_UNITS.items() if column.endswith(ending)), ""
        )
        if column not in allowed:
            raise WaypointFileError(
                f"{file}:{number}: expected columns {', '.join(POSITION_COLUMNS)} and optionally {SPEED_COLUMN} and"
                f' {", ".join(ORIENTATION_COLUMNS)}, got "{column[:80]}"{hint}'
            )
        if columns.count(column) > 1:
            raise WaypointFileError(f"{file}:{number}: column {column} appears twice")
    has_turn = any(column in columns for column in ORIENTATION_COLUMNS)
    for column in (*POSITION_COLUMNS, *(ORIENTATION_COLUMNS if has_turn else ())):
        if column not in columns:
            raise WaypointFileError(f"{file}:{number}: column {column} is missing, got {', '.join(columns)}")
    return columns


def _numbers(place: str, columns: list[str], row: list[str]) -> dict[str, float]:
    """Parse the numbers of a line by column."""
    if len(row) != len(columns):
        raise WaypointFileError(f"{place}: expected {len(columns)} values, got {len(row)}")
    return {column: _number(place, column, text) for column, text in zip(columns, row, strict=True)}


def _number(place: str, column: str, text: str) -> float:
    """Parse a finite number of plausible size."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise WaypointFileError(f'{place}: {column}: expected a finite number, got "{text.strip()}"')
    if column == SPEED_COLUMN:
        if not 0.0 <= value <= _FASTEST_M_S:
            hint = f" (mm/s? then write {value / 1000.0:g})" if value > 0.0 else ""
            raise WaypointFileError(
                f"{place}: {column}: expected 0 to {_FASTEST_M_S:g} m/s, got {value:g}{hint}"
            )
    elif abs(value) > _FARTHEST_M:
        raise WaypointFileError(
            f"{place}: {column}: {value:g} m is out of any arm's reach (millimetres? then write {value / 1000.0:g})"
        )
    return value
