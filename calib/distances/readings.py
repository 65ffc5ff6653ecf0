"""Readings of lengths in a points.csv: columns `distance_of`, `distance_m` and, optionally, `distance_sd_m`.

wire:NAME      distance_m from a fixed point of unknown place to the tip: a draw wire, or a ball bar of known length
gauge:NAME     distance_m by which the tip is displaced along a fixed unknown direction, from an unknown zero: a dial gauge
between:NAME   distance_m between the tips of the two poses of this name
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arm_problem.checks import TURNS_LIMIT_rad
from calib.arm_problem.joint_effects import known_corrections
from calib.arrays import Array, frozen
from calib.errors import PointsFileError, UnusablePointsError
from calib.points.points import Points
from control.model.arm import Arm

OF, LENGTH, SD = "distance_of", "distance_m", "distance_sd_m"
WIRE, GAUGE, BETWEEN = KINDS = ("wire", "gauge", "between")
LONGEST_m = 20.0
Rows = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Readings:
    """r readings: device (kind:name) and pose of each, measured length_m (r,), sd_m (r,), NaN where not stated.

    q_rad (m, n): joint angles of all poses, with the arm's known static effects. pose (r, 2): the pose; of `between` both, else
    twice the same. name: setup:point:repeat of the (first) pose.
    """

    device: tuple[str, ...]
    name: tuple[str, ...]
    pose: Rows
    q_rad: Array
    length_m: Array
    sd_m: Array

    def __len__(self) -> int:
        """How many."""
        return len(self.device)

    def of(self, device: str) -> Rows:
        """The readings of a device."""
        return np.flatnonzero(np.array(self.device) == device)

    def chosen(self, rows: Sequence[int] | Rows) -> Readings:
        """Some of the readings."""
        keep = np.asarray(rows, dtype=np.intp)
        return Readings(
            tuple(self.device[k] for k in keep),
            tuple(self.name[k] for k in keep),
            self.pose[keep],
            self.q_rad,
            frozen(self.length_m[keep]),
            frozen(self.sd_m[keep]),
        )


def has_readings(points: Points) -> bool:
    """Whether the file holds lengths."""
    return any(text for text in points.extra.get(OF, ()))


def readings_of(arm: Arm, points: Points, where: Path) -> Readings:
    """The readings of a file. PointsFileError or UnusablePointsError names line and column."""
    if OF not in points.extra or LENGTH not in points.extra:
        missing = OF if OF not in points.extra else LENGTH
        raise PointsFileError(f"{where}, line 1: required column {missing} is missing (docs/distances.md)")
    if np.abs(points.q_rad).max() > TURNS_LIMIT_rad:
        raise UnusablePointsError(f"{where}: the joint angles look like degrees: expected radians")
    rows = [k for k, text in enumerate(points.extra[OF]) if text]
    if not rows:
        raise PointsFileError(
            f"{where}, column {OF}: every cell is empty: expected wire:NAME, gauge:NAME or between:NAME"
        )
    for row in rows:
        _require_device(where, row, points.extra[OF][row])
    poses, firsts = _poses(where, points, rows)
    length = [_number(where, points, row, LENGTH, required=True) for row in firsts]
    sd = [_number(where, points, row, SD, required=False) for row in firsts]
    names = [":".join((points.setup[k], points.point[k], str(points.repeat[k]))) for k in firsts]
    return Readings(
        tuple(points.extra[OF][k] for k in firsts),
        tuple(names),
        np.array(poses, dtype=np.intp),
        frozen(points.q_rad + known_corrections(arm, points)),
        frozen(length),
        frozen(sd),
    )


def _require_device(where: Path, row: int, text: str) -> None:
    kind, colon, name = text.partition(":")
    if kind not in KINDS or not colon or not name.strip():
        raise PointsFileError(
            f'{where}, line {row + 2}, column {OF}: got "{text}", expected wire:NAME, gauge:NAME or between:NAME'
        )


def _poses(where: Path, points: Points, rows: list[int]) -> tuple[list[tuple[int, int]], list[int]]:
    """Both poses of each reading, and the row that states it."""
    poses, firsts, open_pairs = [], [], dict[str, int]()
    for row in rows:
        device = points.extra[OF][row]
        if not device.startswith(BETWEEN):
            poses.append((row, row))
            firsts.append(row)
        elif device in open_pairs:
            first = open_pairs.pop(device)
            _require_one_length(where, points, first, row)
            poses.append((first, row))
            firsts.append(first)
        else:
            open_pairs[device] = row
    if open_pairs:
        device, row = next(iter(open_pairs.items()))
        raise PointsFileError(
            f'{where}, line {row + 2}: "{device}" has no second pose: expected two lines with this name'
        )
    return poses, firsts


def _require_one_length(where: Path, points: Points, first: int, second: int) -> None:
    lengths = [_number(where, points, row, LENGTH, required=True) for row in (first, second)]
    if lengths[0] != lengths[1]:
        raise PointsFileError(
            f"{where}, lines {first + 2} and {second + 2}, column {LENGTH}: got {lengths[0]:g} and {lengths[1]:g} m,"
            " expected the same distance in both lines of a pair"
        )


def _number(where: Path, points: Points, row: int, column: str, required: bool) -> float:
    """A finite number; a standard deviation is above 0, and NaN if it is not stated."""
    text = points.extra[column][row].strip() if column in points.extra else ""
    if not text and not required:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    is_sd = column == SD
    if not (0.0 < value <= 1.0 if is_sd else -LONGEST_m <= value <= LONGEST_m):
        expected = "a number above 0, up to 1 m" if is_sd else f"a length within +-{LONGEST_m:g} m"
        raise PointsFileError(f'{where}, line {row + 2}, column {column}: got "{text}", expected {expected}')
    return value
