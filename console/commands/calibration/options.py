"""Options that several commands of calibration share, and quantities with units, such as `5mm` or `2deg`, converted to SI.

Printed and drawn values have the same units everywhere: lengths in mm; poses, ranges and the model's angles (with
their deviations and standard deviations) in deg; angular errors, backlash and noise in mrad. SI is used in
files for programs, and where an operator copies a value to arm.toml or to a command that takes rad or m.
"""

import argparse
import dataclasses
import datetime
import math
import re
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from calib.arm_problem.arm_model import Bounds
from calib.arm_problem.observations import Frame
from calib.boards import read_boards
from calib.errors import CalibrationError
from calib.history import FORMAT, Entry, GeometryRecord, Quantity, append_entry, measured_at, require_appendable
from control.errors import ArmError

UNITS = {"m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}, "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0}}
MOST_NOISE_rad = 0.05


def quantity(text: str, unit: str, what: str) -> float:
    """Parse a number with a unit of the same kind as `unit` ("m" or "rad"), converted to it; ArmError if invalid.

    A number without a unit is refused: 8 may be meant in millimetres and read in metres.
    """
    match = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([a-z]+)\s*", text)
    factor = UNITS[unit].get(match[2]) if match else None
    try:
        value = float(match[1]) * factor if match and factor is not None else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        comma = "; write a decimal point, not a comma" if "," in text else ""
        raise ArmError(f'{what}: expected a number with one of the units {", ".join(UNITS[unit])}, got "{text}"{comma}')
    return value


def length_m(text: str | None, option: str) -> float | None:
    """The length that an option gives, None if it was not given; ArmError if it is not above 0."""
    if text is None:
        return None
    found_m = quantity(text, "m", option)
    if found_m <= 0.0:
        raise ArmError(f"{option}: expected a length above 0, got {text}")
    return found_m


def orientation_noise_rad(text: str | None) -> float | None:
    """The angle of --orientation-noise, None if it was not given; ArmError if invalid."""
    if text is None:
        return None
    value = quantity(text, "rad", "--orientation-noise")
    if not 0.0 < value <= MOST_NOISE_rad:
        raise ArmError(f"--orientation-noise: expected an angle above 0, up to {MOST_NOISE_rad} rad, got {text}")
    return value


def unit_of(name: str) -> str:
    """Unit of a geometric parameter by its name: angles are theta, alpha and turns about an axis."""
    return "rad" if re.match(r"(theta|alpha)\d", name) or re.search(r"_r[xyz]$", name) else "m"


FARTHEST_m = 20.0  # of a wire's fixed point


def names_in(texts: list[str]) -> list[str]:
    """Names of a repeatable option whose values are separated by commas."""
    return [name.strip() for text in texts for name in text.split(",") if name.strip()]


def bounds_of(texts: list[str]) -> Bounds:
    """`lengths=5mm`, `angles=2deg`, or a parameter by name."""
    general: dict[str, float] = {}
    by_name: dict[str, float] = {}
    for text in names_in(texts):
        name, _, value = text.partition("=")
        if not value:
            raise CalibrationError(f'--bound: expected NAME=VALUE such as L2=8mm or angles=3deg, got "{text}"')
        if name in ("lengths", "angles"):
            unit = "m" if name == "lengths" else "rad"
            general["length_m" if name == "lengths" else "angle_rad"] = quantity(value, unit, f"--bound {name}")
        else:
            by_name[name] = quantity(value, unit_of(name), f"--bound {name}")
    return Bounds(own=by_name, **general)


def wires_at(texts: list[str]) -> dict[str, tuple[float, float, float]]:
    """Fixed points of wires [m] by their names."""
    points_m = {}
    for text in texts:
        name, _, place = text.partition("=")
        try:
            x, y, z = (float(value) for value in place.split(","))
        except ValueError:
            x = y = z = math.nan
        if not name or not math.hypot(x, y, z) <= FARTHEST_m:
            raise CalibrationError(f'--wire-at: expected NAME=X,Y,Z in m, such as A=0.9,-0.5,0.1, got "{text}"')
        points_m[name] = (x, y, z)
    return points_m


def board_frames(file: str | None) -> dict[str, Frame]:
    """Board poses by setup from boards.json of `armwright register`; none without a file."""
    if file is None:
        return {}
    return {setup: Frame(f"table_{setup}", board.rotation, board.origin_m) for setup, board in read_boards(Path(file)).items()}


@dataclasses.dataclass(frozen=True, slots=True)
class HistoryRecord:
    """Where and when; asked for and checked before anything is computed."""

    path: Path
    measured: datetime.datetime
    by: str
    arm: str

    def append(
        self, inputs: Mapping[str, str], geometry: GeometryRecord | None = None, quantities: Mapping[str, Quantity] | None = None
    ) -> None:
        """Write the line, after the command's own results."""
        program = f"armwright {version('armwright')}"
        append_entry(
            self.path, Entry(FORMAT, self.measured, self.by, self.arm, program, dict(inputs), geometry, dict(quantities or {}))
        )


def record_of(args: argparse.Namespace, by: str, arm: str) -> HistoryRecord | None:
    """None without --history; CalibrationError if the record cannot be continued."""
    if args.history is None:
        if args.measured is not None:
            raise CalibrationError("--measured: needs --history, the record that the date is for")
        return None
    record = HistoryRecord(Path(args.history), measured_at(args.measured), by, arm)
    require_appendable(record.path, arm)
    return record
