"""points.csv: static poses in the interchange format.

Required columns: setup, point, repeat, q1_rad ... qn_rad. Optional: t_s, payload_kg, dir1 ..., i1_A ..., x_m, y_m, z_m
(empty where nothing was measured), beside them qw, qx, qy, qz, and covariances of both. Other columns are kept as text and
warned about.
Comma-separated, .csv or .csv.gz.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import re
import sys
import zlib
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TextIO

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.errors import PointsFileError
from calib.points.covariance import COVARIANCE, POSITION, TURN, is_covariance
from control.errors import BadTarget
from control.files import open_file
from control.kinematics.rotation import checked_quaternion

REQUIRED = ("setup", "point", "repeat")
TIP = ("x_m", "y_m", "z_m")
ORIENTATION = ("qw", "qx", "qy", "qz")
SCALARS = ("t_s", "payload_kg")
OWN_EXTRAS = re.compile(
    r"q\d+_sd_rad|temperature\d+_C|approach|take|frame|distance_(of|m|sd_m)"
)  # added by our own sessions; kept like any other column, without a warning
# In the column `frame`: positions and orientations are in a frame of unknown place, of a camera (files of
# `armwright camera`), or of the arm's [camera.stream], which a calibration then places.
CAMERA_FRAME, STREAM_FRAME = OWN_FRAMES = ("camera", "stream")
POINTS_MOST = 1_000_000  # poses, which take 1.5 GB to calibrate; calibrations have hundreds


@dataclass(frozen=True, slots=True)
class Points:
    """m static poses of an arm with n joints; arrays are read-only.

    q_rad (m, n) from the encoders; tip_m (m, 3) in the base frame, NaN where not measured; direction (m, n)
    sign of each joint's last motion, 0 unknown; current_A (m, n), t_s (m,), payload_kg (m,): NaN where
    unknown. orientation (m, 4): unit quaternion w, x, y, z of the measured target in the same frame as tip_m, NaN where not
    measured. covariance (m, 12): of the position and of the orientation, upper triangles as in calib.points.covariance, NaN where
    unknown. `extra` holds columns beyond the format, as text.
    """

    setup: tuple[str, ...]
    point: tuple[str, ...]
    repeat: tuple[int, ...]
    q_rad: Array
    tip_m: Array
    direction: Array
    current_A: Array
    t_s: Array
    payload_kg: Array
    extra: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: MappingProxyType({}))
    orientation: Array = field(default_factory=lambda: frozen(np.zeros((0, 4))))  # empty: none was measured
    covariance: Array = field(default_factory=lambda: frozen(np.zeros((0, 12))))  # empty: none is known

    def __post_init__(self) -> None:
        """Without any orientation or covariance, a row of NaN for each pose."""
        for name, width in (("orientation", 4), ("covariance", 12)):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, _known(None, (len(self.setup), width)))

    def __len__(self) -> int:
        """Number of poses."""
        return len(self.setup)

    @property
    def joint_count(self) -> int:
        """N."""
        return int(self.q_rad.shape[1])

    @property
    def in_camera_frame(self) -> bool:
        """Whether tips and orientations are in the frame of a camera, whose place is unknown."""
        return not {*OWN_FRAMES}.isdisjoint(self.extra.get("frame", ()))

    def chosen(self, rows: Sequence[int] | npt.NDArray[np.intp]) -> Points:
        """The poses of these rows, in this order."""
        k = [int(row) for row in rows]
        return make_points(
            [self.setup[i] for i in k],
            [self.point[i] for i in k],
            [self.repeat[i] for i in k],
            self.q_rad[k],
            self.tip_m[k],
            self.direction[k],
            self.current_A[k],
            self.t_s[k],
            self.payload_kg[k],
            {name: tuple(column[i] for i in k) for name, column in self.extra.items()},
            self.orientation[k],
            self.covariance[k],
        )


def make_points(
    setup: Sequence[str],
    point: Sequence[str],
    repeat: Sequence[int],
    q_rad: Array,
    tip_m: Array,
    direction: Array | None = None,
    current_A: Array | None = None,
    t_s: Array | None = None,
    payload_kg: Array | None = None,
    extra: Mapping[str, tuple[str, ...]] | None = None,
    orientation: Array | None = None,
    covariance: Array | None = None,
) -> Points:
    """Make points from arrays; missing values are NaN, missing directions 0."""
    m, n = np.shape(q_rad)
    return Points(
        tuple(setup),
        tuple(point),
        tuple(int(r) for r in repeat),
        frozen(q_rad),
        frozen(tip_m),
        frozen(np.zeros((m, n)) if direction is None else direction),
        _known(current_A, (m, n)),
        _known(t_s, (m,)),
        _known(payload_kg, (m,)),
        MappingProxyType(dict(extra or {})),
        _known(orientation, (m, 4)),
        _known(covariance, (m, 12)),
    )


def _known(values: npt.ArrayLike | None, shape: tuple[int, ...]) -> Array:
    """Read-only values; not a number, which then takes no memory, where none of them is known."""
    found = np.zeros(0) if values is None else np.asarray(values, dtype=np.float64)
    return np.broadcast_to(np.nan, shape) if np.isnan(found).all() else frozen(found)


def seen_again(keys: Iterable[object]) -> list[int]:
    """Positions of keys that probably occur again: only of these is a table needed, which takes half a kilobyte a key."""
    marks = np.fromiter((hash(key) for key in keys), dtype=np.int64)
    _, place, count = np.unique(marks, return_inverse=True, return_counts=True)
    return [int(row) for row in np.flatnonzero(count[place] > 1)]


def joined(parts: Sequence[Points]) -> Points:
    """Concatenate the poses of several files; columns beyond the format are kept if every file has them."""
    first, *others = parts
    if not others:
        return first
    shared = [name for name in first.extra if all(name in part.extra for part in others)]
    return make_points(
        [name for part in parts for name in part.setup],
        [name for part in parts for name in part.point],
        [number for part in parts for number in part.repeat],
        np.concatenate([part.q_rad for part in parts]),
        np.concatenate([part.tip_m for part in parts]),
        np.concatenate([part.direction for part in parts]),
        np.concatenate([part.current_A for part in parts]),
        np.concatenate([part.t_s for part in parts]),
        np.concatenate([part.payload_kg for part in parts]),
        {name: tuple(cell for part in parts for cell in part.extra[name]) for name in shared},
        np.concatenate([part.orientation for part in parts]),
        np.concatenate([part.covariance for part in parts]),
    )


def read_points(path: Path, joint_count: int | None = None) -> tuple[Points, tuple[str, ...]]:
    """Read the points of a file; also returns warnings. PointsFileError names file, line and column."""
    with opened_text(path) as file:
        reader = csv.reader(file)
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


@contextmanager
def opened_text(path: Path) -> Iterator[TextIO]:
    """Open the text of a .csv or .csv.gz; errors of the system or the file become a PointsFileError."""
    try:
        if path.name.endswith(".gz"):
            with open_file(path) as file, gzip.open(file, "rt", encoding="utf-8-sig", newline="") as packed:
                yield packed
        else:
            with open_file(path) as file, io.TextIOWrapper(file, "utf-8-sig", newline="") as plain:
                yield plain
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise PointsFileError(f"{path}: not a whole gzip file ({error})") from error
    except OSError as error:
        raise PointsFileError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise PointsFileError(
            f"{path}: byte {error.start} is not UTF-8 text: expected a .csv or .csv.gz"
        ) from error
    except csv.Error as error:
        raise PointsFileError(f"{path}: not comma-separated text ({error})") from error


def require_commas(path: Path, header: Sequence[str]) -> None:
    """PointsFileError for a header line that is not separated by commas."""
    for mark, name in ((";", "semicolons"), ("\t", "tabs"), ("|", "vertical bars")):
        if sum(cell.count(mark) for cell in header) > len(header):
            raise PointsFileError(
                f"{path}, line 1: the columns are separated by {name}, expected commas (and decimal points in numbers): save"
                " the file as comma-separated text"
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
        if math.isinf(value) or (is_required and math.isnan(value)):
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
