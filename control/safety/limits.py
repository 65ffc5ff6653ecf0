"""Limits as pure functions: (wanted, last, measured, limits) -> allowed, with the reason for each clip.

These are the last check before the boards: plans are checked before they
start, so a clip here indicates an error upstream, and the loop treats it as a fault. A number that is not
finite is never passed on: it raises `NotFinite`, which the loop turns into a fault.

Each comparison is written so that a bound itself is allowed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from control.errors import ArmError

# Names of the limits, by which callers identify a clip.
ACCELERATION, SPEED, RANGE = "acceleration limit [rad/s]", "speed limit [rad/s]", "joint range [rad/s]"
# A plan at its limit exceeds it by rounding errors: 1e-9 rad/s is 2e-12 rad in a cycle of 2 ms.
_ROUNDING_RAD_S = 1e-9
OUTSIDE_rad = 0.2  # of its range, where a pushed or sunken joint may stand


class NotFinite(ArmError):
    """A NaN or an infinite number where a measured or wanted value was expected; str() names it."""


class Clip(NamedTuple):
    """Why a value was changed: name of the limit, joint 1-based (0: none), wanted and allowed value."""

    limit: str
    joint: int
    wanted: float
    allowed: float

    def __str__(self) -> str:
        where = f"joint {self.joint} " if self.joint else ""
        return f"{where}{self.limit}: wanted {self.wanted:.6g}, allowed {self.allowed:.6g}"


class Allowed(NamedTuple):
    """A value inside its limits, and one `Clip` for each limit that changed it."""

    value: float
    reasons: tuple[Clip, ...]


@dataclass(frozen=True, slots=True)
class UniqueTurn:
    """A joint whose encoder is absolute within `turn_rad`; a joint that it shows far outside of its range is elsewhere."""

    joint: int  # 0-based
    name: str
    lower_rad: float
    upper_rad: float
    turn_rad: float

    def objection(self, q_rad: float) -> str:
        """Why the joint cannot be at `q_rad`; empty if it can. A little outside, it may truly be: pushed, or sunk."""
        excess_rad = max(self.lower_rad - q_rad, q_rad - self.upper_rad)
        # Beyond the middle of what the range leaves of the turn, the joint is nearer to the range's other end.
        spare_rad = self.turn_rad - (self.upper_rad - self.lower_rad)
        if excess_rad <= min(OUTSIDE_rad, 0.5 * spare_rad):
            return ""
        return (
            f"{self.name} reads {q_rad:.3f} rad, {excess_rad:.3f} rad outside its limits ({self.lower_rad:.3f} to"
            f" {self.upper_rad:.3f} rad): its encoder may be a turn off ({self.turn_rad:.3f} rad), or zero_count wrong. Bring the"
            " joint into its range by hand, switch its board off and on, and compare the angle with the arm"
        )


@dataclass(frozen=True, slots=True)
class SetPointLimits:
    """Limits of one joint's position set-point; see `limit_set_point`. All but the range must be positive."""

    lower_rad: float
    upper_rad: float
    speed_rad_s: float
    acceleration_rad_s2: float

    def __post_init__(self) -> None:
        """Refuse invalid limits: a limit of NaN would allow everything."""
        if not -math.inf < self.lower_rad < self.upper_rad < math.inf:
            raise ArmError(f"joint range: expected lower < upper, got {self.lower_rad} to {self.upper_rad} rad")
        for name in ("speed_rad_s", "acceleration_rad_s2"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ArmError(f"set-point limit {name}: expected a positive finite number, got {value}")


class AllowedSetPoint(NamedTuple):
    """Limited position and speed set-points of all joints, and a `Clip` for each change."""

    q_rad: tuple[float, ...]
    speed_rad_s: tuple[float, ...]
    reasons: tuple[Clip, ...]


def clamp(wanted: float, lower: float, upper: float, limit: str, joint: int = 0) -> Allowed:
    """Clamp `wanted` to lower .. upper; the bounds themselves are allowed.

    Raises:
        NotFinite: `wanted` is NaN or infinite, or the bounds are crossed or NaN.
    """
    if not (lower <= upper and wanted - wanted == 0.0):
        raise NotFinite(f"{limit}: expected a finite value and bounds in order, got {wanted} in {lower} .. {upper}")
    if wanted > upper:
        return Allowed(upper, (Clip(limit, joint, wanted, upper),))
    if wanted < lower:
        return Allowed(lower, (Clip(limit, joint, wanted, lower),))
    return Allowed(wanted, ())


def voltage_range(
    voltage_limit_V: float, current_limit_A: float, resistance_ohm: float, back_emf_V: float
) -> tuple[float, float]:
    """Motor voltages (lower, upper), within +-voltage_limit, that keep the steady current within its limit.

    i = (u - back_emf) / R, neglecting inductance: within its time constant the current is smaller. If the
    motor turns so fast that no voltage in range keeps the limit, both bounds are the nearest voltage.
    """
    total = voltage_limit_V + current_limit_A + resistance_ohm + back_emf_V
    if total - total != 0.0:
        raise NotFinite(
            f"voltage range: expected finite numbers, got back-EMF {back_emf_V} V, current limit"
            f" {current_limit_A} A, resistance {resistance_ohm} ohm, voltage limit {voltage_limit_V} V"
        )
    swing_V = current_limit_A * resistance_ohm
    lower, upper = back_emf_V - swing_V, back_emf_V + swing_V
    if lower < -voltage_limit_V:
        lower = -voltage_limit_V
    elif lower > voltage_limit_V:
        lower = voltage_limit_V
    if upper > voltage_limit_V:
        upper = voltage_limit_V
    elif upper < -voltage_limit_V:
        upper = -voltage_limit_V
    return lower, upper


def limit_set_point(
    wanted_rad: Sequence[float],
    last_rad: Sequence[float],
    last_speed_rad_s: Sequence[float],
    limits: Sequence[SetPointLimits],
    period_s: float,
) -> AllowedSetPoint:
    """The set-point of this cycle, one period after the last, for n joints (sequences of n).

    Per joint the step is bounded by acceleration, then speed, then by the speed that can still stop at the end of the
    range, and the position by the range itself, which wins over all others. A joint whose last set-point is
    outside its range (put there by hand) may stay or come back but goes no further out.

    Raises:
        NotFinite: any wanted or last value is NaN or infinite.
    """
    q_rad: list[float] = []
    speed_rad_s: list[float] = []
    reasons: list[Clip] = []
    joints = zip(wanted_rad, last_rad, last_speed_rad_s, limits, strict=True)
    for joint, (wanted, last, last_speed, limit) in enumerate(joints, 1):
        if wanted - wanted != 0.0 or last - last != 0.0 or last_speed - last_speed != 0.0:
            raise NotFinite(
                f"joint {joint} set-point: expected finite numbers, got {wanted} rad after {last} rad at {last_speed} rad/s"
            )
        speed = (wanted - last) / period_s
        acceleration = limit.acceleration_rad_s2
        room = limit.upper_rad - wanted if speed > 0.0 else wanted - limit.lower_rad
        # Whether certainly no limit applies, slightly stricter than `stopping_speed`: so it is in almost every cycle.
        if not (
            -acceleration * period_s <= speed - last_speed <= acceleration * period_s
            and -limit.speed_rad_s <= speed <= limit.speed_rad_s
            and limit.lower_rad <= wanted <= limit.upper_rad
            and speed * speed <= 2.0 * acceleration * room
        ):
            allowed = speed
            for name, least, most in _speed_limits(last, last_speed, limit, period_s):
                clip = clamp(allowed, least - _ROUNDING_RAD_S, most + _ROUNDING_RAD_S, name, joint)
                allowed = clip.value
                reasons.extend(clip.reasons)
            moved = wanted if allowed == speed else last + allowed * period_s
            wanted = _inside(moved, last, limit)
            speed = (wanted - last) / period_s
        q_rad.append(wanted)
        speed_rad_s.append(speed)
    return AllowedSetPoint(tuple(q_rad), tuple(speed_rad_s), tuple(reasons))


def _speed_limits(last: float, last_speed: float, limit: SetPointLimits, period_s: float) -> tuple[tuple[str, float, float], ...]:
    """Name, lower and upper limit of the speed of this step, by acceleration, speed and range, in this order."""
    change = limit.acceleration_rad_s2 * period_s
    upper = stopping_speed(limit.upper_rad - last, limit.acceleration_rad_s2, period_s)
    lower = -stopping_speed(last - limit.lower_rad, limit.acceleration_rad_s2, period_s)
    return (
        (ACCELERATION, last_speed - change, last_speed + change),
        (SPEED, -limit.speed_rad_s, limit.speed_rad_s),
        (RANGE, lower, upper),
    )


def _inside(position: float, last: float, limit: SetPointLimits) -> float:
    """Clamp `position` to the joint's range, extended to the last set-point."""
    return min(max(position, min(limit.lower_rad, last)), max(limit.upper_rad, last))


def stopping_speed(distance_rad: float, acceleration_rad_s2: float, period_s: float) -> float:
    """Highest speed of the next step from which braking at `acceleration`, in cycles, ends in `distance`.

    With c = a T the speed change of a cycle, a step at speed (n + f) c and the n slower ones after it cover
    a T^2 (n (n + 1) / 2 + f (n + 1)), n whole, 0 <= f < 1; this is its inverse. Zero where no distance is
    left.
    """
    if distance_rad <= 0.0:
        return 0.0
    change = acceleration_rad_s2 * period_s
    cycles = distance_rad / (change * period_s)
    whole = math.floor((math.sqrt(1.0 + 8.0 * cycles) - 1.0) / 2.0)
    part = (cycles - whole * (whole + 1) / 2.0) / (whole + 1)
    return (whole + part) * change


def allowed_lag(speed_set_rad_s: float, lag_s: float, before_rad: float, elapsed_s: float) -> float:
    """Following error [rad] that a joint may have because it lags behind its set-point by up to `lag_s`.

    It grows with the set speed at once. When the set-point slows down, a joint that lags still has its way to go: then it is
    the error e of a first-order lag, de/dt = |speed| - e/lag_s, from what was allowed `elapsed_s` before.
    """
    speed_rad_s = abs(speed_set_rad_s)
    steady_rad = lag_s * speed_rad_s
    left_rad = (before_rad + speed_rad_s * elapsed_s) * lag_s / (lag_s + elapsed_s) if lag_s > 0.0 else 0.0
    return left_rad if left_rad > steady_rad else steady_rad


def overrun(measured: float, limit: float) -> float:
    """Excess of |measured| over `limit`; zero or negative: within the limit. For speeds, currents and following errors.

    Raises:
        NotFinite: either is NaN or infinite.
    """
    excess = abs(measured) - limit
    if excess - excess != 0.0:
        raise NotFinite(f"expected finite numbers, got measured {measured}, limit {limit}")
    return excess


def is_stale(now_s: float, received_at_s: float | None, limit_s: float) -> bool:
    """Whether the latest value is older than `limit_s`; never received, or NaN, is stale too."""
    return received_at_s is None or not now_s - received_at_s <= limit_s
