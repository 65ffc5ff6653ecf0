"""Frames of all links for many poses, needed for effects that act on a link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arrays import Array


@dataclass(frozen=True, slots=True)
class LinkFrames:
    """Frames 0 (base) to L (last link) of m poses: origins (m, L + 1, 3) and axes (m, L + 1, 3, 3; columns x, y, z).

    tip_m (m, 3). Base frame.
    """

    origin_m: Array
    axes: Array
    tip_m: Array

    def point_m(self, link: int, position_m: Array) -> Array:
        """A point (3,) of a link's frame (0: base) in the base frame, (m, 3)."""
        return np.asarray(self.origin_m[:, link] + self.axes[:, link] @ np.asarray(position_m))


def link_frames(model: ArmModel, dh: Array, q_rad: Array, tool_m: Array | None = None) -> LinkFrames:
    """Of the poses (m, n) of an arm with DH table (links, 4)."""
    m = len(q_rad)
    origin, axes = np.zeros((m, len(dh) + 1, 3)), np.zeros((m, len(dh) + 1, 3, 3))
    axes[:, 0] = np.eye(3)
    angles = iter(q_rad.T)
    for k, ((d, theta, length, alpha), turns) in enumerate(zip(dh, model.joints, strict=True)):
        about = theta + (next(angles) if turns else np.zeros(m))
        moves = [(2, d, about), (0, length, np.full(m, alpha))]
        point, turned = origin[:, k], axes[:, k]
        for axis, move, turn in moves[::-1] if model.is_modified else moves:
            point = point + move * turned[:, :, axis]
            turned = turned @ _turns(axis, turn)
        origin[:, k + 1], axes[:, k + 1] = point, turned
    tool = model.nominal_tool_m if tool_m is None else tool_m
    return LinkFrames(origin, axes, origin[:, -1] + axes[:, -1] @ tool)


def _turns(axis: int, angle_rad: Array) -> Array:
    """Rotations (m, 3, 3) about x (0) or z (2)."""
    turn = np.zeros((len(angle_rad), 3, 3))
    i, j = (1, 2) if axis == 0 else (0, 1)
    turn[:, axis, axis] = 1.0
    turn[:, i, i] = turn[:, j, j] = np.cos(angle_rad)
    turn[:, j, i] = np.sin(angle_rad)
    turn[:, i, j] = -turn[:, j, i]
    return turn
