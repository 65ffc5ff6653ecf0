"""Free poses to record with a camera: spread over the joints' ranges, with them and the paths between well above the board.

The choice is the same for the same arm and count.
"""

from __future__ import annotations

import math
from itertools import zip_longest
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.errors import SessionError
from control.kinematics.kinematics import Kinematics
from control.model.arm import Arm
from control.tables import opened_rows

CANDIDATES = 4000
MARGIN = 0.1  # of each joint's range, kept free at either end
CLEARANCE_m = 0.12  # of tip and elbow above the floor and the board: an uncalibrated arm is some 3 cm off
STILL_m = 1e-9  # a height that changes by less over all candidates does not depend on the joints
REACH = 0.95  # of the longest reach among the candidates: a stretched arm is hard to see
WAY_STEPS = 25
UNLIMITED_rad = math.pi / 2  # range taken for a joint without limits


def chosen_free_poses(arm: Arm, count: int) -> dict[str, tuple[float, ...]]:
    """`count` poses by name f1, f2, ..., in an order with short paths; SessionError if there is no room."""
    lower, upper = _ranges(arm)
    unit = np.random.default_rng(count).uniform(0.0, 1.0, (CANDIDATES, arm.joint_count))
    q_rad = lower + unit * (upper - lower)
    space = _Space(arm, q_rad)
    is_clear = space.clearance_m(q_rad) > 0.0
    reach_m = np.linalg.norm(space.kinematics.tips(q_rad), axis=1)
    is_clear &= reach_m < REACH * reach_m.max()
    if is_clear.sum() < count:
        raise SessionError(
            f"--free {count}: only {int(is_clear.sum())} of {CANDIDATES} candidate poses of arm {arm.name} are"
            f" {CLEARANCE_m:g} m above the table: give the poses in a file"
        )
    rows = _spread(unit[is_clear], count)
    ordered = _ordered(space, q_rad[is_clear][rows])
    return {f"f{k + 1}": tuple(round(float(q), 4) for q in pose) for k, pose in enumerate(ordered)}


def read_free_poses(path: Path, joint_count: int) -> dict[str, tuple[float, ...]]:
    """Poses of a file with the columns q1_rad ... and, optionally, point. SessionError names file and line."""
    wanted = [f"q{j}_rad" for j in range(1, joint_count + 1)]
    poses: dict[str, tuple[float, ...]] = {}
    with opened_rows(path, SessionError) as reader:
        header = next(reader, [])
        missing = [name for name in wanted if name not in header]
        if missing:
            raise SessionError(f"{path}, line 1: required column {missing[0]} is missing")
        for cells in filter(None, reader):
            row = dict(zip_longest(header, cells[: len(header)], fillvalue=""))
            name = (row.get("point") or "").strip() or f"f{len(poses) + 1}"
            if name in poses:
                raise SessionError(f"{path}, line {reader.line_num}: pose {name} appears twice")
            poses[name] = tuple(_angle(path, reader.line_num, key, row[key]) for key in wanted)
    return poses


def _angle(path: Path, line: int, key: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or abs(value) > 6.0 * math.pi:
        raise SessionError(f"{path}, line {line}, column {key}: got {text!r}, expected an angle in radians")
    return value


def _ranges(arm: Arm) -> tuple[Array, Array]:
    limits = np.array(arm.limits_rad)
    limits = np.where(np.isfinite(limits), limits, np.array([-UNLIMITED_rad, UNLIMITED_rad]))
    room = MARGIN * (limits[:, 1] - limits[:, 0])
    return limits[:, 0] + room, limits[:, 1] - room


class _Space:
    """How far the arm is above the floor and the board."""

    def __init__(self, arm: Arm, candidates_rad: Array) -> None:
        self.kinematics = Kinematics(arm)
        self._lowest_m = max(arm.limits.floor_z_m, _board_top_m(arm)) + CLEARANCE_m
        heights_m = self._heights_m(candidates_rad)
        # An origin that no joint raises or lowers, such as the shoulder, belongs to the stand: it limits no pose.
        self._moving = np.ptp(heights_m, axis=0) > STILL_m

    def _heights_m(self, q_rad: Array) -> Array:
        """Heights of the links' origins and of the tip, shape (poses, links + 1)."""
        links = self.kinematics.link_transforms(q_rad)[:, :, 2, 3]
        return np.column_stack([links, self.kinematics.tips(q_rad)[:, 2]])

    def clearance_m(self, q_rad: Array) -> Array:
        """Height of the lowest moving point above floor and board, minus the required one, shape (poses,)."""
        heights_m = self._heights_m(q_rad)[:, self._moving]
        return np.asarray(heights_m.min(axis=1, initial=math.inf) - self._lowest_m)

    def is_clear(self, start_rad: Array, end_rad: Array) -> bool:
        """Whether a joint move stays half the clearance above the table."""
        shares = np.linspace(0.0, 1.0, WAY_STEPS)[:, None]
        way_rad = start_rad + shares * (end_rad - start_rad)
        return bool((self.clearance_m(way_rad) > -0.5 * CLEARANCE_m).all())


def _board_top_m(arm: Arm) -> float:
    table = arm.table
    return table.origin_m[2] if table is not None and table.origin_m is not None else 0.0


def _spread(unit: Array, count: int) -> list[int]:
    """Rows far from each other: each next one is the farthest from those chosen."""
    rows = [int(np.argmin(np.linalg.norm(unit - unit.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(unit - unit[rows[0]], axis=1)
    while len(rows) < count:
        rows.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(unit - unit[rows[-1]], axis=1))
    return rows


def _ordered(space: _Space, q_rad: Array) -> list[Array]:
    """Order the poses: each next one is the nearest with a clear path."""
    left, ordered = list(q_rad), list[Array]()
    here = left[0]
    while left:
        left.sort(key=lambda pose: float(np.linalg.norm(pose - here)))
        clear = [k for k, pose in enumerate(left) if not ordered or space.is_clear(here, pose)]
        here = left.pop(clear[0] if clear else 0)
        ordered.append(here)
    return ordered
