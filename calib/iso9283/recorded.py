"""Reads recorded poses and runs for the criteria: points.csv and log.csv (docs/formats.md), and programme.json."""

from __future__ import annotations

import itertools
import math
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.assembly import Choice
from calib.arm_problem.checks import require_columns_meant, require_of_arm
from calib.arm_problem.frames import mean_rotation
from calib.arrays import Array, frozen
from calib.iso9283.criteria.checks import Iso9283Error
from calib.points.points import TIP, Points, make_points
from calib.points.reading import require_commas
from control.files import parsed_json, read_text
from control.kinematics.kinematics import Kinematics
from control.kinematics.rotation import logarithms, matrices
from control.model.arm import Arm
from control.tables import SAMPLES_MOST, opened_rows

SET = ("x_set_m", "y_set_m", "z_set_m")
ANGLES, ANGLES_SET, FORCE = (
    ("a_rad", "b_rad", "c_rad"),
    ("a_set_rad", "b_set_rad", "c_set_rad"),
    ("fx_N", "fy_N", "fz_N"),
)

TARGET_NOTE = "orientation: measured quaternions, with the target where it fits all commanded poses best"
CAMERA, ENCODERS = "camera", "encoders"
NO_LOG = "a recording of runs (--log with log.csv): "
STILL_m = 1e-9  # between two rows: a smaller change of the set-point is rest


@dataclass(frozen=True, slots=True)
class PoseGroup:
    """One pose of one programme: commanded (3,), attained (n, 3) in order of time, base frame, m.

    t_s (n,), force_N (n, 3) of the load at the tip; angle_set_rad (3,) and angle_rad (n, 3) if the orientation
    was measured. `unseen`: number of visits without a measured tip.
    """

    setup: str
    point: str
    commanded_m: Array
    attained_m: Array
    t_s: Array
    force_N: Array
    unseen: int = 0
    angle_set_rad: Array | None = None
    angle_rad: Array | None = None


@dataclass(frozen=True, slots=True)
class Run:
    """One run: commanded tip set_m (k, 3) and encoder_m (k, 3), both by the arm's model, at time_s (k,).

    seen_m (s, 3) at seen_s (s,) by the camera. `programme` is empty and speed_m_s NaN if the file does not give them.
    """

    number: int
    programme: str
    cycle: int
    speed_m_s: float
    time_s: Array
    set_m: Array
    encoder_m: Array
    seen_s: Array
    seen_m: Array

    @property
    def is_moving(self) -> bool:
        """Whether the set-point moves at all."""
        return bool(self._moving.any())

    @property
    def _moving(self) -> npt.NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(np.diff(self.set_m, axis=0), axis=1) >= STILL_m)

    def measured(self, source: str) -> tuple[Array, Array]:
        """Times (k,) and positions (k, 3) by CAMERA or ENCODERS; Iso9283Error with too few camera frames."""
        if source == ENCODERS:
            return self.time_s, self.encoder_m
        if len(self.seen_m) < 3:
            raise Iso9283Error("a measured tip (x_m, y_m, z_m, by a camera)")
        return self.seen_s, self.seen_m

    @property
    def moving_s(self) -> tuple[float, float]:
        """Start and end of the set-point's motion."""
        moving = np.flatnonzero(self._moving)
        if not len(moving):
            raise Iso9283Error(f"run {self.number}: the set-point does not move")
        return float(self.time_s[moving[0]]), float(self.time_s[moving[-1] + 1])


def pose_groups(points: Points, arm: Arm, path: str) -> tuple[list[PoseGroup], tuple[str, ...]]:
    """Poses by setup and point, in order, and the source of the commanded positions as text.

    UnusablePointsError for points in other units or of another arm.
    """
    commanded, source = _commanded(points, arm, path)
    measured = np.flatnonzero(np.isfinite(points.tip_m).all(axis=1))
    is_checked = len(measured) > 0 and points.joint_count == arm.joint_count
    warnings = require_of_arm(arm, points.chosen(measured)) if is_checked else ()
    force = _columns(points, FORCE, path)
    if force is None:
        force = np.outer(np.nan_to_num(points.payload_kg), arm.gravity_m_s2)
    angle_set, angle = _columns(points, ANGLES_SET, path), _columns(points, ANGLES, path)
    if angle is None and points.joint_count == arm.joint_count:
        angle_set, angle = _turned(points, arm, path)
    turns = (TARGET_NOTE,) if angle is not None and ANGLES[0] not in points.extra else ()
    keys = list(zip(points.setup, points.point, strict=True))
    groups = []
    for key in dict.fromkeys(keys):
        rows = np.array([k for k, other in enumerate(keys) if other == key])
        seen = rows[np.isfinite(points.tip_m[rows]).all(axis=1)]
        turned = None if angle is None or angle_set is None else _angles_of(angle_set, angle, rows)
        groups.append(
            PoseGroup(
                *key,
                frozen(commanded[rows].mean(axis=0)),
                frozen(points.tip_m[seen]),
                frozen(points.t_s[seen]),
                frozen(force[seen]),
                len(rows) - len(seen),
                *(turned or (None, None)),
            )
        )
    return groups, (source, *turns, *warnings)


def _angles_of(angle_set: Array, angle: Array, rows: npt.NDArray[np.intp]) -> tuple[Array, Array] | None:
    """Commanded (3,) and attained (n, 3) angles of one pose; None if none was measured there."""
    seen = rows[np.isfinite(angle[rows]).all(axis=1)]
    return (angle_set[seen].mean(axis=0), angle[seen]) if len(seen) else None


def _turned(points: Points, arm: Arm, path: str) -> tuple[Array | None, Array | None]:
    """Angles (m, 3) about x, y, z of the base by which measured orientations are off the commanded ones, whose are 0.

    The target sits on the last link where it fits all poses best.
    """
    seen = np.flatnonzero(np.isfinite(points.orientation).all(axis=1))
    if not len(seen):
        return None, None
    q_rad, _ = _commanded_rad(points, arm, path)
    commanded = Kinematics(arm).link_transforms(q_rad[seen])[:, -1, :3, :3]
    measured = matrices(points.orientation[seen])
    target = mean_rotation(np.swapaxes(commanded, 1, 2) @ measured)
    angle = np.full((len(points), 3), np.nan)
    angle[seen] = logarithms(measured @ np.swapaxes(commanded @ target, 1, 2))
    return np.zeros_like(angle), angle


def _commanded(points: Points, arm: Arm, path: str) -> tuple[Array, str]:
    """Commanded positions (m, 3): from columns, or by forward kinematics of set-points or encoders."""
    given = _columns(points, SET, path)
    if given is not None:
        return given, "commanded positions: columns x_set_m, y_set_m, z_set_m"
    if points.joint_count != arm.joint_count:
        raise Iso9283Error(
            f"{path}: no commanded positions: columns {', '.join(SET)} are missing, and arm {arm.name} has {arm.joint_count}"
            f" joints, the file {points.joint_count}: add the columns, or give the right --arm"
        )
    q_rad, source = _commanded_rad(points, arm, path)
    return Kinematics(arm).tips(
        q_rad
    ), f"commanded positions: forward kinematics of arm {arm.name} at the {source}"


def _commanded_rad(points: Points, arm: Arm, path: str) -> tuple[Array, str]:
    """Commanded joint angles (m, n), and where they are from."""
    of_joints, of_encoders = (
        tuple(form.format(j) for j in range(1, arm.joint_count + 1))
        for form in ("joint{}_set_rad", "q{}_set_rad")
    )
    q_rad = _columns(points, of_joints, path)
    q_rad = _columns(points, of_encoders, path) if q_rad is None else q_rad
    return (points.q_rad, "encoder angles at rest") if q_rad is None else (q_rad, "set-points")


def _columns(points: Points, names: Sequence[str], path: str) -> Array | None:
    """Extra columns as numbers (m, len(names)); None unless all of them exist."""
    present = [name for name in names if name in points.extra]
    if not present:
        return None
    if len(present) < len(names):
        absent = next(name for name in names if name not in present)
        raise Iso9283Error(f"{path}, line 1: column {absent} is missing beside {present[0]}")
    return np.column_stack(
        [[_number(path, k, n, v) for k, v in enumerate(points.extra[n], 2)] for n in names]
    )


def _number(path: str, line: int, name: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise Iso9283Error(f'{path}, line {line}, column {name}: got "{value}", expected a finite number')
    return number


def read_runs(path: Path, arm: Arm, is_as_given: bool = False) -> list[Run]:
    """Every run of a log.csv or log.csv.gz; Iso9283Error names file, line and column.

    Rows without a set-point, such as during hand guiding, are omitted. `is_as_given`: its units are not doubted.
    """
    n, kinematics = arm.joint_count, Kinematics(arm)
    required = ["t_s", *(form.format(j) for form in ("q{}_rad", "q{}_set_rad") for j in range(1, n + 1))]
    joints = [
        "t_s",
        *(form.format(j) for form in ("joint{}_rad", "joint{}_set_rad") for j in range(1, n + 1)),
    ]
    runs: dict[str, _Rows] = {}
    for row in _rows(path, ("run", *required)):
        if row["run"] not in runs:
            # with gear or encoder effects in the model, the tip follows joint angles, not encoder angles
            names = joints if all(name in row for name in joints) else required
            runs[row["run"]] = _Rows(path, row, names, n)
        runs[row["run"]].add(row)
    whole = [rows.run(kinematics) for rows in runs.values() if rows.count > 1]
    recorded = (rows for rows in runs.values() if rows.count > 1)
    for rows in itertools.islice(recorded, 1):  # the columns of one run are those of all
        rows.require_meant(arm, is_as_given)
    if not whole:
        raise Iso9283Error(f"{path}: expected recorded runs of two rows or more with set-points, got none")
    return whole


class _Rows:
    """The rows of one run in a compact array, so that long recordings fit in memory."""

    def __init__(self, path: Path, first: Mapping[str, str], names: Sequence[str], n: int) -> None:
        self._path, self._n, self._first = path, n, dict(first)
        self._required = 1 + n  # time and angles; set-points and the tip may be empty
        self._names = [*names, *(TIP if all(name in first for name in TIP) else ())]
        self._numbers = array("d")

    @property
    def count(self) -> int:
        return len(self._numbers) // len(self._names)

    def add(self, row: Mapping[str, str]) -> None:
        """Add a line, unless it has no set-point."""
        numbers = [_cell(self._path, row, name) for name in self._names]
        for name, value in zip(self._names[: self._required], numbers, strict=False):
            if not math.isfinite(value):
                where = f"{self._path}, line {row['']}, column {name}"
                raise Iso9283Error(f'{where}: got "{row[name].strip()}", expected a finite number')
        if all(map(math.isfinite, numbers[self._required : self._required + self._n])):
            self._numbers.extend(numbers)

    def require_meant(self, arm: Arm, is_as_given: bool) -> None:
        """UnusablePointsError if angles are not in radians or tips not in metres."""
        n, table = self._n, np.array(self._numbers).reshape(-1, len(self._names))
        q, tip = table[:, 1 : 1 + n], table[:, 1 + 2 * n :]
        m = len(table)
        tip = tip if tip.shape[1] else np.full((m, 3), np.nan)
        points = replace(make_points(["run"] * m, [""] * m, [1] * m, q, tip), is_as_given=is_as_given)
        require_columns_meant(arm, points, Choice().for_points(arm, points))

    def run(self, kinematics: Kinematics) -> Run:
        """The run, in order of time."""
        n, table = self._n, np.array(self._numbers).reshape(-1, len(self._names))
        table = table[np.argsort(table[:, 0], kind="stable")]
        table = table[np.concatenate(([True], np.diff(table[:, 0]) > 0.0))]
        time_s, angles, wanted, tip = np.split(table, (1, 1 + n, 1 + 2 * n), axis=1)
        seen = np.isfinite(tip).all(axis=1) if tip.shape[1] else np.zeros(len(table), dtype=np.bool_)
        return Run(
            self._whole_number("run"),
            self._first.get("programme", "").strip(),
            self._whole_number("cycle"),
            _cell(self._path, self._first, "speed_m_s") if "speed_m_s" in self._first else math.nan,
            frozen(time_s[:, 0]),
            frozen(kinematics.tips(wanted)),
            frozen(kinematics.tips(angles)),
            frozen(time_s[seen, 0]),
            frozen(tip[seen] if tip.shape[1] else np.zeros((0, 3))),
        )

    def _whole_number(self, name: str) -> int:
        value = _cell(self._path, self._first, name) if name in self._first else 0.0
        return int(value) if math.isfinite(value) else 0


def _rows(path: Path, required: Sequence[str]) -> Iterator[dict[str, str]]:
    """Rows of a .csv or .csv.gz by column, with the line number under an empty name."""
    with opened_rows(path, Iso9283Error, SAMPLES_MOST) as reader:
        header = [name.strip() for name in next(reader, [])]
        require_commas(path, header)
        for name in required:
            if name not in header:
                raise Iso9283Error(f"{path}, line 1: required column {name} is missing")
        for row in reader:
            if len(row) != len(header):
                where = f"{path}, line {reader.line_num}"
                raise Iso9283Error(f"{where}: {len(row)} values, line 1 names {len(header)}")
            yield {**dict(zip(header, row, strict=True)), "": str(reader.line_num)}


def _cell(path: Path, row: Mapping[str, str], name: str) -> float:
    text = row[name].strip()
    try:
        return float(text) if text else math.nan
    except ValueError:
        raise Iso9283Error(
            f'{path}, line {row[""]}, column {name}: got "{text}", expected a number'
        ) from None


def read_rectangle(path: Path) -> tuple[Array, ...]:
    """The corners E1 .. E4 of programme.json."""
    try:
        document = parsed_json(read_text(path))
        corners = [np.array(corner, dtype=np.float64) for corner in document["rectangle_m"]]
        if (
            document["format"] != "iso9283-programme/1"
            or len(corners) != 4
            or any(c.shape != (3,) for c in corners)
        ):
            raise ValueError("expected format iso9283-programme/1 and four corners in rectangle_m")
    except (ValueError, KeyError, TypeError) as error:
        raise Iso9283Error(f"{path}: not a programme of `armwright iso9283 --record` ({error})") from error
    return tuple(corners)
