"""Candidate poses: cavities of the board in each setup, and free poses visible to a camera."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array
from calib.design.boards import PlacedBoard
from calib.design.reach import (
    TOUCH_M,
    Mask,
    Rows,
    body_points,
    heights_over_board,
    is_above_floor,
    joint_box,
    postures,
    spread_poses,
)
from calib.points.points import Points, make_points
from control.model.arm import Arm

FREE = "free"
FREE_POSES_COUNT = 4000  # number drawn, before poses with collisions are removed
EDGE_SHARE = 0.4
APART_RAD = 0.15  # smallest difference between candidate free poses
FREE_HEIGHT_M = 0.10  # of a free pose's tip above floor and board: an uncalibrated arm may be 4 cm off
WORKSPACE_HEIGHT_M = 0.03  # of the tip in workspace poses
STARTS_COUNT = 12  # number of starts for postures; four times as many with more than three joints
POSTURES_LIMIT = 24  # per cavity; with more than three joints there are infinitely many
TAKEN_RAD = 0.3  # a cavity in a posture closer than this to a recorded one counts as recorded


@dataclass(frozen=True, slots=True)
class View:
    """The box that the camera sees, in the base frame: lower and upper corner [m]."""

    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]

    def shows(self, tips_m: Array) -> Mask:
        """Mask of the tips (m, 3) inside."""
        return np.asarray(((tips_m >= self.lower_m) & (tips_m <= self.upper_m)).all(axis=1))


def table_candidates(arm: Arm, board: PlacedBoard, taken: Points | None, sees_tip: bool) -> Points:
    """Cavities of one setup in every posture of the arm, without those already recorded.

    `sees_tip`: a camera also measures the tip in the cavity, so it is known without the board.
    """
    model, box = ArmModel(arm), joint_box(arm)
    starts = STARTS_COUNT if arm.joint_count <= 3 else 4 * STARTS_COUNT
    q, which = postures(model, board.positions_m, spread_poses(box, starts), box)
    rows = np.flatnonzero(_is_clear_of_board(arm, q, board))
    rows = _first_of_each(rows, which)
    names = [board.names[which[row]] for row in rows]
    free = [k for k, row in enumerate(rows) if not _is_taken(taken, board.setup, names[k], q[row])]
    rows, names = rows[free], [names[k] for k in free]
    tips = board.positions_m[which[rows]] if sees_tip else np.full((len(rows), 3), np.nan)
    return make_points([board.setup] * len(rows), names, [1] * len(rows), q[rows], tips)


def free_candidates(
    arm: Arm, boards: Iterable[PlacedBoard], view: View | None = None, count: int = FREE_POSES_COUNT
) -> Points:
    """Poses over the joints' ranges, clear of the floor and of the board in any setup, in the camera's view."""
    q = workspace_poses(arm, boards, count, EDGE_SHARE, FREE_HEIGHT_M)
    tips = ArmModel(arm).tips(arm.dh, q)
    if view is not None:
        q, tips = q[view.shows(tips)], tips[view.shows(tips)]
    apart = _apart(q)
    q, tips = q[apart], tips[apart]
    return make_points([FREE] * len(q), [""] * len(q), [1] * len(q), q, tips)


def _apart(q: Array) -> Rows:
    """Rows of poses that differ from all previous ones in some joint by APART_RAD."""
    poses = np.empty_like(q)
    rows: list[int] = []
    for row, pose in enumerate(q):
        if not len(rows) or np.abs(poses[: len(rows)] - pose).max(axis=1).min() >= APART_RAD:
            poses[len(rows)] = pose
            rows.append(row)
    return np.array(rows, dtype=np.intp)


def workspace_poses(
    arm: Arm,
    boards: Iterable[PlacedBoard],
    count: int,
    edge_share: float = 0.0,
    height_m: float = WORKSPACE_HEIGHT_M,
) -> Array:
    """Collision-free poses (m, n), m <= count, spread over the joints' ranges, with this tip height above floor and boards."""
    q = spread_poses(joint_box(arm), count, edge_share)
    points = body_points(arm, q)
    lowest_m = arm.limits.floor_z_m + arm.limits.floor_clearance_m + height_m
    clear = is_above_floor(arm, points).all(axis=1) & (points[:, -1, 2] >= lowest_m)
    for board in boards:
        heights, is_over = heights_over_board(points, board)
        clear &= ~(is_over & (heights < height_m)).any(axis=1)
    return np.asarray(q[clear])


def joined(parts: Collection[Points]) -> Points:
    """Concatenate points, without extra columns."""
    present = [part for part in parts if len(part)]
    return make_points(
        [setup for part in present for setup in part.setup],
        [point for part in present for point in part.point],
        [repeat for part in present for repeat in part.repeat],
        np.concatenate([part.q_rad for part in present]),
        np.concatenate([part.tip_m for part in present]),
    )


def named(chosen: Points, taken: Points | None) -> Points:
    """The points with names for free poses, and repeats, that no recorded point has."""
    have = Counter() if taken is None else Counter(zip(taken.setup, taken.point, strict=True))
    highest = {} if taken is None else _highest_repeats(taken)
    points, repeats, number = [], [], 0
    for setup, point in zip(chosen.setup, chosen.point, strict=True):
        if setup == FREE:
            number += 1
            while (FREE, f"p{number}") in have:
                number += 1
            point = f"p{number}"
        highest[setup, point] = highest.get((setup, point), 0) + 1
        points.append(point)
        repeats.append(highest[setup, point])
    return make_points(chosen.setup, points, repeats, chosen.q_rad, chosen.tip_m)


def _highest_repeats(taken: Points) -> dict[tuple[str, str], int]:
    found: dict[tuple[str, str], int] = {}
    for setup, point, repeat in zip(taken.setup, taken.point, taken.repeat, strict=True):
        found[setup, point] = max(repeat, found.get((setup, point), 0))
    return found


def _is_clear_of_board(arm: Arm, q: Array, board: PlacedBoard) -> Mask:
    """Whether the arm, apart from the touching tip, is above the board (over it) and above the floor (elsewhere)."""
    points = body_points(arm, q)
    heights, is_over = heights_over_board(points, board)
    return np.asarray(np.where(is_over, heights >= -TOUCH_M, is_above_floor(arm, points)).all(axis=1))


def _first_of_each(rows: Rows, which: Rows) -> Rows:
    """At most POSTURES_LIMIT rows of each cavity."""
    seen: Counter[int] = Counter()
    chosen = []
    for row in rows:
        seen[int(which[row])] += 1
        if seen[int(which[row])] <= POSTURES_LIMIT:
            chosen.append(int(row))
    return np.array(chosen, dtype=np.intp)


def _is_taken(taken: Points | None, setup: str, point: str, q_rad: Array) -> bool:
    """Whether the points contain this cavity in about this posture."""
    if taken is None:
        return False
    rows = [k for k in range(len(taken)) if (taken.setup[k], taken.point[k]) == (setup, point)]
    return bool(len(rows)) and float(np.abs(taken.q_rad[rows] - q_rad).max(axis=1).min()) < TAKEN_RAD
