"""Recorded poses and runs as the criteria want them: points.csv and log.csv (formats.md), and programme.json."""

from __future__ import annotations

import csv
import gzip
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array, frozen
from calib.iso9283.checks import Iso9283Error
from calib.iso9283.files import SET, TIP
from calib.points import Points
from control.model.arm import Arm
from control.model.kinematics import Kinematics

ANGLES, ANGLES_SET, FORCE = (
    ("a_rad", "b_rad", "c_rad"),
    ("a_set_rad", "b_set_rad", "c_set_rad"),
    ("fx_N", "fy_N", "fz_N"),
)


@dataclass(frozen=True, slots=True)
class PoseGroup:
    """One pose of one programme: commanded (3,), attained (n, 3) in the order of time, base frame, m.

    t_s (n,), force_N (n, 3) of what hangs at the tip; angle_set_rad (3,) and angle_rad (n, 3) where the orientation
    was measured. `unseen` visits had no measured tip.
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

    seen_m (s, 3) at seen_s (s,) by the camera. `programme` is empty and speed_m_s NaN where the file does not say.
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
    def moving_s(self) -> tuple[float, float]:
        """When the set-point begins to move, and when it stops."""
        still = np.linalg.norm(np.diff(self.set_m, axis=0), axis=1) < 1e-9
        moving = np.flatnonzero(~still)
        if not len(moving):
            raise Iso9283Error(f"run {self.number}: the set-point does not move")
        return float(self.time_s[moving[0]]), float(self.time_s[moving[-1] + 1])


def pose_groups(points: Points, arm: Arm, path: str) -> tuple[list[PoseGroup], tuple[str, ...]]:
    """Poses by setup and point, in order, and in words where the commanded positions come from."""
    commanded, source = _commanded(points, arm, path)
    force = _columns(points, FORCE, path)
    if force is None:
        force = np.outer(np.nan_to_num(points.payload_kg), arm.gravity_m_s2)
    angle_set, angle = _columns(points, ANGLES_SET, path), _columns(points, ANGLES, path)
    keys = list(zip(points.setup, points.point, strict=True))
    groups = []
    for key in dict.fromkeys(keys):
        rows = np.array([k for k, other in enumerate(keys) if other == key])
        seen = rows[np.isfinite(points.tip_m[rows]).all(axis=1)]
        turned = None if angle is None or angle_set is None else (angle_set[rows].mean(axis=0), angle[rows])
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
    return groups, (source,)


def _commanded(points: Points, arm: Arm, path: str) -> tuple[Array, str]:
    """Commanded positions (m, 3): columns, or set-points or encoders through the arm's kinematics."""
    given = _columns(points, SET, path)
    if given is not None:
        return given, "commanded positions are those of the columns x_set_m, y_set_m, z_set_m"
    if points.joint_count != arm.joint_count:
        raise Iso9283Error(
            f"{path}: no commanded positions: it has no columns {', '.join(SET)}, and angles of {points.joint_count} joints"
            f" do not fit arm {arm.name} with {arm.joint_count}: give the columns, or the right --arm"
        )
    names = tuple(f"q{j}_set_rad" for j in range(1, arm.joint_count + 1))
    q_rad = _columns(points, names, path)
    source = "set-points" if q_rad is not None else "encoder angles, where the arm stood,"
    tips = Kinematics(arm).tips(points.q_rad if q_rad is None else q_rad)
    return tips, f"commanded positions are the {source} through the kinematics of arm {arm.name}"


def _columns(points: Points, names: Sequence[str], path: str) -> Array | None:
    """Extra columns as numbers (m, len(names)); None unless all of them are there."""
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


def read_runs(path: Path, arm: Arm) -> list[Run]:
    """Every run of a log.csv or log.csv.gz; Iso9283Error names file, line and column."""
    n, kinematics = arm.joint_count, Kinematics(arm)
    q, q_set = ([f.format(j) for j in range(1, n + 1)] for f in ("q{}_rad", "q{}_set_rad"))
    rows: dict[str, list[dict[str, str]]] = {}
    for row in _rows(path, ("run", "t_s", *q, *q_set)):
        rows.setdefault(row["run"], []).append(row)
    if not rows:
        raise Iso9283Error(f"{path}: a header and no rows: expected recorded runs")
    return [_run(path, name, lines, q, q_set, kinematics) for name, lines in rows.items()]


def _run(
    path: Path, name: str, lines: list[dict[str, str]], q: list[str], q_set: list[str], kinematics: Kinematics
) -> Run:
    def column(key: str) -> Array:
        return np.array([_cell(path, line, key) for line in lines])

    time_s = column("t_s")
    order = np.argsort(time_s, kind="stable")
    order = order[np.concatenate(([True], np.diff(time_s[order]) > 0.0))]
    angles, wanted = (np.column_stack([column(key) for key in keys])[order] for keys in (q, q_set))
    if not (np.isfinite(angles).all() and np.isfinite(wanted).all() and np.isfinite(time_s).all()):
        raise Iso9283Error(f"{path}, run {name}: a time, angle or set-point is empty")
    has_tip = all(key in lines[0] for key in TIP)
    tip = (
        np.column_stack([column(key) for key in TIP])[order] if has_tip else np.full((len(order), 3), np.nan)
    )
    seen = np.isfinite(tip).all(axis=1)
    first = lines[0]
    return Run(
        int(float(name)),
        first.get("programme", ""),
        int(float(first.get("cycle") or 0)),
        float(first.get("speed_m_s") or "nan"),
        frozen(time_s[order]),
        frozen(kinematics.tips(wanted)),
        frozen(kinematics.tips(angles)),
        frozen(time_s[order][seen]),
        frozen(tip[seen]),
    )


def _rows(path: Path, required: Sequence[str]) -> Iterator[dict[str, str]]:
    """Rows of a .csv or .csv.gz by column, with their line under an empty name."""
    try:
        with (
            gzip.open(path, "rt", encoding="utf-8-sig", newline="")
            if path.suffix == ".gz"
            else path.open(encoding="utf-8-sig", newline="") as file
        ):
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            for name in required:
                if name not in header:
                    raise Iso9283Error(f"{path}, line 1: required column {name} is missing")
            for row in reader:
                if len(row) != len(header):
                    raise Iso9283Error(
                        f"{path}, line {reader.line_num}: {len(row)} values, line 1 names {len(header)}"
                    )
                yield {**dict(zip(header, row, strict=True)), "": str(reader.line_num)}
    except (UnicodeDecodeError, csv.Error, EOFError, gzip.BadGzipFile) as error:
        raise Iso9283Error(f"{path}: not comma-separated text ({error})") from error


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
        document = json.loads(path.read_text(encoding="utf-8"))
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
