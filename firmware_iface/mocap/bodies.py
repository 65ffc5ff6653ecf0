"""What every motion capture system says: where rigid bodies are in its own frame, frame by frame. Plain floats.

Positions in m, orientations as unit quaternions w, x, y, z that turn the body's axes into those of the system's frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
UNIT_TOLERANCE = 1e-3  # of a quaternion in single precision, and of a rotation matrix's columns


@dataclass(frozen=True, slots=True)
class RigidPose:
    """A rigid motion: p -> turned(quaternion, p) + position_m."""

    position_m: Vector
    quaternion: Quaternion


NOWHERE = RigidPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))  # of a body that is hidden


@dataclass(frozen=True, slots=True)
class SeenBody:
    """A body in one frame. error_m: the system's own mean residual of its markers, None where it says none."""

    name: str
    pose: RigidPose
    is_visible: bool = True
    error_m: float | None = None


@dataclass(frozen=True, slots=True)
class BodyFrame:
    """All bodies of one picture. time_s: of the system's own clock, None where it says none."""

    number: int
    bodies: tuple[SeenBody, ...]
    time_s: float | None = None


class BodyStream(Protocol):
    """An open stream. It never blocks; `rejected` counts packets that were not understood."""

    name: str
    rejected: int

    def receive(self) -> list[BodyFrame]:
        """All frames received so far, in order of arrival. LinkLost if the connection is gone."""

    def close(self) -> None:
        """End the stream."""


def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """The turn `b`, then the turn `a`."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def opposite(q: Quaternion) -> Quaternion:
    """The turn back."""
    return q[0], -q[1], -q[2], -q[3]


def turned(q: Quaternion, v: Vector) -> Vector:
    """A vector after a turn."""
    _, x, y, z = product(product(q, (0.0, *v)), opposite(q))
    return x, y, z


def unit(q: Sequence[float]) -> Quaternion | None:
    """The quaternion scaled to length 1; None if it is none within the tolerance."""
    length = math.hypot(*q)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:  # NaN comes here, too
        return None
    w, x, y, z = (value / length for value in q)
    return w, x, y, z


def angle_rad(a: Quaternion, b: Quaternion) -> float:
    """The angle between two orientations, 0 to pi."""
    w, x, y, z = product(opposite(a), b)
    return 2.0 * math.atan2(math.hypot(x, y, z), abs(w))


def compose(outer: RigidPose, inner: RigidPose) -> RigidPose:
    """a_T_c from a_T_b and b_T_c."""
    x, y, z = turned(outer.quaternion, inner.position_m)
    a, b, c = outer.position_m
    return RigidPose((a + x, b + y, c + z), product(outer.quaternion, inner.quaternion))


def inverse(pose: RigidPose) -> RigidPose:
    """b_T_a from a_T_b."""
    back = opposite(pose.quaternion)
    x, y, z = turned(back, pose.position_m)
    return RigidPose((-x, -y, -z), back)
