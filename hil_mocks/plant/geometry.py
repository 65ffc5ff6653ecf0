"""Denavit-Hartenberg frames as MuJoCo bodies: pose of a body in its parent at joint angle zero, and its hinge.

Written for the plant only and independent of control.kinematics.kinematics, so that testing one against the other is
meaningful. Frames and signs: Siciliano et al., Robotics (2009), section 2.8 (standard); Craig, Introduction to Robotics (2005),
section 3.4 (modified).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Convention = Literal["standard", "modified"]
DH_KEYS = ("d_m", "theta_rad", "L_m", "alpha_rad")


class DhLink(Protocol):
    """Geometry of a link of arm.toml."""

    @property
    def d_m(self) -> float: ...
    @property
    def theta_rad(self) -> float: ...
    @property
    def L_m(self) -> float: ...
    @property
    def alpha_rad(self) -> float: ...


@dataclass(frozen=True, slots=True)
class LinkFrame:
    """A link frame in its parent's at joint angle zero, with the hinge's axis and anchor in the link's own frame."""

    position_m: Matrix  # (3,)
    rotation: Matrix  # (3, 3)
    axis: Matrix  # (3,) unit vector
    anchor_m: Matrix  # (3,)


def rotation_x(angle_rad: float) -> Matrix:
    """Rotation about x, (3, 3)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle_rad: float) -> Matrix:
    """Rotation about z, (3, 3)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def standard_frame(d_m: float, theta_rad: float, L_m: float, alpha_rad: float) -> LinkFrame:
    """Tz(d) Rz(theta) Tx(L) Rx(alpha): the hinge is the parent's z axis, seen from the link's frame."""
    turn = rotation_z(theta_rad)
    rotation = turn @ rotation_x(alpha_rad)
    position_m = turn @ np.array([L_m, 0.0, 0.0]) + np.array([0.0, 0.0, d_m])
    return LinkFrame(position_m, rotation, rotation.T @ np.array([0.0, 0.0, 1.0]), -rotation.T @ position_m)


def modified_frame(d_m: float, theta_rad: float, L_m: float, alpha_rad: float) -> LinkFrame:
    """Rx(alpha) Tx(L) Rz(theta) Tz(d): the hinge is the link's own z axis."""
    tilt = rotation_x(alpha_rad)
    rotation = tilt @ rotation_z(theta_rad)
    position_m = tilt @ np.array([L_m, 0.0, d_m])
    return LinkFrame(position_m, rotation, np.array([0.0, 0.0, 1.0]), np.zeros(3))


def true_frame(link: DhLink, deviation: Mapping[str, float], convention: Convention) -> LinkFrame:
    """Frame of a link whose DH parameters are off nominal by `deviation` (keys of DH_KEYS; absent: 0)."""
    d, theta, length, alpha = (float(getattr(link, key)) + deviation.get(key, 0.0) for key in DH_KEYS)
    place = standard_frame if convention == "standard" else modified_frame
    return place(d, theta, length, alpha)
