"""Which few poses tell the causes apart best, by what the earlier points leave uncertain."""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array
from calib.checkup.causes import causes_of
from calib.checkup.expectation import Expectation, expectation_of
from calib.gap.plan.collision_free_box import collision_free_box
from calib.gap.plan.plan import MARGIN_rad, RecordingPlan, Visit, plan_of
from calib.gap.plan.poses import Extent, Pose, static_poses
from calib.points.points import Points, make_points
from control.model.arm import Arm

POSES: Final = 8  # each is visited from two opposite sides
SIZE_rad: Final = 3e-3  # of a change that is to be told: three times what parts of a sound arm do
CANDIDATES: Final = Extent(levels=3, spread=24, outside=8, pulled=2)
SETUP: Final = "free"


def checkup_plan(arm: Arm, earlier: Points, count: int = POSES, speed: float = 1.0) -> RecordingPlan:
    """The poses that determine all causes together best (D-optimal, one after the other), as visits."""
    room = collision_free_box(arm)
    poses = static_poses(arm, room.inset(MARGIN_rad), CANDIDATES)
    sides = _sides(arm.joint_count)
    rows = [(pose, side) for k, pose in enumerate(poses) for side in (sides[k % 2], _against(sides[k % 2]))]
    q = np.array([pose.q_rad for pose, _ in rows])
    direction = np.array([side for _, side in rows], dtype=float)
    names = [f"c{k}" for k in range(len(rows))]
    new = make_points([SETUP] * len(rows), names, [1] * len(rows), q, _tips(arm, q), direction)
    chosen = _best(expectation_of(arm, earlier, new), count)
    visits = [visit for k in chosen for visit in _visits(*rows[2 * k])]
    return plan_of(arm, room, visits, speed)


def _visits(pose: Pose, side: tuple[int, ...]) -> tuple[Visit, Visit]:
    ways = (side, _against(side))
    first, second = (
        Visit(pose.name, repeat, pose.q_rad, way, 0.0, pose.via_rad, SETUP)
        for repeat, way in enumerate(ways, 1)
    )
    return first, second


def _best(at: Expectation, count: int) -> list[int]:
    """Greedy: the pose (two rows) that adds most to the logarithm of the information's determinant."""
    columns = np.concatenate(
        [
            one.columns * (SIZE_rad if one.kind in ("zero", "play", "load") else 0.3 * SIZE_rad)
            for one in causes_of(at)
        ],
        axis=2,
    )
    half = len(at) // 2
    parts = [_information(at, columns, [2 * k, 2 * k + 1]) for k in range(half)]
    known = np.eye(columns.shape[2])
    chosen: list[int] = []
    for _ in range(min(count, half)):
        gains = [-np.inf if k in chosen else np.linalg.slogdet(known + parts[k])[1] for k in range(half)]
        chosen.append(int(np.argmax(gains)))
        known = known + parts[chosen[-1]]
    return chosen


def _information(at: Expectation, columns: Array, rows: list[int]) -> Array:
    own = at.chosen(rows)
    flat = columns[rows].reshape(6, -1)
    return np.asarray(flat.T @ np.linalg.solve(own.covariance, flat))


def _tips(arm: Arm, q_rad: Array) -> Array:
    return ArmModel(arm).tips(arm.dh, q_rad)


def _sides(n: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return (1,) * n, tuple(1 if j % 2 == 0 else -1 for j in range(n))


def _against(side: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(-one for one in side)
