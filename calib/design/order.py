"""Visiting order of planned poses: setups together, short paths, none through floor or board."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from calib.arrays import Array
from calib.design.boards import PlacedBoard
from calib.design.candidates import FREE
from calib.design.reach import Mask, body_points, heights_over_board, is_above_floor
from calib.points.points import Points
from control.model.arm import Arm

WAY_SAMPLES = 16
WAY_HEIGHT_M = (
    0.05  # of the nominal tip above floor and boards between poses; an uncalibrated arm may be 4 cm off
)
DETOUR_RAD = 100.0  # penalty for a path with a collision, so that any other order is better


def visiting_order(
    arm: Arm, planned: Points, setups: Sequence[str], boards: Iterable[PlacedBoard]
) -> list[int]:
    """Indices of the planned poses in visiting order: setups in the order given, free poses last.

    Within each the sum of largest joint travels is kept small: nearest neighbour, then 2-opt.
    """
    standing = list(boards)
    order: list[int] = []
    last = np.array(arm.rest.q_rad if arm.rest is not None else np.zeros(arm.joint_count))
    for setup in [*setups, FREE]:
        rows = [k for k, name in enumerate(planned.setup) if name == setup]
        if not rows:
            continue
        q = np.vstack((last, planned.q_rad[rows]))
        ways = np.abs(q[:, None] - q[None, :]).max(axis=2)
        if setup == FREE:  # between cavities the session lifts the arm
            ways = ways + DETOUR_RAD * ~clear_ways(arm, q, standing)
        order += [rows[k - 1] for k in short_path(ways)[1:]]
        last = planned.q_rad[order[-1]]
    return order


def clear_ways(arm: Arm, q_rad: Array, boards: Iterable[PlacedBoard]) -> Mask:
    """Mask (m, m): a straight joint move between these poses (m, n) is clear of floor and boards."""
    m = len(q_rad)
    first, second = np.triu_indices(m, 1)
    shares = np.linspace(0.0, 1.0, WAY_SAMPLES)[1:-1]
    between = q_rad[first, None] + shares[:, None] * (q_rad[second] - q_rad[first])[:, None]
    points = body_points(arm, between.reshape(-1, q_rad.shape[1]))
    lowest_m = arm.limits.floor_z_m + arm.limits.floor_clearance_m + WAY_HEIGHT_M
    clear = is_above_floor(arm, points).all(axis=1) & (points[:, -1, 2] >= lowest_m)
    for board in boards:
        heights, is_over = heights_over_board(points, board)
        clear &= ~(is_over & (heights < WAY_HEIGHT_M)).any(axis=1)
    ways = np.ones((m, m), dtype=np.bool_)
    ways[first, second] = ways[second, first] = clear.reshape(len(first), len(shares)).all(axis=1)
    return ways


def short_path(ways: Array) -> list[int]:
    """A short path through all places of the matrix (m, m), from the first."""
    path, left = [0], set(range(1, len(ways)))
    while left:
        nearest = min(left, key=lambda k: (ways[path[-1], k], k))
        path.append(nearest)
        left.remove(nearest)
    return _untangled(path, ways)


def _untangled(path: list[int], ways: Array) -> list[int]:
    """2-opt with a free end: reverse a section wherever that makes the path shorter."""
    is_changed = True
    while is_changed:
        is_changed = False
        for i in range(1, len(path) - 1):
            for j in range(i + 1, len(path)):
                after = ways[path[i], path[j + 1]] - ways[path[j], path[j + 1]] if j + 1 < len(path) else 0.0
                if ways[path[i - 1], path[j]] - ways[path[i - 1], path[i]] + after < -1e-9:
                    path[i : j + 1] = path[i : j + 1][::-1]
                    is_changed = True
    return path
