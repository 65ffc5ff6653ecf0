"""log.csv: time series of an arm, read strictly by the declaration of its columns.

Runs are separate recordings, each from rest. Columns that the format does not know are kept as text and warned about.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.errors import CalibrationError
from calib.points.points import IMPORT, Points
from control.model.arm import Arm, Drive
from control.tables import SAMPLES_MOST, ColumnGroup, TableColumn, TableFormat, read_table

TIP = ("x_m", "y_m", "z_m")
JOINTS = {"q_rad": "q{}_rad", "q_set_rad": "q{}_set_rad", "current_A": "i{}_A", "voltage_V": "u{}_V"}
LOG = TableFormat(
    "sample",
    (
        TableColumn("run", "name or number of the run", is_required=True, is_name=True, expected="a name or number"),
        TableColumn("t_s", "time", is_required=True),
        TableColumn("q{}_rad", "encoder angles, through nominal ratio and zero", is_required=True),
        TableColumn("q{}_set_rad", "set-points"),
        TableColumn("i{}_A", "motor current; `gap --current-unit` reads other units"),
        TableColumn("u{}_V", "commanded motor voltage; empty: driver off, open circuit"),
        TableColumn("payload_kg", "mass at the tip, not below 0", lower=0.0, expected="a mass not below 0"),
        *(TableColumn(name, "measured tip, base frame; empty between camera frames") for name in TIP),
    ),
    groups=(ColumnGroup(TIP),),
    unknown="kept",
    unwarned=r"lead\d+_rad",  # calib.gap.leads
    most_rows=SAMPLES_MOST,
    separated=IMPORT,
)
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
        indices = np.arange(len(self))[rows].tolist()
        return replace(
            self,
            name=name or self.name,
            t_s=frozen(self.t_s[rows]),
            q_rad=frozen(self.q_rad[rows]),
            q_set_rad=frozen(self.q_set_rad[rows]),
            current_A=frozen(self.current_A[rows]),
            voltage_V=frozen(self.voltage_V[rows]),
            payload_kg=frozen(self.payload_kg[rows]),
            tip_m=frozen(self.tip_m[rows]),
            extra=MappingProxyType({column: tuple(texts[k] for k in indices) for column, texts in self.extra.items()}),
        )

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
    first_rad, second_rad = first.q_set_rad, second.q_set_rad
    if np.isnan(first_rad).any() or np.isnan(second_rad).any():
        return False
    here, there = first.t_s - first.t_s[0], second.t_s - second.t_s[0]
    period_s = length_s / max(len(first) - 1, 1)
    if np.abs(here[:shared] - there[:shared]).max() < 0.5 * period_s:
        return bool(np.all(np.abs(first_rad[:shared] - second_rad[:shared]) <= SAME_RAD))
    within = here <= there[-1]
    at_here = np.stack([np.interp(here, there, column) for column in second_rad.T], axis=1)
    steps = np.pad(np.abs(np.diff(first_rad, axis=0)), ((2, 2), (0, 0)), mode="edge")
    moved = np.max([steps[k : k + len(first_rad)] for k in range(4)], axis=0)
    return bool(np.all((np.abs(first_rad - at_here) <= SAME_RAD + moved)[within]))


def read_log(path: Path, joint_count: int | None = None) -> tuple[Log, tuple[str, ...]]:
    """The runs of a file and warnings about it. LogFileError names file, line and column."""
    table = read_table(path, LOG, LogFileError, joint_count)
    names, t_s = table.words("run"), table.number("t_s")
    begins = [0, *(k for k in range(1, len(table)) if names[k] != names[k - 1]), len(table)]
    runs = dict[str, slice]()
    for begin, end in itertools.pairwise(begins):
        name, rows = names[begin], slice(begin, end)
        if name in runs:
            raise table.bad_cell(begin, "run", name, "each run in one piece: this one ended before another")
        if len(backwards := np.flatnonzero(np.diff(t_s[rows]) <= 0.0)):
            last, row = t_s[begin + backwards[0]], begin + int(backwards[0]) + 1
            raise table.bad_cell(row, "t_s", f"{t_s[row]:g}", f"a time after {last:g}")
        runs[name] = rows
    values = {
        "t_s": t_s,
        **{key: table.joints(form) for key, form in JOINTS.items()},
        "payload_kg": np.nan_to_num(table.number("payload_kg")),
        "tip_m": table.numbers(*TIP),
    }
    for array in values.values():
        array.flags.writeable = False  # so that runs can be views of it: a log takes gigabytes
    extra = {name: table.words(name) for name in table.unknown}
    return Log(
        tuple(
            LoggedRun(
                name,
                **{key: array[rows] for key, array in values.items()},
                extra=MappingProxyType({key: tuple(texts[rows]) for key, texts in extra.items()}),
                is_commanded="u1_V" in table,
            )
            for name, rows in runs.items()
        ),
        (str(path),),
    ), table.warnings


def joined_logs(logs: tuple[Log, ...]) -> Log:
    """The runs of several files as one log."""
    return Log(tuple(run for log in logs for run in log.runs), tuple(s for log in logs for s in log.sources))


# What --current-unit accepts, and what it means in words.
UNITS: Final = MappingProxyType(
    {
        "A": "amperes",
        "mA": "milliamperes",
        "percent": "percent of the drives' current limits",
        "Nm": "torques of the joints in N m",
        "motor_Nm": "torques of the motors in N m",
    }
)
AMPERES: Final = "A"
TORQUES: Final = "Nm"
FINE_COUNTS: Final = 1 << 24  # of an encoder that nobody described: the steps that the data show are coarser
IDEAL: Final = 1.0, FINE_COUNTS, 1.0, 1.0, 1e6  # of a drive


def amperes_per(arm: Arm, unit: str) -> Array:
    """Motor current of each joint for one of a unit, (n,); CalibrationError for a unit that is not known."""
    if unit not in UNITS:
        raise CalibrationError(f'--current-unit: expected one of {", ".join(UNITS)}, got "{unit}"')
    drives = [arm.drive(joint + 1) for joint in range(arm.joint_count)]
    per_motor_Nm = np.array([1.0 / drive.torque_constant_Nm_A for drive in drives])
    match unit:
        case "mA":
            return np.full(len(drives), 1e-3)
        case "percent":
            return np.array([drive.current_limit_A / 100.0 for drive in drives])
        case "Nm":
            return np.asarray(per_motor_Nm / np.array([drive.gear_ratio for drive in drives]))
        case "motor_Nm":
            return per_motor_Nm
        case _:
            return np.ones(len(drives))


def with_ideal_drives(arm: Arm) -> Arm:
    """The arm with a drive of one newton metre per ampere, without gear and rotor, on every joint that has none.

    For torques: what an arm's masses tell of them needs no motor.
    """
    has = {drive.joint: drive for drive in arm.drives}
    joints = range(1, arm.joint_count + 1)
    return dataclasses.replace(arm, drives=tuple(has.get(j) or Drive(j, *IDEAL) for j in joints))


def without_voltages(log: Log) -> Log:
    """The log without its voltages, which say nothing where motors are not known."""
    runs = tuple(dataclasses.replace(run, voltage_V=frozen(run.voltage_V * math.nan), is_commanded=False) for run in log.runs)
    return dataclasses.replace(log, runs=runs)


def points_in_amperes(arm: Arm, points: Points, unit: str) -> Points:
    """Poses whose columns i1_A ... are of another unit."""
    if unit == AMPERES:
        return points
    return dataclasses.replace(points, current_A=frozen(points.current_A * amperes_per(arm, unit)))


def log_in_amperes(arm: Arm, log: Log, unit: str) -> Log:
    """Time series whose columns i1_A ... are of another unit."""
    if unit == AMPERES:
        return log
    factor = amperes_per(arm, unit)
    runs = tuple(dataclasses.replace(run, current_A=frozen(run.current_A * factor)) for run in log.runs)
    return dataclasses.replace(log, runs=runs)
