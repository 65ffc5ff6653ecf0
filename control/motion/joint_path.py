"""A joint path over time: quintic sections that match angle, speed and acceleration at both knots.

For excitation and test motions that are not tip paths. The client plans and checks the whole path; a request carries
the knots, and the loop computes the polynomials of each section when it gets there.

    q(s) = a0 + a1 s + a2 s^2 + a3 s^3 + a4 s^4 + a5 s^5,    s = (t - t_k) / h
"""

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from control.errors import MotionError
from control.motion.joint_limits import JointLimits
from control.motion.setpoint import SetPoint, at_rest

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Number = TypeVar("Number", float, NDArray[np.float64])
else:
    Number = TypeVar("Number")
Coefficients = tuple[float, float, float, float, float, float]
_ROUNDING = 1e-6  # of a limit
_KNOTS_MOST = 10_000  # some minutes at 25 ms: the request stays below the server's longest line
_DECIMALS = 10  # s, rad, rad/s, rad/s^2
_GROUPS = ("q_rad", "speed_rad_s", "acceleration_rad_s2")


class JointPath:
    """Implements Motion: knots at `times_s` (k,) from 0, and the set-point at each; without speed at both ends.

    Times increase, but two knots of one angle and speed may be at one time: there the acceleration steps.

    Raises:
        MotionError: the knots are invalid.
    """

    __slots__ = ("_at", "_least", "_most", "_section", "_table", "duration_s", "times_s")

    def __init__(self, times_s: Iterable[float], knots: "Iterable[SetPoint] | NDArray[np.float64]") -> None:
        """`knots`: set-points, or their numbers (k, 3, joints)."""
        self.times_s = tuple(times_s)
        self._table = _checked(self.times_s, knots)
        # Of angles, speeds and accelerations: (3, joints). They tell a good path within the cycle in which it begins.
        self._least, self._most = self._table.min(axis=0), self._table.max(axis=0)
        self.duration_s = self.times_s[-1]
        self._at = -1
        self._section: tuple[Coefficients, ...] = ()

    @property
    def knots(self) -> tuple[SetPoint, ...]:
        """The set-points at `times_s`; made anew each time, and slow for thousands."""
        return tuple(map(self._knot, range(len(self.times_s))))

    def poses(self, step: int) -> list[list[float]]:
        """The angles at every `step`th knot."""
        angles: list[list[float]] = self._table[::step, 0].tolist()
        return angles

    def _knot(self, k: int) -> SetPoint:
        return SetPoint(*map(tuple, self._table[k].tolist()))

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start, clamped to the path's time."""
        if time_s <= 0.0:
            return at_rest(self._knot(0).q_rad)
        if time_s >= self.duration_s:
            return at_rest(self._knot(-1).q_rad)
        k = bisect_right(self.times_s, time_s) - 1
        h = self.times_s[k + 1] - self.times_s[k]
        if k != self._at:
            self._section = tuple(quintic(h, *ends) for ends in zip(*self._knot(k), *self._knot(k + 1), strict=True))
            self._at = k
        return _sampled(self._section, (time_s - self.times_s[k]) / h, h)

    def require_within(self, limits: JointLimits) -> None:
        """MotionError if a knot violates a joint's range, speed or acceleration; the loop also limits every set-point."""
        import numpy as np

        table, count = self._table, len(limits.lower_rad)
        if table.shape[2] != count:
            raise MotionError(f"joint path: expected {count} joints, got {table.shape[2]}")
        most = np.array((limits.speed_rad_s, limits.acceleration_rad_s2)) * (1.0 + _ROUNDING)
        lowest = np.array([np.array(limits.lower_rad) - _ROUNDING, *-most])
        highest = np.array([np.array(limits.upper_rad) + _ROUNDING, *most])
        if (self._least >= lowest).all() and (self._most <= highest).all():
            return
        q = table[:, 0]
        is_outside = (q < lowest[0]) | (q > highest[0])
        wrong = is_outside | (np.abs(table[:, 1:]) > most).any(axis=1)
        k, j = divmod(int(np.argmax(wrong)), count)
        time_s, (angle, speed, acceleration) = self.times_s[k], table[k, :, j].tolist()
        if is_outside[k, j]:
            raise MotionError(
                f"joint path: joint {j + 1} would be at {angle:.4f} rad after {time_s:.3f} s, outside of its range"
                f" {limits.lower_rad[j]:.4f} to {limits.upper_rad[j]:.4f} rad"
            )
        is_fast = abs(speed) > most[0, j]
        what, value = ("rad/s", speed) if is_fast else ("rad/s^2", acceleration)
        limit = (limits.speed_rad_s if is_fast else limits.acceleration_rad_s2)[j]
        raise MotionError(f"joint path: joint {j + 1} asks for {value:.4g} {what} after {time_s:.3f} s, its limit is {limit:.4g}")

    def to_message(self) -> dict[str, Any]:
        """Plain lists, for JSON, to 1e-10: all digits of a float would be half as long again, and a request has an end."""
        import numpy as np

        columns = np.moveaxis(self._table, 1, 0).round(_DECIMALS).tolist()
        return {"times_s": np.round(self.times_s, _DECIMALS).tolist(), **dict(zip(_GROUPS, columns, strict=True))}

    @staticmethod
    def from_message(message: Mapping[str, Any]) -> "JointPath":
        """Inverse of `to_message`; MotionError if it is invalid."""
        import numpy as np

        try:
            times = np.asarray(message["times_s"], dtype=np.float64)
            if times.ndim != 1:
                raise ValueError("times_s is no list of numbers")
            groups = [message[name] for name in _GROUPS]
            lengths = {
                length for rows in groups for length in ({rows.shape[1]} if isinstance(rows, np.ndarray) else set(map(len, rows)))
            }
            if len(lengths) > 1:
                raise MotionError(f"joint path: expected {len(groups[0][0])} joints in every knot")
            return JointPath(times.tolist(), np.stack([np.asarray(rows, dtype=np.float64) for rows in groups], axis=1))
        except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
            raise MotionError(f"joint path message: expected what JointPath.to_message() gives ({error!r})") from None


def _checked(times_s: Sequence[float], knots: "Iterable[SetPoint] | NDArray[np.float64]") -> "NDArray[np.float64]":
    """The numbers of all knots, (k, 3, joints). MotionError if they are no path."""
    import numpy as np

    rows = knots if isinstance(knots, np.ndarray) else list(knots)
    if not 1 < len(times_s) <= _KNOTS_MOST or len(times_s) != len(rows):
        raise MotionError(
            f"joint path: expected 2 to {_KNOTS_MOST} knots and a time for each, got {len(rows)} and {len(times_s)}"
        )
    try:
        values = np.array(rows, dtype=np.float64)
    except ValueError:  # rows that are not equally long
        values = np.empty((0, 0))
    if values.ndim != 3 or not values.shape[2]:
        count = len(rows[0][0]) if len(rows) else 0
        raise MotionError(f"joint path: expected {count or 'some'} joints in every knot")
    times = np.array(times_s)
    if not (np.isfinite(times).all() and np.isfinite(values).all()):
        raise MotionError("joint path: expected finite numbers in every knot")
    steps = np.diff(times)
    is_jump = (steps == 0.0) & (values[1:, :2] != values[:-1, :2]).any(axis=(1, 2))
    if times[0] != 0.0 or (steps < 0.0).any() or is_jump.any() or not steps[[0, -1]].all():
        raise MotionError("joint path: expected times that increase from 0, or twice one time between with one angle and speed")
    if values[[0, -1], 1].any():
        raise MotionError("joint path: expected it to begin and to end at rest")
    return values


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
