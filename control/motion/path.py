"""A Cartesian path as a motion of the joints: spline, inverse kinematics and its two derivatives, per cycle.

    J(q) qd = v,    J(q) qdd = a - Jdot(q, qd) qd

For arms of three joints, whose tip position fixes the joint angles on a branch.
"""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Protocol

from control.errors import NearSingular
from control.motion.errors import MotionError
from control.motion.setpoint import SetPoint, Vector
from control.motion.spline import CartesianSpline

Rows = tuple[tuple[float, ...], ...]
# With samples further apart than this, the nearest way-point's pose is a better seed than the last pose.
_JUMP_S = 0.05
# |det J| [m^3/rad^3] below which joint speeds are meaningless; the planner stays far from it.
_SINGULAR = 1e-9


class Follows(Protocol):
    """The inverse kinematics that a path needs."""

    def follow(self, point: Vector, q_previous: Sequence[float]) -> tuple[float, ...]:
        """Joint angles for `point` on the branch of `q_previous`."""
        ...


class Differentiates(Protocol):
    """The forward kinematics that a path needs."""

    @property
    def tip_jacobian(self) -> Callable[..., tuple[Vector, Rows]]:
        """`tip_jacobian(*q) -> (tip, rows)`."""
        ...

    @property
    def tip_bias(self) -> Callable[[Sequence[float], Sequence[float]], Vector]:
        """`tip_bias(q, qd) -> Jdot qd`."""
        ...


class CartesianPath:
    """Implements Motion. Each pose is the seed of the next, so sampling forward in time is cheap.

    Args:
        spline: the tip's path in the base frame.
        inverse, kinematics: of the arm that runs it.
        q_waypoints_rad: joint angles at the spline's times (n + 1 tuples of 3), the seeds; they fix the
        branch.
    """

    __slots__ = ("_bias", "_follow", "_jacobian", "_last_s", "_q", "_seeds", "_spline", "duration_s")

    def __init__(
        self,
        spline: CartesianSpline,
        inverse: Follows,
        kinematics: Differentiates,
        q_waypoints_rad: Sequence[tuple[float, ...]],
    ) -> None:
        if len(q_waypoints_rad) != len(spline.times_s) or any(len(q) != 3 for q in q_waypoints_rad):
            raise MotionError(
                f"path: expected {len(spline.times_s)} poses of three joints, got {q_waypoints_rad}"
            )
        self._spline = spline
        self._follow = inverse.follow
        self._jacobian, self._bias = kinematics.tip_jacobian, kinematics.tip_bias
        self._seeds = tuple(q_waypoints_rad)
        self._q, self._last_s = self._seeds[0], 0.0
        self.duration_s = spline.duration_s

    def at(self, time_s: float) -> SetPoint:
        """Set-point at `time_s`, clamped to the path's time.

        Raises:
            ArmError: the inverse kinematics' errors; none on a path that was planned for this arm.
        """
        position, velocity, acceleration = self._spline.at(time_s)
        if not -_JUMP_S < time_s - self._last_s < _JUMP_S:
            self._q = self._seed(time_s)
        q = self._follow(position, self._q)
        self._q, self._last_s = q, time_s
        inverse = inverse_of(self._jacobian(*q)[1])
        speed = times(inverse, velocity)
        bias = self._bias(q, speed)
        rest = (acceleration[0] - bias[0], acceleration[1] - bias[1], acceleration[2] - bias[2])
        return SetPoint(q, speed, times(inverse, rest))

    def _seed(self, time_s: float) -> tuple[float, ...]:
        """Pose at the way-point nearest in time."""
        times = self._spline.times_s
        after = min(max(bisect_right(times, time_s), 1), len(times) - 1)
        return self._seeds[after if times[after] - time_s < time_s - times[after - 1] else after - 1]


def inverse_of(rows: Rows) -> tuple[Vector, Vector, Vector]:
    """Inverse of a 3 x 3 matrix by cofactors; at this size plain floats are faster than a library."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    determinant = a * p + b * q + c * r
    if -_SINGULAR < determinant < _SINGULAR:
        raise NearSingular(
            f"the arm is at a singularity: det J {determinant:.3g} m^3/rad^3, least {_SINGULAR:.3g}",
            "arm",
            abs(determinant),
            _SINGULAR,
            "m^3/rad^3",
        )
    k = 1.0 / determinant
    return (
        (p * k, (c * h - b * i) * k, (b * f - c * e) * k),
        (q * k, (a * i - c * g) * k, (c * d - a * f) * k),
        (r * k, (b * g - a * h) * k, (a * e - b * d) * k),
    )


def times(matrix: tuple[Vector, Vector, Vector], vector: Vector) -> Vector:
    """Matrix times vector."""
    x, y, z = vector
    (a, b, c), (d, e, f), (g, h, i) = matrix
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)
