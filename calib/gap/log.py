"""log.csv: time series of an arm, read strictly as the interchange format says.

Required columns: run, t_s, q1_rad ... qn_rad. Optional: q1_set_rad ..., i1_A ..., u1_V ... (empty: driver off),
payload_kg, x_m, y_m, z_m (empty between camera frames). Other columns are kept as text and warned about.
Comma-separated, .csv or .csv.gz. Runs are separate recordings, each from rest.
"""

from __future__ import annotations

import itertools
import math
import re
import sys
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.errors import CalibrationError, PointsFileError
from calib.points.reading import require_commas
from control.tables import SAMPLES_MOST, opened_rows

REQUIRED = ("run", "t_s")
TIP = ("x_m", "y_m", "z_m")
SAME_RAD = 1e-6  # set-points that are printed with six digits and differ by less are the same


class LogFileError(CalibrationError):
    """log.csv does not follow its format; the message names file, line and column."""


@dataclass(frozen=True, slots=True)
class LoggedRun:
    """One recording of m samples of n joints; arrays are read-only, NaN where the file has nothing.

    t_s (m,); q_rad, q_set_rad, current_A, voltage_V (m, n); payload_kg (m,), 0 where the file has no such column;
    tip_m (m, 3) in the base frame. `extra` holds columns that the format does not know, as text. `is_commanded`: the voltages
    are recorded, and where there is none the driver is off.
    """

    name: str
    t_s: Array
    q_rad: Array
    q_set_rad: Array
    current_A: Array
    voltage_V: Array
    payload_kg: Array
    tip_m: Array
    extra: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: MappingProxyType({}))
    is_commanded: bool = False

    def __len__(self) -> int:
        """How many samples."""
        return len(self.t_s)

    def rows(self, rows: slice | npt.NDArray[np.intp], name: str = "") -> LoggedRun:
        """Some of its samples, under another name if one is given."""
        kept = np.arange(len(self))[rows].tolist()
        return replace(
            self,
            name=name or self.name,
            t_s=frozen(self.t_s[rows]), q_rad=frozen(self.q_rad[rows]), q_set_rad=frozen(self.q_set_rad[rows]),
            current_A=frozen(self.current_A[rows]), voltage_V=frozen(self.voltage_V[rows]),
            payload_kg=frozen(self.payload_kg[rows]), tip_m=frozen(self.tip_m[rows]),
            extra=MappingProxyType({column: tuple(texts[k] for k in kept) for column, texts in self.extra.items()}),
        )  # fmt: skip

    @property
    def payload(self) -> float:
        """The payload of the whole run [kg]."""
        return float(np.median(self.payload_kg))


@dataclass(frozen=True, slots=True)
class Log:
    """The runs of one or more files, in the files' order."""

    runs: tuple[LoggedRun, ...]
    sources: tuple[str, ...] = ()

    @property
    def joint_count(self) -> int:
        """N."""
        return int(self.runs[0].q_rad.shape[1])

    def repeats(self) -> tuple[tuple[int, ...], ...]:
        """Groups of indices into `runs`: runs with the same set-points and payload stand together."""
        groups: list[list[int]] = []
        for k, run in enumerate(self.runs):
            for group in groups:
                if is_repeat(self.runs[group[0]], run):
                    group.append(k)
                    break
            else:
                groups.append([k])
        return tuple(tuple(group) for group in groups)


def is_repeat(first: LoggedRun, second: LoggedRun) -> bool:
    """Whether two runs were asked to do the same with the same load; runs without set-points never are.

    Runs of an irregular clock have no times in common, and begin within a sample of each other: theirs may differ by what they
    move there in a sample.
    """
    length_s = float(first.t_s[-1] - first.t_s[0])
    apart_s = abs(float(second.t_s[-1] - second.t_s[0]) - length_s)
    if apart_s > 0.02 * length_s or not abs(first.payload - second.payload) < 1e-6:
        return False
    shared = min(len(first), len(second))
    one, other = first.q_set_rad, second.q_set_rad
    if np.isnan(one).any() or np.isnan(other).any():
        return False
    here, there = first.t_s - first.t_s[0], second.t_s - second.t_s[0]
    period_s = length_s / max(len(first) - 1, 1)
    if np.abs(here[:shared] - there[:shared]).max() < 0.5 * period_s:
        return bool(np.all(np.abs(one[:shared] - other[:shared]) <= SAME_RAD))
    within = here <= there[-1]
    at_here = np.stack([np.interp(here, there, column) for column in other.T], axis=1)
    steps = np.pad(np.abs(np.diff(one, axis=0)), ((2, 2), (0, 0)), mode="edge")
    moved = np.max([steps[k : k + len(one)] for k in range(4)], axis=0)
    return bool(np.all((np.abs(one - at_here) <= SAME_RAD + moved)[within]))


def read_log(path: Path, joint_count: int | None = None) -> tuple[Log, tuple[str, ...]]:
    """The runs of a file and warnings about it. LogFileError names file, line and column."""
    try:
        with opened_rows(path, LogFileError, SAMPLES_MOST) as reader:
            table = _Table(path, next(reader, []), joint_count)
            for row in reader:
                if row:
                    table.add(row, reader.line_num)
    except PointsFileError as error:  # of its header
        raise LogFileError(str(error)) from error
    if not table.names:
        raise LogFileError(f"{path}: a header and no samples: expected one line per sample")
    return Log(table.runs(), (str(path),)), table.warnings()


def joined_logs(logs: tuple[Log, ...]) -> Log:
    """The runs of several files as one log."""
    return Log(tuple(run for log in logs for run in log.runs), tuple(s for log in logs for s in log.sources))


def _each(n: int, form: str) -> tuple[str, ...]:
    return tuple(form.format(joint) for joint in range(1, n + 1))


class _Table:
    """Rows as they are read, in compact arrays."""

    def __init__(self, path: Path, header: list[str], joint_count: int | None) -> None:
        self._path = path
        self._header = tuple(name.strip() for name in header)
        self._n = self._checked_header(joint_count)
        groups = [_each(self._n, form) for form in ("q{}_rad", "q{}_set_rad", "i{}_A", "u{}_V")]
        numeric = ("t_s", "payload_kg", *TIP, *(name for group in groups for name in group))
        self._place = {name: k for k, name in enumerate(self._header)}
        self._never_empty = {"t_s", *groups[0]}
        self._columns = {name: array("d") for name in self._header if name in numeric}
        self._extra: dict[str, list[str]] = {
            name: [] for name in self._header if name != "run" and name not in numeric
        }
        self.names: list[str] = []
        self._ended: set[str] = set()

    def _checked_header(self, joint_count: int | None) -> int:
        names = self._header
        require_commas(self._path, names)
        for k, name in enumerate(names):
            if name in names[:k]:
                raise LogFileError(f"{self._path}, line 1: column {name} appears twice")
        n = sum(re.fullmatch(r"q\d+_rad", name) is not None for name in names)
        wanted = joint_count or n
        for name in (*REQUIRED, *_each(wanted or 1, "q{}_rad")):
            if name not in names:
                raise LogFileError(f"{self._path}, line 1: required column {name} is missing")
        if n != wanted:
            raise LogFileError(
                f"{self._path}, line 1: joint angles of {n} joints, expected {wanted} (q1_rad to q{wanted}_rad)"
            )
        for group in (TIP, *(_each(n, form) for form in ("q{}_set_rad", "i{}_A", "u{}_V"))):
            present = [name for name in group if name in names]
            if present and len(present) < len(group):
                absent = next(name for name in group if name not in present)
                raise LogFileError(f"{self._path}, line 1: column {absent} is missing beside {present[0]}")
        for name in names:
            match = re.fullmatch(r"q(\d+)_set_rad|i(\d+)_A|u(\d+)_V", name)
            if match and int(next(text for text in match.groups() if text)) not in range(1, n + 1):
                raise LogFileError(f"{self._path}, line 1: column {name} belongs to no joint: there are {n}")
        return n

    def add(self, row: list[str], line: int) -> None:
        """One line of the file."""
        if len(row) != len(self._header):
            raise LogFileError(
                f"{self._path}, line {line}: {len(row)} values, line 1 names {len(self._header)}"
            )
        name = row[self._place["run"]].strip()
        if not name:
            raise LogFileError(f"{self._path}, line {line}: run: expected a name or number, got nothing")
        begins = not self.names or name != self.names[-1]
        if begins and name in self._ended:
            raise LogFileError(
                f"{self._path}, line {line}: run {name} again after another run: expected each run in one piece"
            )
        for column, values in self._columns.items():
            values.append(self._number(row[self._place[column]], line, column))
        for column, texts in self._extra.items():
            texts.append(sys.intern(row[self._place[column]].strip()))  # most are alike
        times = self._columns["t_s"]
        if not begins and times[-1] <= times[-2]:
            raise LogFileError(
                f"{self._path}, line {line}: t_s: expected a time after {times[-2]:g}, got {times[-1]:g}"
            )
        seen = sum(not math.isnan(self._columns[name][-1]) for name in TIP if name in self._columns)
        if seen not in (0, 3):
            raise LogFileError(
                f"{self._path}, line {line}: x_m, y_m, z_m: expected all three or none, got {seen}"
            )
        self.names.append(sys.intern(name))
        self._ended.add(name)

    def _number(self, text: str, line: int, column: str) -> float:
        text = text.strip()
        if not text and column not in self._never_empty:
            return math.nan
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            got = f'"{text}"' if text else "nothing"
            raise LogFileError(f"{self._path}, line {line}: {column}: expected a finite number, got {got}")
        if column == "payload_kg" and value < 0.0:
            raise LogFileError(
                f"{self._path}, line {line}: payload_kg: expected a mass not below 0, got {text}"
            )
        return value

    def warnings(self) -> tuple[str, ...]:
        """One sentence about columns that the format does not know, if there are any."""
        names = ", ".join(self._extra)
        return (f"{self._path}: unknown columns ignored: {names}",) if names else ()

    def runs(self) -> tuple[LoggedRun, ...]:
        """The runs in the file's order."""
        changes = enumerate(itertools.pairwise(self.names), 1)
        begins = [0, *(k for k, (before, name) in changes if name != before), len(self.names)]
        return tuple(self._run(slice(a, b)) for a, b in itertools.pairwise(begins))

    def _run(self, rows: slice) -> LoggedRun:
        count = rows.stop - rows.start

        def column(name: str, absent: float = math.nan) -> Array:
            values = self._columns.get(name)
            return np.full(count, absent) if values is None else np.array(values[rows])

        def group(form: str) -> Array:
            return frozen(np.stack([column(name) for name in _each(self._n, form)], axis=1))

        return LoggedRun(
            self.names[rows.start],
            frozen(column("t_s")),
            group("q{}_rad"),
            group("q{}_set_rad"),
            group("i{}_A"),
            group("u{}_V"),
            frozen(np.nan_to_num(column("payload_kg", 0.0))),
            frozen(np.stack([column(name) for name in TIP], axis=1)),
            MappingProxyType({name: tuple(texts[rows]) for name, texts in self._extra.items()}),
            "u1_V" in self._columns,
        )
