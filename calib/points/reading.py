"""Reading points.csv: every line is checked, and an error names file, line and column."""

from __future__ import annotations

import math
import re
import sys
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.errors import PointsFileError
from calib.points.covariance import COVARIANCE, POSITION, TURN, is_covariance
from calib.points.points import ORIENTATION, REQUIRED, SCALARS, TIP, Points, make_points
from control.errors import BadTarget
from control.kinematics.rotation import checked_quaternion
from control.tables import opened_rows

OWN_EXTRAS = re.compile(
    r"q\d+_sd_rad|temperature\d+_C|approach|take|frame|distance_(of|m|sd_m)|[xyz]_set_m"
)  # added by our own sessions; kept like any other column, without a warning
LARGEST = 1e18  # of any value; beyond it squares overflow, and no unit of any column gets near
POINTS_MOST = 1_000_000  # poses, which take 0.7 GB to calibrate; calibrations have hundreds


def read_points(path: Path, joint_count: int | None = None) -> tuple[Points, tuple[str, ...]]:
    """Read the points of a file; also returns warnings. PointsFileError names file, line and column."""
    with opened_rows(path, PointsFileError, POINTS_MOST + 1) as reader:
        columns = _Columns.of(path, next(reader, []), joint_count)
        table = _Table(path, columns)
        for row in reader:
            if row:
                table.add(row, reader.line_num)
            if len(table.repeat) > POINTS_MOST:
                raise PointsFileError(
                    f"{path}: more than {POINTS_MOST} points: expected static poses, one line each; a time series is a log.csv"
                )
    if not table.repeat:
        raise PointsFileError(f"{path}: a header and no points: expected one line per point")
    return table.points(), columns.warnings(path)


def require_commas(path: Path, header: Sequence[str]) -> None:
    """PointsFileError for a header line that is not separated by commas."""
    for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "vertical bars")):
        if sum(cell.count(mark) for cell in header) > len(header):
            raise PointsFileError(
                f"{path}, line 1: the columns are separated by {name}, expected commas (and decimal points in numbers):"
                " `armwright import-points` reads it and makes a points.csv"
            )


@dataclass(frozen=True, slots=True)
class _Columns:
    """Index of each column in a row."""

    names: tuple[str, ...]
    joint_count: int

    @classmethod
    def of(cls, path: Path, header: list[str], joint_count: int | None) -> _Columns:
        """Parse the header line; PointsFileError for missing or duplicate columns."""
        names = tuple(name.strip() for name in header)
        require_commas(path, names)
        _require_unique(path, names)
        n = sum(re.fullmatch(r"q\d+_rad", name) is not None for name in names)
        wanted = joint_count or n
        missing = [name for name in (*REQUIRED, *_each(wanted or 1, "q{}_rad")) if name not in names]
        if missing:
            raise PointsFileError(f"{path}, line 1: required column {missing[0]} is missing")
        if n != wanted:
            raise PointsFileError(
                f"{path}, line 1: joint angles of {n} joints, expected {wanted} (q1_rad to q{wanted}_rad)"
            )
        _require_whole_groups(path, names, n)
        return cls(names, n)

    def warnings(self, path: Path) -> tuple[str, ...]:
        """One sentence about unknown columns, if there are any."""
        strange = [name for name in self.extra if not OWN_EXTRAS.fullmatch(name)]
        return (f"{path}: unknown columns ignored: {', '.join(strange)}",) if strange else ()

    @property
    def extra(self) -> tuple[str, ...]:
        """Columns beyond the format."""
        known = {*REQUIRED, *SCALARS, *TIP, *ORIENTATION, *COVARIANCE}
        known.update(_joint_columns(self.joint_count))
        return tuple(name for name in self.names if name not in known)


def _joint_columns(n: int) -> tuple[str, ...]:
    """Columns of angles, directions and currents."""
    return tuple(name for form in ("q{}_rad", "dir{}", "i{}_A") for name in _each(n, form))


def _each(n: int, form: str) -> tuple[str, ...]:
    """Column names of joints 1 .. n."""
    return tuple(form.format(joint) for joint in range(1, n + 1))


def _require_unique(path: Path, names: tuple[str, ...]) -> None:
    for k, name in enumerate(names):
        if name in names[:k]:
            raise PointsFileError(f"{path}, line 1: column {name} appears twice")


def _require_whole_groups(path: Path, names: tuple[str, ...], n: int) -> None:
    """Require x, y, z together, and the quaternion; directions and currents of every joint or of none."""
    if ORIENTATION[0] in names and TIP[0] not in names:
        raise PointsFileError(f"{path}, line 1: columns {', '.join(TIP)} are missing beside {ORIENTATION[0]}")
    for covariance, measured in ((POSITION, TIP), (TURN, ORIENTATION)):
        if covariance[0] in names and measured[0] not in names:
            raise PointsFileError(
                f"{path}, line 1: columns {', '.join(measured)} are missing beside {covariance[0]}"
            )
    for group in (TIP, ORIENTATION, POSITION, TURN, _each(n, "dir{}"), _each(n, "i{}_A")):
        present = [name for name in group if name in names]
        if present and len(present) < len(group):
            absent = next(name for name in group if name not in present)
            raise PointsFileError(f"{path}, line 1: column {absent} is missing beside {present[0]}")
    for name in names:
        match = re.fullmatch(r"dir(\d+)|i(\d+)_A", name)
        if match and int(match[1] or match[2]) not in range(1, n + 1):
            raise PointsFileError(
                f"{path}, line 1: column {name} belongs to no joint: there are {n} (q1_rad to q{n}_rad)"
            )


class _Table:
    """Rows in compact arrays, so that 100,000 points fit in little memory."""

    def __init__(self, path: Path, columns: _Columns) -> None:
        self._path, self._columns = path, columns
        n = columns.joint_count
        self._numeric = {
            name: (place, array("d"), name in _each(n, "q{}_rad"))
            for place, name in enumerate(columns.names)
            if name in (*SCALARS, *TIP, *ORIENTATION, *COVARIANCE, *_joint_columns(n))
        }
        self._text: dict[str, list[str]] = {name: [] for name in ("setup", "point", *columns.extra)}
        self.repeat: list[int] = []
        self._place = {name: place for place, name in enumerate(columns.names)}

    def add(self, row: list[str], line: int) -> None:
        """Add a line of the file."""
        if len(row) != len(self._columns.names):
            raise PointsFileError(
                f"{self._path}, line {line}: {len(row)} values, line 1 names {len(self._columns.names)}"
            )
        for name, texts in self._text.items():
            cell = row[self._place[name]].strip()
            texts.append(cell if name == "point" else sys.intern(cell))  # most are alike
        for name in ("setup", "point"):
            if not self._text[name][-1]:
                raise self._bad(line, name, "", "a name")
        self.repeat.append(self._integer(row[self._place["repeat"]], line))
        for name, (place, column, is_required) in self._numeric.items():
            column.append(self._number(row[place], line, name, is_required))
        self._require_sound(line)

    def _integer(self, text: str, line: int) -> int:
        try:
            return int(text)
        except ValueError:
            raise self._bad(line, "repeat", text, "a whole number") from None

    def _number(self, text: str, line: int, name: str, is_required: bool) -> float:
        """A finite number; NaN for an empty cell or `nan` where the column is optional."""
        try:
            value = float(text) if text.strip() else math.nan
        except ValueError:
            raise self._bad(line, name, text, "a number") from None
        if abs(value) > LARGEST or (is_required and math.isnan(value)):
            raise self._bad(line, name, text, "a finite number")
        return value

    def _require_sound(self, line: int) -> None:
        """Require that a tip has three coordinates or none, an orientation has length 1, and a direction is a sign."""
        if "x_m" in self._numeric:
            unknown = [name for name in TIP if math.isnan(self._numeric[name][1][-1])]
            if 0 < len(unknown) < 3:
                raise self._bad(line, unknown[0], "", "a number, since the other coordinates are given")
        if ORIENTATION[0] in self._numeric:
            self._require_quaternion(line)
        for group, measured in ((POSITION, TIP), (TURN, ORIENTATION)):
            if group[0] in self._numeric:
                self._require_covariance(line, group, measured)
        for name in _each(self._columns.joint_count, "dir{}"):
            if name in self._numeric and self._numeric[name][1][-1] not in (-1.0, 0.0, 1.0):
                value = self._numeric[name][1]
                if not math.isnan(value[-1]):
                    raise self._bad(line, name, f"{value[-1]:g}", "-1, 0 or 1")
                value[-1] = 0.0

    def _require_quaternion(self, line: int) -> None:
        """Require four numbers or none, a tip beside them, and length 1; they are scaled to it."""
        columns = [self._numeric[name][1] for name in ORIENTATION]
        values = [column[-1] for column in columns]
        missing = [name for name, value in zip(ORIENTATION, values, strict=True) if math.isnan(value)]
        if len(missing) == 4:
            return
        if missing:
            raise self._bad(line, missing[0], "", "a number, since the rest of the quaternion is given")
        if math.isnan(self._numeric[TIP[0]][1][-1]):
            raise self._bad(line, TIP[0], "", "a number, since an orientation was measured there")
        try:
            unit = checked_quaternion(values)
        except BadTarget as error:
            raise PointsFileError(f"{self._path}, line {line}: {error}") from None
        for column, value in zip(columns, unit, strict=True):
            column[-1] = value

    def _require_covariance(self, line: int, group: tuple[str, ...], measured: tuple[str, ...]) -> None:
        """Require six numbers or none, of a positive definite matrix, beside what they are the covariance of."""
        values = np.array([self._numeric[name][1][-1] for name in group])
        unknown = np.isnan(values)
        if unknown.all():
            return
        if unknown.any():
            raise self._bad(
                line,
                group[int(np.argmax(unknown))],
                "",
                "a number, since the others of the covariance are given",
            )
        if math.isnan(self._numeric[measured[0]][1][-1]):
            raise self._bad(line, measured[0], "", "a number, since its covariance is given")
        if not is_covariance(values):
            numbers = ", ".join(f"{value:.3g}" for value in values)
            raise PointsFileError(
                f"{self._path}, line {line}: {group[0]} to {group[-1]}: expected a positive definite covariance, got {numbers}"
            )

    def _bad(self, line: int, name: str, text: str, expected: str) -> PointsFileError:
        got = f'"{text.strip()}"' if text.strip() else "an empty cell"
        return PointsFileError(f"{self._path}, line {line}, column {name}: got {got}, expected {expected}")

    def points(self) -> Points:
        """The points read."""
        n = self._columns.joint_count
        return make_points(
            self._text["setup"],
            self._text["point"],
            self.repeat,
            self._stacked(_each(n, "q{}_rad")),
            self._stacked(TIP),
            self._stacked(_each(n, "dir{}")) if "dir1" in self._numeric else None,
            self._stacked(_each(n, "i{}_A")),
            self._stacked(("t_s",))[:, 0],
            self._stacked(("payload_kg",))[:, 0],
            {name: tuple(self._text[name]) for name in self._columns.extra},
            self._stacked(ORIENTATION),
            self._stacked(COVARIANCE),
        )

    def _stacked(self, names: Sequence[str]) -> Array:
        """Columns side by side, (m, columns); NaN where the file has none."""
        absent = array("d", [math.nan]) * len(self.repeat)
        return np.column_stack(
            [np.array(self._numeric[n][1] if n in self._numeric else absent) for n in names]
        )
