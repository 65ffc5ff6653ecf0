"""Rotations: unit quaternions (w, x, y, z), matrices, and rotation vectors (axis times angle), for batches of m.

    exp(r) = I + sin(a)/a [r] + (1 - cos(a))/a^2 [r]^2,   a = |r|                 (Rodrigues)
    angular velocity of R0 exp(r(t)) in R0's frame: L(r) dr/dt,
    L(r) = I + (1 - cos(a))/a^2 [r] + (a - sin(a))/a^3 [r]^2

[r] is the matrix of the cross product with r.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from control.errors import BadTarget

Array = NDArray[np.float64]
Quaternion = tuple[float, float, float, float]
# A quaternion in a file has three decimals or more; one that is further from length 1 is something else.
_UNIT = 2e-3
_SMALL_RAD = 1e-4  # below it the series' next term is under 1e-17


def checked_quaternion(values: Sequence[float]) -> Quaternion:
    """Return four finite numbers w, x, y, z scaled to length 1. BadTarget if their length is not 1 within 0.002."""
    numbers = [float(value) for value in values]
    length = math.hypot(*numbers)
    if len(numbers) != 4 or not abs(length - 1.0) <= _UNIT:  # NaN comes here, too
        raise BadTarget(
            f"orientation: expected a unit quaternion w, x, y, z (length 1 within {_UNIT:g}), got {numbers}"
            + (f" of length {length:.4g}" if len(numbers) == 4 else "")
        )
    w, x, y, z = (value / length for value in numbers)
    return w, x, y, z


def matrices(quaternions: Array) -> Array:
    """Rotation matrices (m, 3, 3) of unit quaternions (m, 4)."""
    w, x, y, z = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternions(rotations: Array) -> Array:
    """Unit quaternions (m, 4) with w >= 0 of rotation matrices (m, 3, 3)."""
    vectors = logarithms(rotations)
    half = 0.5 * np.linalg.norm(vectors, axis=1)
    return np.column_stack((np.cos(half), 0.5 * np.sinc(half / np.pi)[:, None] * vectors))


def quaternion_of(rows: Sequence[Sequence[float]]) -> Quaternion:
    """Unit quaternion with w >= 0 of one rotation matrix, in plain floats: each square from the diagonal, the largest divides."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    squares = (1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i)
    columns = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    w, x, y, z = columns[max(range(4), key=squares.__getitem__)]
    length = math.copysign(math.hypot(w, x, y, z), w if w else 1.0)
    return w / length, x / length, y / length, z / length


def logarithms(rotations: Array) -> Array:
    """Rotation vectors (m, 3), at most pi long, of rotation matrices (m, 3, 3)."""
    r = rotations
    odd = 0.5 * np.stack((r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]), axis=1)
    sine = np.linalg.norm(odd, axis=1)
    cosine = 0.5 * (np.trace(r, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    is_far = (cosine < 0.0) & (sine < 0.1)  # near half a turn the odd part says little about the axis
    scale = np.where(sine > _SMALL_RAD, angle / np.where(sine > 0.0, sine, 1.0), 1.0 + sine * sine / 6.0)
    vectors = scale[:, None] * odd
    if is_far.any():
        vectors[is_far] = _near_half_turn(r[is_far], odd[is_far], angle[is_far])
    return np.asarray(vectors)


def _near_half_turn(rotations: Array, odd: Array, angle: Array) -> Array:
    """The axis from the largest column of R + R' = 2 cos(a) I + 2 (1 - cos(a)) axis axis'."""
    even = 0.5 * (rotations + np.swapaxes(rotations, 1, 2)) - np.cos(angle)[:, None, None] * np.eye(3)
    largest = np.argmax(np.diagonal(even, axis1=1, axis2=2), axis=1)
    axes = even[np.arange(len(even)), largest]
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    sense = np.where(np.sum(axes * odd, axis=1) < 0.0, -1.0, 1.0)
    return np.asarray((sense * angle)[:, None] * axes)


def exponentials(vectors: Array) -> Array:
    """Rotation matrices (m, 3, 3) of rotation vectors (m, 3)."""
    a2, k = _squares(vectors), cross_matrices(vectors)
    a = np.sqrt(a2)[:, None, None]
    return np.asarray(np.eye(3) + np.sinc(a / np.pi) * k + _half_cosine(a2)[:, None, None] * (k @ k))


def left_jacobians(vectors: Array) -> Array:
    """L(r) (m, 3, 3): angular velocity of exp(r(t)) is L(r) dr/dt, in the frame that exp(r) turns."""
    a2, k = _squares(vectors), cross_matrices(vectors)
    safe = np.where(a2 > _SMALL_RAD, a2, 1.0)
    a = np.sqrt(safe)
    cubic = np.where(a2 > _SMALL_RAD, (a - np.sin(a)) / (safe * a), 1.0 / 6.0 - a2 / 120.0)
    return np.asarray(np.eye(3) + _half_cosine(a2)[:, None, None] * k + cubic[:, None, None] * (k @ k))


def _half_cosine(a2: Array) -> Array:
    """(1 - cos(a)) / a^2 from a^2, exact for small angles: half of the squared sinc of a/2."""
    return np.asarray(0.5 * np.sinc(0.5 * np.sqrt(a2) / np.pi) ** 2)


def _squares(vectors: Array) -> Array:
    return np.asarray(np.einsum("mi,mi->m", vectors, vectors))


def cross_matrices(vectors: Array) -> Array:
    """[r] (m, 3, 3): [r] v is the cross product r x v."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.moveaxis(np.array([[o, -z, y], [z, o, -x], [-y, x, o]]), 2, 0)


def between(start: Sequence[float], end: Sequence[float]) -> Array:
    """The rotation vector (3,) [rad] that turns one orientation into another, in the frame of `start`; the shorter way."""
    first, last = matrices(np.array([start, end], dtype=np.float64))
    return np.asarray(logarithms((first.T @ last)[None])[0])
