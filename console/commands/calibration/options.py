"""Options that several commands of calibration share: lists of names, bounds, measured boards, history."""

import argparse
import dataclasses
import datetime
import math
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from calib.ageing import (
    FORMAT,
    Entry,
    GeometryRecord,
    Quantity,
    append_entry,
    measured_at,
    require_appendable,
)
from calib.arm_problem.frames import Frame
from calib.arm_problem.parameters import Bounds
from calib.boards import read_boards
from calib.errors import CalibrationError
from console.quantities import quantity, unit_of

FARTHEST_m = 20.0  # of a wire's fixed point


def names_in(texts: list[str]) -> list[str]:
    """Names of a repeatable option whose values are separated by commas."""
    return [name.strip() for text in texts for name in text.split(",") if name.strip()]


def bounds_of(texts: list[str]) -> Bounds:
    """`lengths=5mm`, `angles=2deg`, or a parameter by name."""
    general: dict[str, float] = {}
    own: dict[str, float] = {}
    for text in names_in(texts):
        name, _, value = text.partition("=")
        if not value:
            raise CalibrationError(
                f'--bound: expected NAME=VALUE such as L2=8mm or angles=3deg, got "{text}"'
            )
        if name in ("lengths", "angles"):
            unit = "m" if name == "lengths" else "rad"
            general["length_m" if name == "lengths" else "angle_rad"] = quantity(
                value, unit, f"--bound {name}"
            )
        else:
            own[name] = quantity(value, unit_of(name), f"--bound {name}")
    return Bounds(own=own, **general)


def wires_at(texts: list[str]) -> dict[str, tuple[float, float, float]]:
    """Fixed points of wires [m] by their names."""
    found = {}
    for text in texts:
        name, _, place = text.partition("=")
        try:
            x, y, z = (float(value) for value in place.split(","))
        except ValueError:
            x = y = z = math.nan
        if not name or not math.hypot(x, y, z) <= FARTHEST_m:
            raise CalibrationError(
                f'--wire-at: expected NAME=X,Y,Z in m, such as A=0.9,-0.5,0.1, got "{text}"'
            )
        found[name] = (x, y, z)
    return found


def board_frames(file: str | None) -> dict[str, Frame]:
    """Board poses by setup from boards.json of `armwright register`; none without a file."""
    if file is None:
        return {}
    return {
        setup: Frame(f"table_{setup}", board.rotation, board.origin_m)
        for setup, board in read_boards(Path(file)).items()
    }


@dataclasses.dataclass(frozen=True, slots=True)
class HistoryRecord:
    """Where and when; asked for and checked before anything is computed."""

    path: Path
    measured: datetime.datetime
    by: str
    arm: str

    def append(
        self,
        inputs: Mapping[str, str],
        geometry: GeometryRecord | None = None,
        quantities: Mapping[str, Quantity] | None = None,
    ) -> None:
        """Write the line, after the command's own results."""
        program = f"armwright {version('armwright')}"
        append_entry(
            self.path,
            Entry(
                FORMAT,
                self.measured,
                self.by,
                self.arm,
                program,
                dict(inputs),
                geometry,
                dict(quantities or {}),
            ),
        )


def record_of(given: argparse.Namespace, by: str, arm: str) -> HistoryRecord | None:
    """None without --history; CalibrationError if the record cannot be continued."""
    if given.history is None:
        if given.measured is not None:
            raise CalibrationError("--measured: needs --history, the record that the date is for")
        return None
    record = HistoryRecord(Path(given.history), measured_at(given.measured), by, arm)
    require_appendable(record.path, arm)
    return record
