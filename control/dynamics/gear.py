"""One gear with backlash or compliance: its contact flank, and the offset of the motor from the joint.

The sign of the transmitted torque determines the contact flank. For a planned set-point:

- in motion: the sign of the links' torque + link-side friction times direction;
- at rest: the sign of gravity if it exceeds friction, else the flank on which the joint came to rest;
- near zero: the last flank, because the model is not exact.

What was measured beyond play and spring, by load and by the direction of the last motion, is added as a map (control.model.maps).
The offset follows flank, spring and map critically damped, with limited speed and acceleration, so it never jumps.
"""

from dataclasses import dataclass
from math import copysign, sqrt
from typing import Final

from control.kinematics.smooth_table import SmoothTable

DOUBT: Final = 0.05  # of the friction: a smaller torque does not change the flank
PACE_rad_s: Final = 100.0  # bandwidth of the offset: faster than the position loop (40 rad/s)
STEP_S, MOST_STEPS = 0.002, 100  # largest step; after a pause of the host it need not be exact
_STILL_rad_s = 1e-6


@dataclass(frozen=True, slots=True)
class GearLaw:
    """Parameters of a gear; dry friction and load friction are the link-side shares."""

    width_rad: float
    compliance_rad_Nm: float
    friction_Nm: float
    load_fraction: float
    speed_rad_s: float  # limits of the offset's own motion
    acceleration_rad_s2: float
    measured: "MeasuredLag | None" = None


@dataclass(frozen=True, slots=True)
class MeasuredLag:
    """How far a joint is ahead of its motor by maps: over the load, and in positive motion over angle and load."""

    over_load: SmoothTable | None = None
    directed_over_load: SmoothTable | None = None
    directed_over_angle: SmoothTable | None = None

    def ahead_rad(self, q_rad: float, torque_Nm: float, direction: float) -> float:
        """At this angle under this torque of the links; direction 1 or -1, 0 while unknown."""
        ahead = 0.0 if self.over_load is None else self.over_load(torque_Nm)
        if self.directed_over_load is not None:
            ahead += direction * self.directed_over_load(torque_Nm)
        if self.directed_over_angle is not None:
            ahead += direction * self.directed_over_angle(q_rad)
        return ahead

    @property
    def largest_rad(self) -> float:
        """That a joint may be ahead."""
        tables = self.over_load, self.directed_over_load, self.directed_over_angle
        return sum(table.largest for table in tables if table is not None)


class Gear:
    """The state of one gear. `offset_rad` is motor minus joint angle, with its two derivatives."""

    __slots__ = ("_direction", "_flank", "_law", "acceleration_rad_s2", "offset_rad", "speed_rad_s")

    def __init__(self, law: GearLaw) -> None:
        self._law = law
        self._flank = 0.0  # 0: not known yet
        self._direction = 0.0  # of the last motion
        self.offset_rad = self.speed_rad_s = self.acceleration_rad_s2 = 0.0

    @property
    def flank(self) -> int:
        """Sign of the torque from motor to joint; 0 while unknown."""
        return int(self._flank)

    def rest(self, torque_Nm: float, q_rad: float = 0.0) -> None:
        """Initialise at rest at this angle with this torque of the links."""
        self.offset_rad = self._wanted(torque_Nm, q_rad, 0.0, 0.0)
        self.speed_rad_s = self.acceleration_rad_s2 = 0.0

    def follow(
        self,
        torque_Nm: float,
        speed_rad_s: float,
        acceleration_rad_s2: float,
        elapsed_s: float,
        q_rad: float = 0.0,
    ) -> None:
        """Advance by `elapsed_s` with the joint's set-point and this torque of the links."""
        wanted = self._wanted(torque_Nm, q_rad, speed_rad_s, acceleration_rad_s2)
        if wanted == self.offset_rad and self.speed_rad_s == 0.0:
            self.acceleration_rad_s2 = 0.0
            return
        steps = min(max(round(elapsed_s / STEP_S), 1), MOST_STEPS)
        for _ in range(steps):
            self._approach(wanted, min(elapsed_s / steps, STEP_S))

    def _wanted(self, torque: float, q: float, speed: float, acceleration: float) -> float:
        law = self._law
        friction = law.friction_Nm + law.load_fraction * abs(torque)
        is_still = -_STILL_rad_s < speed < _STILL_rad_s
        if not is_still:
            self._direction = copysign(1.0, speed)
        if is_still and acceleration == 0.0:
            if abs(torque) > friction * (1.0 + DOUBT):
                self._flank = copysign(1.0, torque)
        else:
            way = copysign(1.0, acceleration) if is_still else self._direction
            pushed = torque + friction * way
            if abs(pushed) > DOUBT * friction:
                self._flank = copysign(1.0, pushed)
        transmitted = torque + friction * self._direction
        known = 0.5 * law.width_rad * self._flank + law.compliance_rad_Nm * transmitted
        return known if law.measured is None else known - law.measured.ahead_rad(q, torque, self._direction)

    def _approach(self, wanted: float, step_s: float) -> None:
        """One step of a critically damped follower, with its speed limited so that it can still brake."""
        law, off = self._law, wanted - self.offset_rad
        most = min(law.speed_rad_s, sqrt(law.acceleration_rad_s2 * abs(off)))
        target = min(max(0.5 * PACE_rad_s * off, -most), most)
        a = 2.0 * PACE_rad_s * (target - self.speed_rad_s)
        limit = law.acceleration_rad_s2
        a = min(max(a, -limit), limit)
        self.acceleration_rad_s2 = a
        self.speed_rad_s += a * step_s
        self.offset_rad += self.speed_rad_s * step_s
        if abs(off) < 1e-9 and abs(self.speed_rad_s) < 1e-7:
            self.offset_rad, self.speed_rad_s, self.acceleration_rad_s2 = wanted, 0.0, 0.0
