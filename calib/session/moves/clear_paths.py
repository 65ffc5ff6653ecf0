"""Collision-free paths between poses: straight if possible, else over a raised pose or the rest pose.

Checked with the arm's own model, which may be centimetres off, so paths keep a margin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.boards.boards import BoardPose
from calib.design.reach import body_points
from calib.session.moves.ports import Geometry
from control.errors import ArmError
from control.model.arm import Arm
from control.model.table import board_cavities

MARGIN_m = 0.03  # above the board: possible error of an uncalibrated arm; poses above cavities are at 60 mm
EDGE_m = 0.03  # the board reaches this far beyond its outermost cavity
STEP_RAD = 0.05  # of the joint with the longest travel, between checks
HIGHER_m = (0.05, 0.1, 0.2)
Pose = tuple[float, ...]


class NoClearPath(ArmError):
    """All candidate paths come too close to the board or the floor."""


class ClearPaths:
    """Finds collision-free paths for one arm."""

    def __init__(self, arm: Arm, geometry: Geometry) -> None:
        self._arm, self._geometry = arm, geometry
        cavities = [] if arm.table is None else [*board_cavities(arm.table).values()]
        self._reach_m = max((float(np.hypot(x, y)) for x, y, _ in cavities), default=0.0) + EDGE_m

    def stops(
        self, start_rad: Sequence[float], end_rad: Sequence[float], board: BoardPose | None
    ) -> list[Pose]:
        """Poses to visit in order, the last of them end_rad. NoClearPath if there is no such path.

        `board`: its present pose; None if unknown, or without a board.
        """
        start, end = tuple(start_rad), tuple(end_rad)
        for way in self._candidates(start, end):
            if all(self._is_clear(a, b, board) for a, b in zip([start, *way[:-1]], way, strict=True)):
                return way
        raise NoClearPath(
            f"no collision-free path from {_spelled(start)} to {_spelled(end)} rad: direct, raised and through the rest pose"
            f" the arm comes within {1e3 * MARGIN_m:g} mm of the board or the floor; move the arm up, then `redo`"
        )

    def _candidates(self, start: Pose, end: Pose) -> list[list[Pose]]:
        ways = [[end]]
        for up_m in HIGHER_m:
            high_start, high_end = self._higher(start, up_m), self._higher(end, up_m)
            if high_start is not None and high_end is not None:
                ways.append([high_start, high_end, end])
        if self._arm.rest is not None:
            rest = tuple(self._arm.rest.q_rad)
            ways += [[rest, end]]
            ways += [
                [a, rest, b, end]
                for up_m in HIGHER_m
                if (a := self._higher(start, up_m)) is not None and (b := self._higher(end, up_m)) is not None
            ]
        return ways

    def _higher(self, q_rad: Pose, up_m: float) -> Pose | None:
        x, y, z = self._geometry.tip(q_rad)
        try:
            return tuple(self._geometry.nearest((x, y, z + up_m), q_rad))
        except ArmError:
            return None

    def _is_clear(self, start: Pose, end: Pose, board: BoardPose | None) -> bool:
        """Whether a straight joint move keeps clear; start and end may be lower."""
        first, last = np.array(start), np.array(end)
        count = 2 + int(np.abs(last - first).max() / STEP_RAD)
        q_rad = first + np.linspace(0.0, 1.0, count)[:, None] * (last - first)
        points = body_points(self._arm, q_rad)
        limits = self._arm.limits
        room = points[:, :, 2] - (limits.floor_z_m + limits.floor_clearance_m)
        if board is not None:
            local = (points - board.origin_m) @ board.rotation
            is_over = np.hypot(local[:, :, 0], local[:, :, 1]) <= self._reach_m
            room = np.where(is_over, local[:, :, 2], room)
        least = room.min(axis=1)
        return bool((least >= np.minimum(MARGIN_m, min(least[0], least[-1])) - 1e-9).all())


def _spelled(q_rad: Pose) -> str:
    return "(" + ", ".join(f"{q:.3f}" for q in q_rad) + ")"
