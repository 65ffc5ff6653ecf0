"""Vicon's CSV export (Tracker, Nexus): sections of a title, the rate, names, columns, units, and frames.

    Objects | Segments      Frame, Sub Frame, then for each RX RY RZ [RW] TX TY TZ
    Trajectories            Frame, Sub Frame, then for each X Y Z

RX RY RZ is a rotation vector in deg or rad, or with RW a quaternion; lengths in mm or m: the units' line says so.
Names stand over the first column of each. Empty, or all zero: not seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.capture.tracks import FRAMES_MOST, BodyTrack, Capture, CaptureError
from control.kinematics.rotation import exponentials, matrices
from control.tables import SAMPLES_MOST, opened_rows

OF_BODIES, OF_MARKERS = ("Objects", "Segments"), ("Trajectories",)
LAYOUTS = {
    ("RX", "RY", "RZ", "TX", "TY", "TZ"): 3,
    ("RX", "RY", "RZ", "RW", "TX", "TY", "TZ"): 4,
    ("X", "Y", "Z"): 0,
}
UNITS = {"mm": 1e-3, "m": 1.0, "deg": math.pi / 180.0, "rad": 1.0, "": 1.0}
FASTEST_Hz = 10_000.0
Line = tuple[int, list[str]]


def read_vicon_csv(path: Path) -> Capture:
    """The bodies and markers of a file. CaptureError names file and line."""
    bodies: dict[str, BodyTrack] = {}
    markers: dict[str, Array] = {}
    clock: list[tuple[float, Array]] = []
    with opened_rows(path, CaptureError, SAMPLES_MOST) as rows:
        lines = ((number, [cell.strip() for cell in row]) for number, row in enumerate(rows, 1))
        for number, row in lines:
            title = row[0] if row else ""
            if title in (*OF_BODIES, *OF_MARKERS):
                rate_Hz, frames, found = _section(path, number, lines)
                clock.append((rate_Hz, frames))
                (bodies if title in OF_BODIES else markers).update(found)  # type: ignore[arg-type]
    if not clock:
        raise CaptureError(
            f"{path}: no section Objects, Segments or Trajectories: expected a CSV as Tracker or Nexus exports it"
        )
    rate_Hz, frames = clock[0]
    if any(rate != rate_Hz or not np.array_equal(other, frames) for rate, other in clock[1:]):
        raise CaptureError(f"{path}: its sections have other rates or frames: export them together")
    return Capture(path, (frames - frames[0]) / rate_Hz, bodies, markers)


def _section(
    path: Path, number: int, lines: Iterator[Line]
) -> tuple[float, Array, dict[str, BodyTrack | Array]]:
    """Rate, frame numbers, and what is in a section; `number` is the line of its title."""
    head = [next(lines, (number + k, list[str]())) for k in range(1, 5)]
    rate_Hz = _number(path, head[0][0], head[0][1][0] if head[0][1] else "")
    if not 0.0 < rate_Hz <= FASTEST_Hz:
        raise CaptureError(
            f"{path}, line {head[0][0]}: got a rate of {rate_Hz:g} Hz, expected up to {FASTEST_Hz:g}"
        )
    (_, names), (at, columns), (_, units) = head[1:]
    if [column.lower() for column in columns[:2]] != ["frame", "sub frame"]:
        raise CaptureError(
            f"{path}, line {at}: expected the columns Frame, Sub Frame, ..., got {', '.join(columns[:3])}"
        )
    groups = _groups(path, at, names, columns)
    rows, last = list[list[float]](), -math.inf
    for line, row in lines:
        if not any(row):
            break
        values = [_number(path, line, text) for text in row[: len(columns)]]
        values += [math.nan] * (len(columns) - len(values))
        if not values[0] > last:
            raise CaptureError(f"{path}, line {line}: got frame {row[0]}, expected one after {last:g}")
        last = values[0]
        rows.append(values)
        if len(rows) > FRAMES_MOST:
            raise CaptureError(f"{path}: more than {FRAMES_MOST} frames: cut the recording")
    if not rows:
        raise CaptureError(f"{path}, line {at}: a section without frames")
    factors = np.array(
        [_factor(path, at + 1, unit) for unit in [*units, *[""] * len(columns)][: len(columns)]]
    )
    table = np.array(rows) * factors
    return rate_Hz, np.array(rows)[:, 0], {name: _track(table[:, a:b], turn) for name, a, b, turn in groups}


def _groups(path: Path, line: int, names: list[str], columns: list[str]) -> list[tuple[str, int, int, int]]:
    """Name, first and last column, and numbers of the rotation, of each body or marker."""
    starts = [k for k, name in enumerate(names) if name and k >= 2]
    found = []
    for start, end in zip(starts, [*starts[1:], len(columns)], strict=True):
        layout = tuple(column.upper() for column in columns[start:end] if column)
        if layout not in LAYOUTS:
            raise CaptureError(
                f"{path}, line {line}: {names[start]} has the columns {', '.join(layout) or 'none'}, expected RX RY RZ [RW] TX"
                " TY TZ, or X Y Z"
            )
        name = names[start].removeprefix("Global Angle ").split(":", 1)
        called = name[1] if len(name) > 1 and name[0] == name[1] else names[start]
        found.append((called, start, start + len(layout), LAYOUTS[layout]))
    return found


def _track(values: Array, turn: int) -> BodyTrack | Array:
    values = np.where((values == 0.0).all(axis=1)[:, None], np.nan, values)
    seen = np.asarray(np.isfinite(values).all(axis=1))
    place = np.where(seen[:, None], values[:, turn:], np.nan)
    if not turn:
        return place
    rotation = np.full((len(values), 3, 3), np.nan)
    if turn == 3:
        rotation[seen] = exponentials(values[seen, :3])
    else:
        quaternion = values[seen][:, [3, 0, 1, 2]]
        rotation[seen] = matrices(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
    return BodyTrack(place, rotation)


def _number(path: Path, line: int, text: str) -> float:
    """A number; NaN for an empty cell."""
    if not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if math.isinf(value):
        raise CaptureError(f'{path}, line {line}: got "{text}", expected a number')
    return value


def _factor(path: Path, line: int, unit: str) -> float:
    if unit not in UNITS:
        raise CaptureError(f'{path}, line {line}: got the unit "{unit}", expected one of mm, m, deg, rad')
    return UNITS[unit]
