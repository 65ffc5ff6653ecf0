"""Whether two arms of a cell are clear of each other and of themselves, at poses and on their ways between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise, product

import numpy as np

from calib.arrays import Array, frozen
from control.errors import ArmError
from control.kinematics.inverse import InverseKinematics
from control.model.arm import Arm
from control.model.cell import Cell, Placed
from control.safety.collision import ArmBody, least_gap, pairs_between

MARGIN_m = 0.03  # beyond the cell's clearance: tips of uncalibrated arms are some 2 cm off
AWAY_m = 0.04  # back along the last link, to where an arm moves before a hand brings its tip to the contact
STEP_m = 0.005  # two looks at a way are at least so far apart: no part comes nearer between them by more than half of it
AHEAD_m = 0.2  # gaps beyond it are not looked at closely
Poses = Sequence[Sequence[float]]
"""Joint angles of the first and of the second arm [rad]."""


class SharedRoom:
    """Whether two arms are clear of each other and of themselves, with a margin."""

    def __init__(self, cell: Cell, pair: tuple[Placed, Placed]) -> None:
        self.rest_rad: Poses = [_rest_rad(placed.arm) for placed in pair]
        self._bodies = tuple(ArmBody(placed, cell.tool_length_m) for placed in pair)
        self._pairs = pairs_between(*self._bodies)
        self._own_pairs = [
            _apart(body, q_rad) for body, q_rad in zip(self._bodies, self.rest_rad, strict=True)
        ]
        self._least_m = cell.clearance_m + MARGIN_m
        self._backs = (_Back(pair[0].arm), _Back(pair[1].arm))
        self._levers_m = [_levers_m(placed.arm) for placed in pair]

    def is_clear(self, first_rad: Sequence[float], second_rad: Sequence[float]) -> bool:
        """Of a pose of both."""
        return self._to_spare_m(first_rad, second_rad) >= 0.0

    def _to_spare_m(self, first_rad: Sequence[float], second_rad: Sequence[float]) -> float:
        """How much more than asked for the nearest parts are apart, AHEAD_m at most."""
        one, two = self._bodies[0].at(first_rad), self._bodies[1].at(second_rad)
        between_m = least_gap(one, two, self._pairs, self._least_m + AHEAD_m).gap_m - self._least_m
        own_m = [
            least_gap(at, at, pairs, MARGIN_m + AHEAD_m).gap_m - MARGIN_m
            for pairs, at in zip(self._own_pairs, (one, two), strict=True)
        ]
        return min(AHEAD_m, between_m, *own_m)

    def backed_off(self, poses_rad: Poses) -> Poses | None:
        """Both tips a little back along the last links; None if an arm cannot."""
        off = [back.off(q_rad) for back, q_rad in zip(self._backs, poses_rad, strict=True)]
        return None if off[0] is None or off[1] is None else [off[0], off[1]]

    def is_way_clear(self, start_rad: Poses, end_rad: Poses) -> bool:
        """Of a joint move of both, which begin and end together; the ends themselves are not looked at.

        By conservative advancement: parts that have a distance to spare cannot meet before they have moved that far.
        """
        start, end = ([np.array(q_rad) for q_rad in poses] for poses in (start_rad, end_rad))
        moved_m = sum(
            float(np.abs(b - a) @ levers) for a, b, levers in zip(start, end, self._levers_m, strict=True)
        )
        share = STEP_m / max(moved_m, STEP_m)
        while share < 1.0:
            first, second = (a + share * (b - a) for a, b in zip(start, end, strict=True))
            to_spare_m = self._to_spare_m(first.tolist(), second.tolist())
            if to_spare_m < 0.0:
                return False
            share += max(to_spare_m, STEP_m) / moved_m
        return True

    def way(self, start_rad: Poses, goal_rad: Poses) -> Sequence[Poses] | None:
        """Poses to move to in turn, both arms together, until `goal_rad`; None if no such way is clear.

        Straight there, else by way of the rest poses, where one arm may wait until the other has left.
        """
        for way in self._ways(start_rad, goal_rad):
            if not all(self.is_clear(*via) for via in way[:-1]):
                continue
            if all(self.is_way_clear(a, b) for a, b in pairwise((start_rad, *way))):
                return way
        return None

    def _ways(self, start_rad: Poses, goal_rad: Poses) -> Iterator[Sequence[Poses]]:
        yield (goal_rad,)
        rest = self.rest_rad
        leave = ((), ((rest[0], start_rad[1]),), ((start_rad[0], rest[1]),))
        arrive = ((), ((rest[0], goal_rad[1]),), ((goal_rad[0], rest[1]),))
        for first, last in product(leave, arrive):
            yield (*first, rest, *last, goal_rad)


def _levers_m(arm: Arm) -> Array:
    """(joints,): how far a part can be from each joint's axis, so how far it moves at most for a turn of 1 rad."""
    lengths_m = [math.hypot(row.d_m, row.L_m) for row in arm.links]
    lengths_m[-1] += math.hypot(*arm.tool.position_m)
    beyond_m = np.cumsum(lengths_m[::-1])[::-1]
    return frozen(beyond_m[[row.joint == "revolute" for row in arm.links]])


def _apart(body: ArmBody, rest_rad: Sequence[float]) -> tuple[tuple[int, int], ...]:
    """Pairs of the arm's own links that the margin is for: those of a wrist whose axes meet always touch."""
    at = body.at(rest_rad)
    return tuple(pair for pair in body.own_pairs if least_gap(at, at, (pair,), MARGIN_m).gap_m >= MARGIN_m)


class _Back:
    """Poses with the tip a little back along the last link."""

    def __init__(self, arm: Arm) -> None:
        self._inverse, self._corners = InverseKinematics(arm), ArmBody(Placed(arm), 0.0)

    def off(self, q_rad: Sequence[float]) -> Sequence[float] | None:
        """Such a pose near `q_rad`; None if the arm cannot."""
        last = self._corners.at(q_rad)[-2]
        along = np.array([last.dx, last.dy, last.dz])
        tip = np.array([last.x, last.y, last.z]) + along
        back = tip - AWAY_m * along / np.linalg.norm(along)
        try:
            return self._inverse.nearest(back.tolist(), q_rad)
        except ArmError:
            return None


def _rest_rad(arm: Arm) -> Sequence[float]:
    return arm.rest.q_rad if arm.rest is not None else (0.0,) * arm.joint_count
