"""Way-points from a file."""

from dataclasses import dataclass
from pathlib import Path

from control.errors import WaypointFileError
from control.kinematics.rotation import Quaternion
from control.motion.setpoint import Vector
from control.tables import ColumnGroup, TableColumn, TableFormat, read_table

POSITION_COLUMNS = ("x_m", "y_m", "z_m")
SPEED_COLUMN = "speed_m_s"
ORIENTATION_COLUMNS = ("qw", "qx", "qy", "qz")
WAYPOINTS_MOST = 2_000  # planning takes 0.1 MB and some milliseconds for each
WAYPOINTS = TableFormat(
    "way-point",
    (
        *(
            TableColumn(
                name,
                "position in the base frame",
                is_required=True,
                lower=-10.0,  # no table-top arm reaches this far; a larger number is probably in millimetres
                upper=10.0,
                expected="a number from -10 to 10 m",
                mistaken_for=("millimetres", 1e-3),
            )
            for name in POSITION_COLUMNS
        ),
        TableColumn(
            SPEED_COLUMN,
            "speed on the way to it",
            may_be_empty=False,
            lower=0.0,
            upper=10.0,
            expected="a number from 0 to 10 m/s",
            mistaken_for=("mm/s", 1e-3),
        ),
        *(TableColumn(name, "orientation of the last link: unit quaternion", may_be_empty=False) for name in ORIENTATION_COLUMNS),
    ),
    groups=(ColumnGroup(ORIENTATION_COLUMNS),),
    unknown="refused",
    most_rows=WAYPOINTS_MOST,
    too_many="more cannot be planned at once; split the path",
)


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
    table = read_table(file, WAYPOINTS, WaypointFileError)
    if len(table) < 2:
        raise WaypointFileError(f"{file}: a path needs at least two way-points, got {len(table)}")
    turns = table.quaternions(*ORIENTATION_COLUMNS).tolist() if ORIENTATION_COLUMNS[0] in table else None
    return Waypoints(
        points=tuple((x, y, z) for x, y, z in table.numbers(*POSITION_COLUMNS).tolist()),
        speeds_m_s=tuple(table.number(SPEED_COLUMN).tolist()) if SPEED_COLUMN in table else None,
        places=tuple(table.place(row) for row in range(len(table))),
        orientations=None if turns is None else tuple((w, x, y, z) for w, x, y, z in turns),
    )
