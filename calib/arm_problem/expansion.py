"""What a solver asks of a problem: residuals, and around one x the sums over poses that a Newton step needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import Parameter
from calib.arm_problem.observations import left_jacobian, turned_slope
from calib.arrays import Array, slim_product

ALL = slice(None)
Places = npt.NDArray[np.intp]


class Expanded(Protocol):
    """Residuals around one x, to second order."""

    @property
    def residuals(self) -> Array:
        """(m, 3) [m]."""

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Sums of pull . d residual / dx (k,) and of (d residual / dx)' bend (d residual / dx) (k, k)."""

    def curvature(self, pull: Array) -> Array:
        """Sum of pull . d2 residual / dx2, (k, k)."""


class Problem(Protocol):
    """The problem for the solver: unknowns x (k,) within +-limits, and residuals reference minus modelled [m].

    The Jacobian (m, 3, k) is a view of a contiguous (k, 3, m) array: jacobian.transpose(2, 1, 0) costs nothing.
    """

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The k unknowns, in the order of x."""

    def __len__(self) -> int:
        """Number of poses, m."""

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(m, 3) [m], of all poses or a slice of them."""

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """(m, 3) [m] and the derivative of the residuals (m, 3, k) [m per scaled unknown]."""

    def expanded(self, x: Array, rows: slice = ALL) -> Expanded:
        """The residuals, and sums of their derivatives for Newton's steps."""

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """(m, 3, k), of all poses or a slice of them: the Jacobian for zero residuals, which shows what the points determine."""


@dataclass(frozen=True, slots=True)
class Expansion:
    """Residuals (m, 3), and columns (K, 3, m): minus their derivatives by every parameter in its own unit.

    Parameters are the `chain_count` of DH table and tool, six per free frame, the corrections; `places` (k,) are those
    that are unknowns, `scale` (k,) their scales. The other fields are for second derivatives.
    """

    residuals: Array
    columns: Array
    places: Places
    scale: Array
    chain_count: int
    is_modified: bool
    frame_rows: tuple[Places, ...]
    frame_turns_rad: Array
    arms: Array
    theta_places: tuple[int, ...]
    corrections: tuple[Array, ...]

    def gradient(self, pull: Array) -> Array:
        """Sum of pull . d residual / dx, (k,), for pull (m, 3)."""
        return self.sums(pull, np.zeros((3, len(pull))))[0]

    def gram(self, bend: Array | None) -> Array:
        """Sum of (d residual / dx)' bend (d residual / dx), (k, k); bend (3, m), (3, 3, m), or None for ones."""
        return self.sums(np.zeros_like(self.residuals), bend)[1]

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Gradient and gram at once."""
        k = len(self.columns)
        right = np.empty((k + 1, *self.columns.shape[1:]))
        right[k] = pull.T
        _bend(bend, self.columns, right[:k])
        whole = slim_product(self.columns.reshape(k, -1), right.reshape(k + 1, -1))
        return -self.scale * whole[self.places, k], self._scaled(whole)

    def curvature(self, pull: Array) -> Array:
        """Sum of pull . d2 residual / dx2, (k, k), for pull (m, 3)."""
        weight = np.ascontiguousarray(pull.T)
        k, c = len(self.columns), self.chain_count
        whole = np.zeros((k, k))
        whole[:c, :c] = -chain_curvature(self.columns[:c], weight, self.is_modified)
        for place, rows in enumerate(self.frame_rows):
            turn = slice(c + 6 * place + 3, c + 6 * place + 6)
            whole[turn, turn] = frame_curvature(self.arms[rows], weight[:, rows], self.frame_turns_rad[place])
        if any(slope.any() for slope in self.corrections):
            self._bend_joints(whole, weight)
        return self._scaled(whole)

    def _bend_joints(self, whole: Array, weight: Array) -> None:
        """Second derivatives by the C corrections: through the n joints' angles, pose by pose."""
        c = self.chain_count
        slopes = np.stack(self.corrections).transpose(0, 2, 1)  # (C, n, m)
        turned = np.flatnonzero(slopes.any(axis=(0, 2)))  # an effect turns one joint or two, not all of them
        theta, slopes = [self.theta_places[joint] for joint in turned], slopes[:, turned]
        bends = np.stack([joint_curvature(self.columns[:c], weight, self.is_modified, one) for one in theta])
        flat = slopes.reshape(len(slopes), -1)
        mixed = -slim_product(flat, bends.transpose(1, 0, 2).reshape(c, -1))
        whole[-len(slopes) :, :c], whole[:c, -len(slopes) :] = mixed, mixed.T
        among = np.einsum("aim,ijm->ajm", slopes, bends[:, theta])
        whole[-len(slopes) :, -len(slopes) :] = -slim_product(among.reshape(flat.shape), flat)

    def _scaled(self, whole: Array) -> Array:
        """The unknowns' part (k, k) of a matrix over all parameters, per scaled unknown."""
        return np.asarray(whole[np.ix_(self.places, self.places)] * np.outer(self.scale, self.scale))


def _bend(bend: Array | None, columns: Array, out: Array) -> None:
    """Bend times each column, (K, 3, m), into `out`."""
    if bend is None:
        out[:] = columns
    elif bend.ndim == 2:
        np.multiply(bend, columns, out=out)
    else:
        for i in range(3):
            np.multiply(bend[i, 0], columns[:, 0], out=out[:, i])
            out[:, i] += bend[i, 1] * columns[:, 1]
            out[:, i] += bend[i, 2] * columns[:, 2]


# Second derivatives of an arm's residuals for Newton's method, summed over poses with a weight vector each.
#
# A rotation about an axis e moves everything beyond it, so with the derivative J_b of the tip by a parameter b beyond the
# rotation a, or by a itself, d2 tip / da db = e x J_b; a translation changes no derivative beyond it. With weights p the sum
# over poses is (p x e) . J_b: one product of matrices.
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
    curvature = np.zeros((k, k))
    beyond = order[turns][:, None] <= order[None, :]
    curvature[turns] = np.where(beyond, product, 0.0)
    return _mirrored(curvature, order)


def joint_curvature(columns: Array, weight: Array, is_modified: bool, joint: int) -> Array:
    """Weight . d2 tip / d theta dx of every pose, (k, m), for the theta at `joint` of dh.ravel(); as chain_curvature."""
    k = len(columns)
    order = _order(k, is_modified)
    curvature = np.zeros((k, columns.shape[2]))
    beyond = order >= order[joint]
    curvature[beyond] = np.einsum("im,kim->km", crossed(weight, columns[joint - 1]), columns[beyond])
    before = np.array([b for b in range(1, k - k % 4, 2) if not beyond[b]], dtype=np.intp)
    curvature[before] = np.einsum("kim,im->km", crossed(weight, columns[before - 1]), columns[joint])
    return curvature


def frame_curvature(arms: Array, weight: Array, turn_rad: Array) -> Array:
    """Sum of weight . d2 reference / dw2, (3, 3), for a frame's rotation w (3,); arms (m, 3), weight (3, m).

    The first derivative is J(w) e_a x arm, so the second is (dJ/dw_b e_a) x arm + J e_a x (J e_b x arm).
    """
    turns = left_jacobian(turn_rad)
    moments = weight @ arms  # sum of weight arm'
    torque = np.array([moments[2, 1] - moments[1, 2], moments[0, 2] - moments[2, 0], moments[1, 0] - moments[0, 1]])
    found = turns.T @ (moments.T - np.trace(moments) * np.eye(3)) @ turns + turned_slope(turn_rad, torque)
    return np.asarray(0.5 * (found + found.T))


def crossed(weight: Array, axes: Array) -> Array:
    """Weight x axes along the coordinate: (3, m) and (..., 3, m)."""
    about, cyclic = np.concatenate((weight, weight[:2])), np.concatenate((axes, axes[..., :2, :]), axis=-2)
    product = about[1:4] * cyclic[..., 2:5, :]
    product -= about[2:5] * cyclic[..., 1:4, :]
    return np.asarray(product)


def _order(k: int, is_modified: bool) -> Order:
    """Order of the parameters along the chain; two that share an axis are in the order of dh.ravel()."""
    order = np.arange(k)
    return np.where(order < k - k % 4, order ^ 2, order) if is_modified else order


def _mirrored(matrix: Array, order: Order) -> Array:
    """Make the matrix symmetric: copy entries (a, b), a before b, to (b, a)."""
    later = order[:, None] > order[None, :]
    return np.where(later, matrix.T, matrix)
