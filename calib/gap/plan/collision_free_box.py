"""A box of joint angles in which the whole arm is clear of floor and board, whatever way it takes.

Every straight joint move and every motion between two of its poses stays in the box, so that what is planned inside needs no
ways around anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, Mask
from calib.design.candidates import body_points, joint_box, spread_poses
from calib.errors import CalibrationError
from control.dynamics.static_pose import gravity_Nm
from control.errors import MissingModel
from control.model.arm import Arm

CLEARANCE_m = 0.06  # of an arm that is not calibrated and may be 3 cm off
LOOKED_AT = 3000  # poses spread over the box
CUT = 0.04  # of a joint's range, taken off one end at a time
LEAST_rad = 0.5  # of a joint's travel that a recording needs to tell anything
STARTS = 40  # boxes to begin with: cutting is greedy
NO_PULL_Nm = 0.02  # less is no pull


@dataclass(frozen=True, slots=True)
class CollisionFreeBox:
    """Lower and upper joint angles (n,) of the box."""

    lower_rad: Array
    upper_rad: Array

    @property
    def middle_rad(self) -> Array:
        """The box's middle (n,)."""
        return 0.5 * (self.lower_rad + self.upper_rad)

    @property
    def width_rad(self) -> Array:
        """By how much each joint may turn (n,)."""
        return self.upper_rad - self.lower_rad

    def at(self, share: Array) -> Array:
        """Poses (..., n) from shares of the box, 0 to 1."""
        return np.asarray(self.lower_rad + share * self.width_rad)

    def inset(self, margin_rad: float) -> CollisionFreeBox:
        """The same with so much kept free at every end."""
        return CollisionFreeBox(self.lower_rad + margin_rad, self.upper_rad - margin_rad)

    def holds(self, q_rad: Array) -> bool:
        """Whether all poses (..., n) are inside."""
        rounding = 1e-9
        return bool(((q_rad >= self.lower_rad - rounding) & (q_rad <= self.upper_rad + rounding)).all())


def collision_free_box(arm: Arm, clearance_m: float = CLEARANCE_m) -> CollisionFreeBox:
    """The best box that cutting ends off the joints' ranges leads to; the same every time.

    Best: wide, and with gravity pulling every joint both ways, so that a gear's flanks show. CalibrationError where a joint has
    no room left.
    """
    lower, upper = joint_box(arm)
    poses = spread_poses((lower, upper), LOOKED_AT)
    is_clear = clear(arm, poses, clearance_m)
    pull_Nm = _gravity_Nm(arm, poses)
    cut = CUT * (upper - lower)
    draw = np.random.default_rng(0)
    found: tuple[float, CollisionFreeBox] | None = None
    for start in range(STARTS):
        ends = draw.uniform(0.0, 0.4 if start else 0.0, (2, len(lower))) * (upper - lower)
        room = _grown_down(poses, is_clear, CollisionFreeBox(lower + ends[0], upper - ends[1]), cut)
        worth = -np.inf if room is None else _worth(room, poses, pull_Nm)
        if room is not None and (found is None or worth > found[0]):
            found = (worth, room)
    if found is None:
        raise CalibrationError(
            f"arm {arm.name}: no collision-free box of joint angles: expected {LEAST_rad:g} rad or more for each joint,"
            f" {1e3 * clearance_m:g} mm clear of floor and board"
        )
    return found[1]


def _worth(room: CollisionFreeBox, poses: Array, pull_Nm: Array | None) -> float:
    """Logarithm of the box's volume, and of the part of it in which gravity pulls the way that it seldom does."""
    worth = float(np.log(room.width_rad).sum())
    if pull_Nm is None:
        return worth
    inside = pull_Nm[((poses >= room.lower_rad) & (poses <= room.upper_rad)).all(axis=1)]
    pulled = np.abs(pull_Nm).max(axis=0) > NO_PULL_Nm
    up, down = (inside > NO_PULL_Nm).mean(axis=0), (inside < -NO_PULL_Nm).mean(axis=0)
    return worth + float(np.log(np.minimum(up, down) + 0.02)[pulled].sum())


def _gravity_Nm(arm: Arm, poses: Array) -> Array | None:
    """What gravity asks of the joints (m, n); None where the arm's file lacks masses."""
    try:
        return gravity_Nm(arm, poses)
    except MissingModel:
        return None


def _grown_down(poses: Array, is_clear: Mask, room: CollisionFreeBox, cut: Array) -> CollisionFreeBox | None:
    """Ends cut off until all of the box is clear; None where that leaves too little."""
    lower, upper = room.lower_rad, room.upper_rad
    while True:
        inside = ((poses >= lower) & (poses <= upper)).all(axis=1)
        bad = poses[inside & ~is_clear]
        if ((upper - lower) < LEAST_rad).any() or not inside.any():
            return None
        if not len(bad):
            return CollisionFreeBox(lower, upper)
        lower, upper = _cut(poses[inside & is_clear], bad, lower, upper, cut)


def clear(arm: Arm, q_rad: Array, clearance_m: float = CLEARANCE_m) -> Mask:
    """Which poses (m, n) keep every part that moves so far above floor and board (m,)."""
    heights = body_points(arm, q_rad)[:, :, 2]
    moves = np.ptp(heights, axis=0) > 1e-6 if len(heights) > 1 else np.ones(heights.shape[1], dtype=bool)
    return np.asarray((heights[:, moves] >= ground_m(arm) + clearance_m).all(axis=1))


def ground_m(arm: Arm) -> float:
    """Height of the board's top or of the floor that may be touched, whichever is higher."""
    board = arm.table
    top_m = board.origin_m[2] if board is not None and board.origin_m is not None else arm.limits.floor_z_m
    return max(arm.limits.floor_z_m + arm.limits.floor_clearance_m, top_m)


def _cut(good: Array, bad: Array, lower: Array, upper: Array, cut: Array) -> tuple[Array, Array]:
    """Take off the slice that costs the fewest clear poses for each that is not."""
    choices = []
    for j in range(len(lower)):
        for is_upper in (False, True):
            edge = upper[j] - cut[j] if is_upper else lower[j] + cut[j]
            cost, gone = (int(np.sum((q[:, j] > edge) == is_upper)) for q in (good, bad))
            if gone:
                choices.append((cost / gone, j, is_upper))
    if not choices:  # what is bad lies in the middle: take off where most of the box is left
        j = int(np.argmax(upper - lower))
        choices = [(0.0, j, bool(np.median(bad[:, j]) > 0.5 * (lower[j] + upper[j])))]
    _, j, is_upper = min(choices)
    new_lower, new_upper = lower.copy(), upper.copy()
    if is_upper:
        new_upper[j] -= cut[j]
    else:
        new_lower[j] += cut[j]
    return new_lower, new_upper
