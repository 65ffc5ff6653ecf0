"""Time scaling of a motion, from 1 (as planned) to 0 (paused), for pause, resume and speed override.

With the motion q(s) and ds/dt = r, the joints have speed q'(s) r and acceleration q''(s) r^2 + q'(s) dr/dt. r is at most 1, so
speeds stay below the planned ones; dr/dt is limited to what every joint's limit leaves beside q'' r^2. Its own rate is
limited, too, to bound the jerk. The arm never leaves the path.
"""

import math
from collections.abc import Sequence
from copy import copy

from control.motion.setpoint import Motion, SetPoint

RATE_per_s = 5.0  # from full speed to rest in 0.3 s if the joints can
CURB_per_s2 = 50.0
_ARRIVED = 1e-9
Limited = tuple[Motion, Sequence[float]]
"""A motion and the acceleration limits of its joints [rad/s2]."""
_LOOK_S = 0.01  # steps of a look ahead


class Paced:
    """A motion and its progress: `time_s` is the motion's own time, `pace` its present rate."""

    __slots__ = ("_beside", "_limits", "_rate", "motion", "pace", "time_s")

    def __init__(self, motion: Motion, acceleration_rad_s2: Sequence[float], pace: float, beside: Sequence[Limited] = ()) -> None:
        """Start a motion from rest at any pace from 0 to 1.

        `beside`: motions of other arms that began with it and keep its pace, so that all stay where they should be to each other.
        """
        self.motion = motion
        self.time_s = 0.0
        self.pace = pace
        self._rate = 0.0
        self._limits = tuple(acceleration_rad_s2)
        self._beside = tuple(beside)

    @property
    def is_over(self) -> bool:
        """Whether the motion has come to its end."""
        return self.time_s >= self.motion.duration_s

    @property
    def progress(self) -> float:
        """Progress, 0 to 1."""
        return min(1.0, self.time_s / self.motion.duration_s) if self.motion.duration_s > 0.0 else 1.0

    def advance(self, elapsed_s: float, wanted: float) -> SetPoint:
        """Return the set-point `elapsed_s` after the last, moving towards the pace `wanted`. Raises what the motion raises."""
        before = self.pace
        time_s = self.time_s + before * elapsed_s
        planned = self.motion.at(time_s)
        self.time_s = time_s
        if before == wanted == 1.0:
            return planned
        q, speed, acceleration = planned
        joints = [*zip(speed, acceleration, self._limits, strict=True)]
        for other, limits in self._beside:
            _, its_speed, its_acceleration = other.at(time_s)
            joints += zip(its_speed, its_acceleration, limits, strict=True)
        rate = self._next_rate(wanted, elapsed_s, joints)
        after = before + rate * elapsed_s
        if (after - wanted) * (before - wanted) <= 0.0 or abs(after - wanted) < _ARRIVED:
            after, rate = wanted, 0.0
        self.pace, self._rate = after, rate
        return SetPoint(
            q,
            tuple(v * after for v in speed),
            tuple(a * after * after + v * rate for a, v in zip(acceleration, speed, strict=True)),
        )

    def can_rest(self, within_s: float) -> bool:
        """Whether pace 0 is reached in this time by the limits of the joints, or the end of the motion. Never raises."""
        ahead = Paced(self.motion, self._limits, self.pace, self._beside)
        ahead.time_s, ahead._rate = self.time_s, self._rate
        try:
            for _ in range(math.ceil(within_s / _LOOK_S)):
                ahead.advance(_LOOK_S, 0.0)
                if ahead.pace == 0.0 or ahead.is_over:
                    return True
        except Exception:  # whatever the motion raises on this way, it is none to stop on
            return False
        return False

    def take_up(self, motion_s: float, speed_share: float) -> SetPoint:
        """Go on from `motion_s` later, at a share of the present pace: others have slowed the arm down along the motion."""
        self.time_s += self.pace * motion_s
        self.pace *= speed_share
        self._rate = 0.0
        q, speed, acceleration = self.motion.at(self.time_s)
        r = self.pace
        return SetPoint(q, tuple(v * r for v in speed), tuple(a * r * r for a in acceleration))

    def _next_rate(self, wanted: float, elapsed_s: float, joints: Sequence[tuple[float, float, float]]) -> float:
        """By the speed, acceleration and acceleration limit of every joint of every arm."""
        gap = wanted - self.pace
        # so that the rate also ends at zero
        rate = math.copysign(min(RATE_per_s, math.sqrt(2.0 * CURB_per_s2 * abs(gap))), gap)
        change = CURB_per_s2 * elapsed_s
        rate = min(max(rate, self._rate - change), self._rate + change)
        lower, upper = -math.inf, math.inf
        for v, a, limit in joints:
            spent = a * self.pace * self.pace
            if v != 0.0:
                bounds = ((-limit - spent) / v, (limit - spent) / v)
                lower, upper = max(lower, min(bounds)), min(upper, max(bounds))
        # A path at its limits leaves nothing; acceleration of the path itself cannot be reduced here.
        return min(max(rate, min(lower, 0.0)), max(upper, 0.0))


class Stretched:
    """A motion that takes longer than planned: speeds fall by the same share everywhere, accelerations by its square."""

    __slots__ = ("_motion", "_rate", "duration_s")

    def __init__(self, motion: Motion, duration_s: float) -> None:
        """`duration_s`: not less than the motion's own."""
        self._motion, self.duration_s = motion, duration_s
        self._rate = motion.duration_s / duration_s if duration_s > 0.0 else 1.0

    def __copy__(self) -> "Stretched":
        return Stretched(copy(self._motion), self.duration_s)

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start."""
        r = self._rate
        q, speed, acceleration = self._motion.at(r * time_s)
        return SetPoint(q, tuple(v * r for v in speed), tuple(a * r * r for a in acceleration))
