"""Frames of reference points: a board in one setup, or the base frame of camera and table.

A deviation of a frame is a translation t and a rotation vector w about the centre of its points:
p_base = anchor + t + exp([w]x) R0 (p - centre), anchor = R0 centre + origin. Rotating about the centre of the points
decouples translations and rotations.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen

AXES = ("x", "y", "z", "rx", "ry", "rz")
AXIS_UNITS = ("m", "m", "m", "rad", "rad", "rad")


@dataclass(frozen=True, slots=True)
class Frame:
    """Prior base_T_frame: rotation (3, 3), origin_m (3,); identified if `is_free`.

    `is_placed` is False if its pose is unknown: the identification then starts from the arm's prediction.
    """

    name: str
    rotation: Array
    origin_m: Array
    is_free: bool = False
    is_placed: bool = True

    @classmethod
    def unplaced(cls, name: str) -> Frame:
        """A frame with an unknown pose."""
        return cls(name, frozen(np.eye(3)), frozen(np.zeros(3)), is_free=True, is_placed=False)

    @classmethod
    def base(cls, is_free: bool = False) -> Frame:
        """The arm's base frame, as used by camera or table."""
        return cls("base", frozen(np.eye(3)), frozen(np.zeros(3)), is_free)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """base_x ... base_rz: a translation [m] and a rotation [rad] in the base frame's axes."""
        return tuple(f"{self.name}_{axis}" for axis in AXES)

    def to_base(self, points_m: Array) -> Array:
        """Points (m, 3) of the frame in the base frame."""
        return np.asarray(points_m @ self.rotation.T + self.origin_m)

    def moved(self, centre_m: Array, move: Array) -> Frame:
        """The frame after a deviation (6,): t and w about `centre_m` (3,), a point of the frame."""
        turned = rotation_of(move[3:]) @ self.rotation
        origin = self.to_base(centre_m) + move[:3] - turned @ centre_m
        return Frame(self.name, frozen(turned), frozen(origin), self.is_free)


def seen_less_far_m(place_m: Array, moved: Array) -> Array:
    """Places (m, 3) less where they are taken to be once their frame has moved by (6,): a translation and a rotation vector."""
    return np.asarray(place_m - place_m @ rotation_of(moved[3:]).T - moved[:3])


def rotation_of(vector_rad: Array) -> Array:
    """exp([w]x), (3, 3): Rodrigues' formula."""
    angle = float(np.linalg.norm(vector_rad))
    cross = cross_matrix(vector_rad)
    if angle < 1e-8:
        return np.asarray(np.eye(3) + cross + 0.5 * cross @ cross)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * cross @ cross)


def rotation_vector(rotation: Array) -> Array:
    """The w, (3,), |w| <= pi, with exp([w]x) = rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def mean_rotation(rotations: Array) -> Array:
    """The rotation (3, 3) nearest to rotations (r, 3, 3) in the least squares sense: their projected mean (Moakher, 2002)."""
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def left_jacobian(vector_rad: Array) -> Array:
    """J (3, 3) with exp([w + dw]x) = exp([J dw]x) exp([w]x) to first order (Barfoot, State Estimation for Robotics)."""
    angle = float(np.linalg.norm(vector_rad))
    cross = cross_matrix(vector_rad)
    if angle < 1e-4:
        return np.asarray(np.eye(3) + 0.5 * cross + cross @ cross / 6.0)
    return np.asarray(np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross)


def turned_slope(vector_rad: Array, torque: Array) -> Array:
    """Derivative (3, 3) of J(w)' t by w, with the J of `left_jacobian` and a fixed t (3,).

    J' t = t - a w x t + b w x (w x t), with a = (1 - cos |w|) / |w|^2 and b = (|w| - sin |w|) / |w|^3.
    """
    w, square = vector_rad, float(vector_rad @ vector_rad)
    if square < 0.01:  # where the quotients lose their digits; the next terms are below 1e-11
        a, b = 0.5 - square / 24.0 + square**2 / 720.0, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0
        by_a = -1.0 / 12.0 + square / 180.0 - square**2 / 6720.0
        by_b = -1.0 / 60.0 + square / 1260.0 - square**2 / 60480.0
    else:
        angle = math.sqrt(square)
        a, b = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
        by_a, by_b = (1.0 - b * square - 2.0 * a) / square, (a - 3.0 * b) / square
    twist, arm = cross_matrix(w), cross_matrix(torque)
    across = twist @ torque
    along = by_b * (twist @ across) - by_a * across
    return np.asarray(np.outer(along, w) + a * arm - b * (cross_matrix(across) + twist @ arm))


def cross_matrix(vector: Array) -> Array:
    """[v]x: the matrix of v x."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
