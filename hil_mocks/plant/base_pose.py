"""Pose of the arm's base in the world of camera, table and hand: the effect `base_frame`.

The world is the frame of table and camera; the effect is its pose in the arm's base frame: an origin and a rotation
vector. The physics runs in the base frame, with the gravity of arm.toml; camera and hand use this conversion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class BasePose:
    """The world's frame in the arm's base frame; the default is an arm at its nominal base pose."""

    origin_m: Point = (0.0, 0.0, 0.0)
    turn_rad: Point = (0.0, 0.0, 0.0)

    @property
    def is_nominal(self) -> bool:
        """Whether base frame and world are the same."""
        return not any((*self.origin_m, *self.turn_rad))

    def in_world(self, base_m: Sequence[float]) -> Point:
        """Convert a point of the base frame to the world."""
        shifted = np.subtract(base_m, self.origin_m)
        return self._turned(shifted, -1.0)

    def in_base(self, world_m: Sequence[float]) -> Point:
        """Convert a point of the world to the base frame."""
        return _point(np.add(self._turned(np.asarray(world_m, dtype=float), 1.0), self.origin_m))

    def _turned(self, vector: np.ndarray, sense: float) -> Point:
        angle_rad = float(np.linalg.norm(self.turn_rad))
        quaternion, turned = np.zeros(4), np.zeros(3)
        axis = np.array(self.turn_rad) / angle_rad if angle_rad > 0.0 else np.array([0.0, 0.0, 1.0])
        mujoco.mju_axisAngle2Quat(quaternion, axis, sense * angle_rad)
        mujoco.mju_rotVecQuat(turned, vector, quaternion)
        return _point(turned)


NOMINAL: Final = BasePose()


def _point(values: np.ndarray) -> Point:
    x, y, z = values.tolist()
    return x, y, z
