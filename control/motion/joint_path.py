"""A joint path over time: quintic sections that match angle, speed and acceleration at both knots.

For excitation and test motions that are not tip paths. The client plans and checks the whole path; a request carries
the knots, and the loop computes the polynomials of each section when it gets there.

    q(s) = a0 + a1 s + a2 s^2 + a3 s^3 + a4 s^4 + a5 s^5,    s = (t - t_k) / h
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, TypeVar

from control.motion.errors import MotionError
from control.motion.joint_limits import JointLimits
from control.motion.setpoint import SetPoint

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Number = TypeVar("Number", float, NDArray[np.float64])
else:
    Number = TypeVar("Number")
Coefficients = tuple[float, float, float, float, float, float]
_ROUNDING = 1e-6  # of a limit
_KNOTS_MOST = 10_000  # some minutes at 25 ms: the request stays below the server's longest line
_GROUPS = ("q_rad", "speed_rad_s", "acceleration_rad_s2")


class JointPath:
    """Implements Motion: knots at `times_s` (k,), increasing from 0, and the set-point at each; at rest at both ends.

    Raises:
        MotionError: the knots are invalid.
    """

    __slots__ = ("_at", "_section", "duration_s", "knots", "times_s")

    def __init__(self, times_s: Iterable[float], knots: Iterable[SetPoint]) -> None:
        self.times_s, self.knots = tuple(times_s), tuple(knots)
        _require_path(self.times_s, self.knots)
        self.duration_s = self.times_s[-1]
        self._at = -1
        self._section: tuple[Coefficients, ...] = ()

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start, clamped to the path's time."""
        if time_s <= 0.0:
            return self.knots[0]
        if time_s >= self.duration_s:
            return self.knots[-1]
        k = bisect_right(self.times_s, time_s) - 1
        h = self.times_s[k + 1] - self.times_s[k]
        if k != self._at:
            self._section = tuple(
                quintic(h, *ends) for ends in zip(*self.knots[k], *self.knots[k + 1], strict=True)
            )
            self._at = k
        return _sampled(self._section, (time_s - self.times_s[k]) / h, h)

    def require_within(self, limits: JointLimits) -> None:
        """MotionError if a knot violates a joint's range, speed or acceleration; the loop also limits every set-point."""
        count = len(limits.lower_rad)
        if len(self.knots[0].q_rad) != count:
            raise MotionError(f"joint path: expected {count} joints, got {len(self.knots[0].q_rad)}")
        for time_s, knot in zip(self.times_s, self.knots, strict=True):
            for j, (q, speed, acceleration) in enumerate(zip(*knot, strict=True)):
                lower, upper = limits.lower_rad[j], limits.upper_rad[j]
                if not lower - _ROUNDING <= q <= upper + _ROUNDING:
                    raise MotionError(
                        f"joint path: joint {j + 1} would be at {q:.4f} rad after {time_s:.3f} s, outside of its range"
                        f" {lower:.4f} to {upper:.4f} rad"
                    )
                for what, value, most in (
                    ("rad/s", speed, limits.speed_rad_s[j]),
                    ("rad/s^2", acceleration, limits.acceleration_rad_s2[j]),
                ):
                    if abs(value) > most * (1.0 + _ROUNDING):
                        raise MotionError(
                            f"joint path: joint {j + 1} asks for {value:.4g} {what} after {time_s:.3f} s, its limit is"
                            f" {most:.4g}"
                        )

    def to_message(self) -> dict[str, Any]:
        """Plain lists, for JSON."""
        columns = zip(_GROUPS, zip(*self.knots, strict=True), strict=True)
        return {
            "times_s": list(self.times_s),
            **{name: [list(row) for row in rows] for name, rows in columns},
        }

    @staticmethod
    def from_message(message: Mapping[str, Any]) -> "JointPath":
        """Inverse of `to_message`; MotionError if it is invalid."""
        try:
            times = [float(t) for t in message["times_s"]]
            rows = [[tuple(map(float, row)) for row in message[name]] for name in _GROUPS]
            return JointPath(times, (SetPoint(*knot) for knot in zip(*rows, strict=True)))
        except (KeyError, TypeError, ValueError) as error:
            raise MotionError(
                f"joint path message: expected what JointPath.to_message() gives ({error!r})"
            ) from None


def _require_path(times_s: Sequence[float], knots: Sequence[SetPoint]) -> None:
    if not 1 < len(times_s) <= _KNOTS_MOST or len(times_s) != len(knots):
        raise MotionError(
            f"joint path: expected 2 to {_KNOTS_MOST} knots and a time for each, got {len(knots)} and {len(times_s)}"
        )
    count = len(knots[0].q_rad)
    if any(len(part) != count for knot in knots for part in knot) or not count:
        raise MotionError(f"joint path: expected {count or 'some'} joints in every knot")
    if not all(map(math.isfinite, chain(times_s, *(part for knot in knots for part in knot)))):
        raise MotionError("joint path: expected finite numbers in every knot")
    if times_s[0] != 0.0 or any(b <= a for a, b in pairwise(times_s)):
        raise MotionError("joint path: expected times that increase from 0")
    if any(any(knot.speed_rad_s) or any(knot.acceleration_rad_s2) for knot in (knots[0], knots[-1])):
        raise MotionError("joint path: expected it to begin and to end at rest")


def quintic(
    h: Number, q0: Number, v0: Number, a0: Number, q1: Number, v1: Number, a1: Number
) -> tuple[Number, Number, Number, Number, Number, Number]:
    """Coefficients over s = 0 .. 1 of a section that takes h seconds, from angle, speed and acceleration at both ends."""
    v0, v1, a0, a1 = h * v0, h * v1, h * h * a0, h * h * a1
    d = q1 - q0
    return (
        q0,
        v0,
        0.5 * a0,
        10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1,
        -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1,
        6.0 * d - 3.0 * (v0 + v1) + 0.5 * (a1 - a0),
    )


def _sampled(section: Sequence[Coefficients], s: float, h: float) -> SetPoint:
    q, speed, acceleration = [], [], []
    for c0, c1, c2, c3, c4, c5 in section:
        q.append(c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5)))))
        speed.append((c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))) / h)
        acceleration.append((2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5))) / (h * h))
    return SetPoint(tuple(q), tuple(speed), tuple(acceleration))
