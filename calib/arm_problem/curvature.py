"""Second derivatives of an arm's residuals for Newton's method, summed over poses with a weight vector each.

A rotation about an axis e moves everything beyond it, so with the derivative J_b of the tip by a parameter b beyond the
rotation a, or by a itself, d2 tip / da db = e x J_b; a translation changes no derivative beyond it. With weights p the sum
over poses is (p x e) . J_b: one product of matrices.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arm_problem.frames import left_jacobian
from calib.arrays import Array, slim_product

DIFFERENCE_rad = 1e-6
Order = npt.NDArray[np.intp]


def chain_curvature(columns: Array, weight: Array, is_modified: bool) -> Array:
    """Sum of weight . d2 tip / dx2, (k, k), for the k parameters of DH table and tool.

    `columns` (k, 3, m): derivatives of the tip by dh.ravel() and by nothing or the tool; `weight` (3, m). Modified DH has
    L and alpha before d and theta.
    """
    k = len(columns)
    turns = np.arange(1, k - k % 4, 2)  # theta and alpha; the translation before each is along its axis
    order = _order(k, is_modified)
    levers = crossed(weight, columns[turns - 1])
    product = slim_product(levers.reshape(len(turns), -1), columns.reshape(k, -1))
    found = np.zeros((k, k))
    beyond = order[turns][:, None] <= order[None, :]
    found[turns] = np.where(beyond, product, 0.0)
    return _mirrored(found, order)


def joint_curvature(columns: Array, weight: Array, is_modified: bool, joint: int) -> Array:
    """Weight . d2 tip / d theta dx of every pose, (k, m), for the theta at `joint` of dh.ravel(); as chain_curvature."""
    k = len(columns)
    order = _order(k, is_modified)
    found = np.zeros((k, columns.shape[2]))
    beyond = order >= order[joint]
    found[beyond] = np.einsum("im,kim->km", crossed(weight, columns[joint - 1]), columns[beyond])
    before = np.array([b for b in range(1, k - k % 4, 2) if not beyond[b]], dtype=np.intp)
    found[before] = np.einsum("kim,im->km", crossed(weight, columns[before - 1]), columns[joint])
    return found


def frame_curvature(arms: Array, weight: Array, turn_rad: Array) -> Array:
    """Sum of weight . d2 reference / dw2, (3, 3), for a frame's rotation w (3,); arms (m, 3), weight (3, m).

    The first derivative is J(w) e_a x arm, so the second is (dJ/dw_b e_a) x arm + J e_a x (J e_b x arm).
    """
    turns = left_jacobian(turn_rad)
    moments = weight @ arms  # sum of weight arm'
    torque = np.array(
        [moments[2, 1] - moments[1, 2], moments[0, 2] - moments[2, 0], moments[1, 0] - moments[0, 1]]
    )
    found = turns.T @ moments.T @ turns - np.trace(moments) * turns.T @ turns
    for b, unit in enumerate(np.eye(3)):
        step = DIFFERENCE_rad * unit
        found[:, b] += (
            (left_jacobian(turn_rad + step) - left_jacobian(turn_rad - step)).T
            @ torque
            / (2.0 * DIFFERENCE_rad)
        )
    return np.asarray(0.5 * (found + found.T))


def crossed(weight: Array, axes: Array) -> Array:
    """Weight x axes along the coordinate: (3, m) and (..., 3, m)."""
    found = np.empty_like(axes)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(weight[j], axes[..., k, :], out=found[..., i, :])
        found[..., i, :] -= weight[k] * axes[..., j, :]
    return found


def _order(k: int, is_modified: bool) -> Order:
    """Order of the parameters along the chain; two that share an axis are in the order of dh.ravel()."""
    order = np.arange(k)
    return np.where(order < k - k % 4, order ^ 2, order) if is_modified else order


def _mirrored(found: Array, order: Order) -> Array:
    """Make the matrix symmetric: copy entries (a, b), a before b, to (b, a)."""
    later = order[:, None] > order[None, :]
    return np.where(later, found.T, found)
