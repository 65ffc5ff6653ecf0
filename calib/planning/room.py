"""Where an arm may go, wherever its table stands, and from where it comes to a pose without a gear turning over there."""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.arrays import Array, Mask
from calib.design.candidates import TOUCH_M, body_points
from calib.gap.plan.collision_free_box import CLEARANCE_m, ground_m
from calib.gap.plan.poses import APPROACH_rad
from control.kinematics.corners import Corners
from control.model.arm import Arm
from control.safety.workspace import LinkThickness, Workspace

ROUNDING_m: Final = 1e-6
AHEAD: Final = (1.0, 0.5)  # of the way of a lead-in that are looked at, besides its end


def lead_in_of(q_rad: Array, direction: Array) -> Array:
    """Where to come from, so that every joint arrives in this direction (m, n)."""
    return np.asarray(q_rad - APPROACH_rad * direction)


def table_m(arm: Arm) -> float:
    """Height of the table's origin; of the floor without one."""
    table = arm.table
    return table.origin_m[2] if table is not None and table.origin_m is not None else arm.limits.floor_z_m


class Room:
    """The joints' ranges, floor, table and own base of an arm; `arm` of the methods is the same with its table moved."""

    def __init__(self, arm: Arm) -> None:
        self._corners = Corners(arm)
        self._lowest_table_m = min(table_m(arm), arm.limits.floor_z_m)
        self._body = LinkThickness(self._corners.radii_m, self._corners.first_free)

    def holds(self, arm: Arm, q_rad: Array) -> bool:
        """Whether the loop's guard lets the arm be at all of these poses (m, n)."""
        return bool(self._may_be(arm, q_rad).all())

    def has_lead_in(self, arm: Arm, q_rad: Array, direction: Array) -> Mask:
        """Which poses (m, n) can be come to in these directions (m,).

        No part of the arm is below floor or board at the pose, and none is lower on the way to it, unless well clear.
        """
        lower, upper = np.array(arm.limits_rad).T
        ways = np.stack([q_rad, *(q_rad + share * (lead_in_of(q_rad, direction) - q_rad) for share in AHEAD)])
        flat = ways.reshape(-1, q_rad.shape[1])
        heights = body_points(arm, flat)[:, :, 2]
        moving = np.ptp(heights, axis=0) > ROUNDING_m
        heights = heights[:, moving].reshape(len(ways), len(q_rad), -1)
        least = np.minimum(heights[0], ground_m(arm) + CLEARANCE_m) - ROUNDING_m
        is_right = ((flat >= lower) & (flat <= upper)).all(axis=1) & self._may_be(arm, flat)
        is_clear = (heights >= least).all(axis=(0, 2)) & (heights[0] >= ground_m(arm) - TOUCH_M).all(axis=1)
        return np.asarray(is_right.reshape(len(ways), -1).all(axis=0) & is_clear)

    def _may_be(self, arm: Arm, q_rad: Array) -> Mask:
        # The floor ends at a board that is let into it, but not where a plan puts one.
        found = np.full(len(q_rad), table_m(arm) >= self._lowest_table_m - ROUNDING_m)
        for distance_m, _ in Workspace.of(arm).clearances(self._corners.batch(q_rad), self._body):
            found &= distance_m >= -ROUNDING_m
        return found
