"""Rigid motion between two sets of points: the least-squares rotation and translation, one set or many at once.

Arun, Huang and Blostein 1987 (singular value decomposition), with Umeyama's 1991 correction: a rotation, never a
reflection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array


@dataclass(frozen=True, slots=True)
class Motion:
    """Seen = rotation @ board + shift_m, for one set or a stack of sets: rotation (..., 3, 3), shift_m (..., 3)."""

    rotation: Array
    shift_m: Array

    def of(self, board_m: Array) -> Array:
        """Board points (k, 3) moved: (..., k, 3)."""
        moved = board_m @ np.swapaxes(self.rotation, -1, -2) + self.shift_m[..., None, :]
        return np.asarray(moved)


def best_motion(board_m: Array, seen_m: Array, may_mirror: bool = False) -> Motion:
    """The motion with the least sum of squared distances; board_m and seen_m (..., k, 3).

    With `may_mirror` a reflection is used if it fits better.
    """
    board_centre = board_m.mean(axis=-2, keepdims=True)
    seen_centre = seen_m.mean(axis=-2, keepdims=True)
    moments = np.swapaxes(seen_m - seen_centre, -1, -2) @ (board_m - board_centre)
    u, _, vt = np.linalg.svd(moments)
    if not may_mirror:
        turned = np.array(u)
        turned[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
        u = turned
    rotation = np.asarray(u @ vt)
    shift = seen_centre - board_centre @ np.swapaxes(rotation, -1, -2)
    return Motion(rotation, shift[..., 0, :])


def squares_m2(motion: Motion, board_m: Array, seen_m: Array) -> Array:
    """Squared distance of every point: (..., k)."""
    return np.asarray(np.sum((seen_m - motion.of(board_m)) ** 2, axis=-1))


def pose_jacobian(rotated_m: Array) -> Array:
    """Derivative of points by a motion's shift and small turn: rotated_m (k, 3) to (k, 3, 6).

    rotated_m are the points relative to the centre of the turn, in the frame of the shift.
    """
    x, y, z = rotated_m.T
    jacobian = np.zeros((len(rotated_m), 3, 6))
    jacobian[:, :, :3] = np.eye(3)
    jacobian[:, 0, 4], jacobian[:, 0, 5] = z, -y
    jacobian[:, 1, 3], jacobian[:, 1, 5] = -z, x
    jacobian[:, 2, 3], jacobian[:, 2, 4] = y, -x
    return jacobian
