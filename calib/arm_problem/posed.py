"""Poses whose orientation was measured, too: three more residuals each, and how the measured target sits on the last link.

    e = lever log(R_measured (R_link exp(t) R_0)'),   lever = position noise / orientation noise

The lever makes an angle a length whose noise is that of a coordinate, so that objectives, noise and intervals hold unchanged:
e of a pose is one more row. Where nobody says that the target's frame is the last link's (`fix target`), its turn t against a
start R_0 is identified with the arm: no target is mounted to the noise.

    de = lever (J_l(e)^-1 w_measured - J_r(e)^-1 w_model)      (Barfoot, State Estimation for Robotics, 7.1)

Second derivatives of the rows of orientation are left out (Gauss-Newton): e stays below a few degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import Bounds, Parameter
from calib.arm_problem.expansion import ALL, Expanded, Problem
from calib.arm_problem.observations import Frame, left_jacobian, mean_rotation, rotation_of
from calib.arm_problem.problem import ArmProblem, Turns
from calib.arrays import Array
from control.kinematics.rotation import cross_matrices, logarithms

TARGET = "target"
TARGET_NAMES = ("target_rx", "target_ry", "target_rz")
SMALL_rad = 1e-4
Places = npt.NDArray[np.intp]


class PosedProblem:
    """Residuals of tips, then of orientations; unknowns are those of the tips, then the target's turn."""

    def __init__(self, tips: ArmProblem) -> None:
        self.tips = tips
        self.rows = tips.observed.turned_rows
        self.lever_m = tips.observed.lever_m
        is_free = not tips.observed.is_target_known
        turn = [Parameter(name, "rad", 0.0, Bounds().of_free(name, "rad")) for name in TARGET_NAMES]
        self.parameters = (*tips.parameters, *(turn if is_free else ()))
        self._count = len(tips.parameters)
        self._scale = turn[0].scale
        self.start = self._mean_target() if is_free else np.eye(3)

    def __len__(self) -> int:
        """How many rows."""
        return len(self.tips) + len(self.rows)

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3) [m]."""
        positions, turned = self._split(rows)
        return np.concatenate((self.tips.residuals(x[: self._count], positions), self._turned(x, turned)[0]))

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """(rows, 3) and (rows, 3, k)."""
        positions, turned = self._split(rows)
        tip, by_tip = self.tips.residuals_and_jacobian(x[: self._count], positions)
        error, by_x = self._turned(x, turned)
        return np.concatenate((tip, error)), np.concatenate((self._widened(by_tip), by_x))

    def expanded(self, x: Array, rows: slice = ALL) -> WithRows:
        """Around x."""
        positions, turned = self._split(rows)
        return WithRows(self.tips.expanded(x[: self._count], positions), self._count, *self._turned(x, turned))

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """The Jacobian for zero residuals, (rows, 3, k)."""
        positions, turned = self._split(rows)
        by_turn = self._turned(x, turned, at_zero=True)[1]
        return np.concatenate((self._widened(self.tips.sensitivity(x[: self._count], positions)), by_turn))

    def angles_rad(self, x: Array) -> Array:
        """Errors of the orientations as rotation vectors in the base frame, (r, 3)."""
        return self._turned(x, self.rows)[0] / self.lever_m

    def target(self, x: Array) -> Array:
        """The target's orientation in the last link's frame, (3, 3)."""
        return np.asarray(rotation_of(self._turn(x)) @ self.start)

    def _turn(self, x: Array) -> Array:
        return x[self._count :] * self._scale if len(x) > self._count else np.zeros(3)

    def _split(self, rows: slice) -> tuple[slice, Places]:
        """Rows of the tips as a slice, and poses of the orientations, of a slice of all rows."""
        m, whole = len(self.tips), range(len(self))[rows]
        first = [row for row in whole if row < m]
        poses = self.rows[np.array([row - m for row in whole if row >= m], dtype=np.intp)]
        return slice(first[0], first[-1] + 1, whole.step) if first else slice(0, 0), poses

    def _turned(self, x: Array, poses: Places, at_zero: bool = False) -> tuple[Array, Array]:
        """Residuals of orientations (r, 3) [m] and their Jacobian (r, 3, k)."""
        turns = self.tips.turns(x[: self._count], poses)
        turn = self._turn(x)
        modelled = turns.model @ (rotation_of(turn) @ self.start)
        error = logarithms(turns.measured @ np.swapaxes(modelled, 1, 2))
        by_model = self._with_target(turns, turn, len(x))
        by_measured = self._widened(turns.by_measured)
        if not at_zero:
            inverse = inverse_jacobians(error)
            by_measured = inverse @ by_measured
            by_model = np.swapaxes(inverse, 1, 2) @ by_model  # J_r(e) = J_l(e)'
        return self.lever_m * error, self.lever_m * (by_measured - by_model)

    def _with_target(self, turns: Turns, turn: Array, k: int) -> Array:
        whole = self._widened(turns.by_model)
        if k > self._count:
            whole[:, :, self._count :] = turns.model @ left_jacobian(turn) * self._scale
        return whole

    def _widened(self, columns: Array) -> Array:
        """With columns of zeros for the target."""
        whole = np.zeros((*columns.shape[:2], len(self.parameters)))
        whole[:, :, : self._count] = columns
        return whole

    def _mean_target(self) -> Array:
        """The target's orientation in the last link's frame that fits the nominal arm best."""
        found = self.tips.turns(np.zeros(self._count), self.rows)
        return mean_rotation(np.swapaxes(found.model, 1, 2) @ found.measured)


def inverse_jacobians(vectors: Array) -> Array:
    """J_l(e)^-1 = I - [e] / 2 + (1 / a^2 - (1 + cos a) / (2 a sin a)) [e]^2, (r, 3, 3)."""
    angle = np.linalg.norm(vectors, axis=1)
    safe = np.where(angle > SMALL_rad, angle, 1.0)
    series = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    weight = np.where(angle > SMALL_rad, series, 1.0 / 12.0)
    cross = cross_matrices(vectors)
    return np.asarray(np.eye(3) - 0.5 * cross + weight[:, None, None] * (cross @ cross))


@dataclass(frozen=True, slots=True)
class WithRows:
    """An inner expansion with the first `own` unknowns, and added residuals (r, 3) with their jacobian (r, 3, k).

    inner None: nothing but the added rows.
    """

    inner: Expanded | None
    own: int
    added: Array
    jacobian: Array

    @property
    def residuals(self) -> Array:
        """(m + r, 3) [m]."""
        return self.added if self.inner is None else np.concatenate((self.inner.residuals, self.added))

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Gradient (k,) and gram (k, k)."""
        m, k, inner_count = len(pull) - len(self.added), self.jacobian.shape[2], self.own
        gradient, gram = np.zeros(k), np.zeros((k, k))
        if self.inner is not None:
            inner_bend = None if bend is None else bend[..., :m]
            gradient[:inner_count], gram[:inner_count, :inner_count] = self.inner.sums(pull[:m], inner_bend)
        gradient += np.einsum("ri,rik->k", pull[m:], self.jacobian)
        return gradient, gram + self._gram(None if bend is None else bend[..., m:])

    def curvature(self, pull: Array) -> Array:
        """Of the inner rows, (k, k)."""
        k = self.jacobian.shape[2]
        whole = np.zeros((k, k))
        if self.inner is not None:
            whole[: self.own, : self.own] = self.inner.curvature(pull[: len(pull) - len(self.added)])
        return whole

    def _gram(self, bend: Array | None) -> Array:
        """Sum of J' bend J; bend (3, r), (3, 3, r), or None for ones."""
        jacobian = self.jacobian
        if bend is None:
            bent = jacobian
        elif bend.ndim == 2:
            bent = bend.T[:, :, None] * jacobian
        else:
            bent = np.einsum("ijr,rjk->rik", bend, jacobian)
        k = jacobian.shape[2]
        return np.asarray(jacobian.reshape(-1, k).T @ bent.reshape(-1, k))


def in_threes(values: Array) -> Array:
    """Numbers (r, ...) that are one residual each, as rows of three, the last filled up with zeros."""
    missing = -len(values) % 3
    filled = np.concatenate((values, np.zeros((missing, *values.shape[1:]))))
    return filled.reshape(-1, 3, *values.shape[1:])


# Points whose covariances are known: each residual counts by its own noise, along each direction.
#
#     r -> W r,   W = s C^(-1/2),   s the noise of a usual point
#
# W makes the noise alike in all rows and directions, so that objectives, noise and intervals hold unchanged; s keeps it a length.
# C is stated in the axes of the measuring frame. Where that frame is itself identified, its axes are those of the start, or of an
# earlier solution: W is constant while the solver works, so derivatives stay exact.


def whole_problem(problem: ArmProblem, frames: tuple[Frame, ...] | None = None) -> Problem:
    """The problem with rows for measured orientations, and weighted by covariances where they are known.

    `frames`: of an earlier solution, whose axes the covariances are turned to; by default those of the start.
    """
    posed = PosedProblem(problem) if len(problem.observed.turned_rows) else None
    inner: Problem = problem if posed is None else posed
    weights, covariance = position_weights(problem, frames), problem.observed.covariance
    if weights is None or covariance is None:
        return inner
    if posed is not None:
        turns = _weights(problem, 1, frames)[posed.rows] / posed.lever_m
        weights = np.concatenate((weights, turns))
    return WeightedProblem(inner, weights, usual_noise_m(covariance[:, 0]))


def posed_part(whole: Problem) -> PosedProblem | None:
    """The problem with orientations inside a whole one; None without orientations."""
    inner = whole.inner if isinstance(whole, WeightedProblem) else whole
    return inner if isinstance(inner, PosedProblem) else None


def position_weights(problem: ArmProblem, frames: tuple[Frame, ...] | None = None) -> Array | None:
    """W (m, 3, 3) of the tips' residuals in the base frame; None if all points count alike."""
    return None if problem.observed.covariance is None else _weights(problem, 0, frames)


def usual_noise_m(covariance: Array) -> float:
    """Standard deviation of one axis of a usual point: median over covariances (m, 3, 3) of positions."""
    return float(np.median(np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3.0)))


def _weights(problem: ArmProblem, kind: int, frames: tuple[Frame, ...] | None) -> Array:
    """Weights (m, 3, 3) of positions (kind 0) or orientations (1), turned to the base frame's axes."""
    observed = problem.observed
    if observed.covariance is None:
        raise ValueError("points without covariances have no weights")
    turns = np.array([frame.rotation for frame in frames or observed.frames])[observed.frame]
    values, axes = np.linalg.eigh(observed.covariance[:, kind])
    axes = turns @ axes
    roots = usual_noise_m(observed.covariance[:, 0]) / np.sqrt(values)
    return np.asarray((axes * roots[:, None, :]) @ np.swapaxes(axes, 1, 2))


@dataclass(frozen=True, slots=True)
class WeightedExpansion:
    """An expansion whose residuals are multiplied by weights (m, 3, 3)."""

    inner: Expanded
    weights: Array

    @property
    def residuals(self) -> Array:
        """(m, 3)."""
        return _times(self.weights, self.inner.residuals)

    def sums(self, pull: Array, bend: Array | None) -> tuple[Array, Array]:
        """Gradient (k,) and gram (k, k): pull and bend act on the weighted residuals."""
        w = self.weights
        if bend is None:
            bent = w @ w
        elif bend.ndim == 2:
            bent = w @ (bend.T[:, :, None] * w)
        else:
            bent = w @ np.moveaxis(bend, 2, 0) @ w
        return self.inner.sums(_times(w, pull), np.ascontiguousarray(np.moveaxis(bent, 0, 2)))

    def curvature(self, pull: Array) -> Array:
        """(k, k)."""
        return self.inner.curvature(_times(self.weights, pull))


class WeightedProblem:
    """A problem whose residuals are multiplied by symmetric weights (rows, 3, 3); unit_m: then the noise of one axis."""

    def __init__(self, inner: Problem, weights: Array, unit_m: float) -> None:
        self.inner, self.weights, self.unit_m = inner, weights, unit_m
        self.parameters = inner.parameters

    def __len__(self) -> int:
        """How many rows."""
        return len(self.inner)

    def residuals(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3) [m of a usual point]."""
        return _times(self.weights[rows], self.inner.residuals(x, rows))

    def residuals_and_jacobian(self, x: Array, rows: slice = ALL) -> tuple[Array, Array]:
        """(rows, 3) and (rows, 3, k)."""
        residuals, jacobian = self.inner.residuals_and_jacobian(x, rows)
        return _times(self.weights[rows], residuals), self.weights[rows] @ jacobian

    def expanded(self, x: Array, rows: slice = ALL) -> WeightedExpansion:
        """Around x."""
        return WeightedExpansion(self.inner.expanded(x, rows), self.weights[rows])

    def sensitivity(self, x: Array, rows: slice = ALL) -> Array:
        """(rows, 3, k)."""
        return np.asarray(self.weights[rows] @ self.inner.sensitivity(x, rows))


def _times(weights: Array, vectors: Array) -> Array:
    return np.asarray(np.einsum("mij,mj->mi", weights, vectors))
