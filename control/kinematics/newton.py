"""Newton's method for the tip position of a three-joint arm, one compiled straight-line step at a time."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.straight_line import KEPT, compile_function, derivative
from control.kinematics.tracing import Graph

ACCURACY_M = 1e-9
_STEPS = 8
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
            for _ in range(_STEPS):
                q1, q2, q3, square = step(q1, q2, q3, x, y, z)
                if square < _QUADRATIC_M2 and self._is_there(q1, q2, q3, x, y, z):
                    return q1, q2, q3
        except (ZeroDivisionError, OverflowError, ValueError):
            return None
        return None

    def _is_there(self, q1: float, q2: float, q3: float, x: float, y: float, z: float) -> bool:
        tx, ty, tz = self._tip(q1, q2, q3)
        dx, dy, dz = tx - x, ty - y, tz - z
        return dx * dx + dy * dy + dz * dz < ACCURACY_M * ACCURACY_M


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
