"""Inverse kinematics for any arm: damped least squares from several starting poses.

Levenberg-Marquardt on the tip's error, with the joint limits as bounds (Siciliano et al., Robotics, 3.5;
Nocedal and Wright, Numerical Optimization, 10.3).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.tracing import KEPT, Graph, compile_function, derivative

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Residual = Callable[[Array], tuple[Array, Array]]
"""The tip's error (k,) [m] in a pose, and the tip's Jacobian (k, n) [m/rad]."""
_STEPS = 100
_SEEDS = 12
PROBES = 24
RANK_M = 1e-6  # m/rad: no real arm is so near to having lost a direction everywhere
_STALLED = 1e-12  # converged if a step reduces the error by less than this share


@dataclass(frozen=True, slots=True)
class Descent:
    """Result of a descent: joint angles, and the distance of the tip from the target."""

    q: tuple[float, ...]
    distance_m: float


def can_move_freely(kinematics: ForwardKinematics) -> bool:
    """Whether the joints move the tip in three directions in some pose."""
    n = kinematics.joint_count
    probes = np.random.default_rng(0).uniform(-np.pi, np.pi, (PROBES, n)).tolist()
    rows = np.array([kinematics.tip_jacobian(*q)[1] for q in probes])
    return n >= 3 and float(np.linalg.svd(rows, compute_uv=False)[:, -1].max()) > RANK_M


def descend(kinematics: ForwardKinematics, point: Sequence[float], start: Sequence[float], limits: Array) -> Descent:
    """Return the result of one descent to a tip position from `start` within limits (n, 2)."""
    target = np.asarray(point, dtype=np.float64)

    def residual(q: Array) -> tuple[Array, Array]:
        tip, rows = kinematics.tip_jacobian(*q.tolist())
        return target - np.asarray(tip), np.asarray(rows, dtype=np.float64)

    return descended(residual, start, limits)


def descended(residual: Residual, start: Sequence[float], limits: Array) -> Descent:
    """Return the result of one descent of a residual from `start` within limits (n, 2)."""
    lower, upper = limits[:, 0], limits[:, 1]
    q = np.clip(np.asarray(start, dtype=np.float64), lower, upper)
    error, jacobian = residual(q)
    damping = 1e-6
    for _ in range(_STEPS):
        if error @ error < (0.1 * ACCURACY_M) ** 2:
            break
        hessian: Array = jacobian.T @ jacobian
        hessian[np.diag_indices_from(hessian)] += damping
        gradient: Array = jacobian.T @ error
        tried = np.clip(q + _step(hessian, gradient, q <= lower, q >= upper), lower, upper)
        error_tried, jacobian_tried = residual(tried)
        gain = error @ error - error_tried @ error_tried
        if gain > 0.0:
            is_stalled = gain < _STALLED * (error @ error)
            q, error, jacobian, damping = tried, error_tried, jacobian_tried, max(damping * 0.2, 1e-12)
            if is_stalled:
                break
        else:
            damping *= 8.0
            if damping > 1e6:
                break
    return Descent(tuple(q.tolist()), float(np.sqrt(error @ error)))


def _step(hessian: Array, gradient: Array, is_lowest: Flags, is_highest: Flags) -> Array:
    """Solve, and again without the joints that are at a limit and would be pushed beyond it."""
    step: Array = np.asarray(np.linalg.solve(hessian, gradient), dtype=np.float64)
    blocked = (is_lowest & (step < 0.0)) | (is_highest & (step > 0.0))
    if not blocked.any() or blocked.all():
        return step
    free = np.flatnonzero(~blocked)
    result = np.zeros_like(step)
    result[free] = np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
    return result


def seeds(limits: Array, first: Sequence[Sequence[float]], scattered: int = _SEEDS) -> Iterator[tuple[float, ...]]:
    """Yield starting poses: those given, the middle of the ranges, then fixed random poses."""
    for q in first:
        yield tuple(q)
    lower = np.where(np.isfinite(limits[:, 0]), limits[:, 0], -np.pi)
    upper = np.where(np.isfinite(limits[:, 1]), limits[:, 1], np.pi)
    yield tuple((0.5 * (lower + upper)).tolist())
    scatter = np.random.default_rng(0).uniform(lower, upper, (scattered, len(limits)))
    for q in scatter.tolist():
        yield tuple(q)


ACCURACY_M = 1e-9
_NEWTON_STEPS = 8
_QUADRATIC_M2 = 1e-10  # squared error from which one more step reaches the accuracy
Joints = tuple[float, float, float]


class Newton:
    """Joint angles to 1e-9 m from a nearby pose of one arm."""

    def __init__(self, kinematics: ForwardKinematics) -> None:
        self._step = _compiled_step(kinematics)
        self._tip = kinematics.tip

    def solve(self, point: Sequence[float], q: Sequence[float]) -> Joints | None:
        """Return the joint angles for a point [m], or None if the method does not converge from q."""
        step = self._step
        q1, q2, q3 = q
        x, y, z = point
        try:
            for _ in range(_NEWTON_STEPS):
                q1, q2, q3, square = step(q1, q2, q3, x, y, z)
                if square < _QUADRATIC_M2 and math.dist(self._tip(q1, q2, q3), point) < ACCURACY_M:
                    return q1, q2, q3
        except (ZeroDivisionError, OverflowError, ValueError):
            return None
        return None


@lru_cache(maxsize=KEPT)
def _compiled_step(kinematics: ForwardKinematics) -> Callable[..., tuple[float, float, float, float]]:
    """Return `step(q1, q2, q3, x, y, z) -> (q1, q2, q3, squared error before the step)`."""
    graph = Graph()
    q = [graph.variable(f"q{i}") for i in (1, 2, 3)]
    target = [graph.variable(name) for name in ("x", "y", "z")]
    tip = kinematics.traced_tip(q)
    error = [wanted - is_at for wanted, is_at in zip(target, tip, strict=True)]
    columns = [derivative(tip, angle) for angle in q]
    step = _solved(columns, error)
    square = error[0] * error[0] + error[1] * error[1] + error[2] * error[2]
    moved = [angle + change for angle, change in zip(q, step, strict=True)]
    return compile_function("newton_step", [*q, *target], (*moved, square))


def _solved(columns: Sequence[Sequence[Any]], right: Sequence[Any]) -> list[Any]:
    """Solve [a b c] x = r by Cramer's rule: x1 = r . (b x c) / det, and so on."""
    a, b, c = columns
    normals = [_cross(b, c), _cross(c, a), _cross(a, b)]
    determinant = _dot(a, normals[0])
    return [_dot(right, normal) / determinant for normal in normals]


def _cross(a: Sequence[Any], b: Sequence[Any]) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
