"""One record: wait until the arm is at rest, average, measure with the camera.

The arm is at rest if no joint has moved by more than a limit, beside one count of its encoder, for some time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from calib.errors import SessionError
from calib.points.writer import Record
from calib.session.moves import ArmPort, TipSensor, Vector
from calib.session.plan import Target


class StandstillWindow:
    """Detects from times and joint angles that the arm is at rest.

    An encoder that stands between two counts gives now one and now the other: a count is no motion.
    """

    def __init__(self, limit_rad: float, duration_s: float) -> None:
        """At rest: over the last duration_s no joint spanned more than limit_rad and a count."""
        self._limit_rad, self._duration_s = limit_rad, duration_s
        self._count_rad: Sequence[float] = ()
        self._seen: deque[tuple[float, tuple[float, ...]]] = deque()

    def update(self, t_s: float, q_rad: Sequence[float], count_rad: Sequence[float] = ()) -> bool:
        """Add one reading and the size of a count, if it is known; True if the arm is at rest. Times must increase."""
        self._count_rad = count_rad or (0.0,) * len(q_rad)
        self._seen.append((t_s, tuple(q_rad)))
        while len(self._seen) > 1 and self._seen[1][0] <= t_s - self._duration_s:
            self._seen.popleft()
        is_long_enough = t_s - self._seen[0][0] >= self._duration_s * (1.0 - 1e-9)
        return is_long_enough and self.motion_rad <= self._limit_rad

    @property
    def motion_rad(self) -> float:
        """The largest span of a joint over the window beyond a count of its encoder."""
        joints: Iterable[tuple[float, ...]] = zip(*(q for _, q in self._seen), strict=True)
        spans_rad = (max(angles) - min(angles) for angles in joints)
        return max(span - count for span, count in zip(spans_rad, self._count_rad, strict=True))


def wait_for_rest(
    arm: ArmPort, limit_rad: float, duration_s: float, patience_s: float, window_s: float
) -> None:
    """Return when the arm rests; SessionError if it does not within patience_s. Reads means over window_s."""
    still = StandstillWindow(limit_rad, duration_s)
    began_s = arm.now_s()
    while True:
        sample = arm.average(window_s)
        now_s = arm.now_s()
        if still.update(now_s, sample.q_rad, sample.count_rad):
            return
        if now_s - began_s > patience_s:
            raise SessionError(
                f"the arm does not come to rest: a joint still moves by {still.motion_rad:.2g} rad within"
                f" {duration_s:g} s after {patience_s:g} s (limit {limit_rad:.2g} rad);"
                " check whether it is pushed or oscillates"
            )


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Settings for recording a point. The defaults suit encoders of some 0.03 mrad at the joint."""

    approach_m: float = 0.06  # an uncalibrated arm of half a metre is some 3 cm off
    still_limit_rad: float = 1e-4
    still_s: float = 0.1
    patience_s: float = 10.0
    window_s: float = 0.02
    average_s: float = 0.1
    payload_kg: float = 0.0


def take(
    target: Target,
    tip_m: Vector | None,
    arm: ArmPort,
    how: SessionSettings,
    camera: TipSensor | None,
    clock_offset_s: float = 0.0,
) -> Record:
    """Record the target at the arm's present pose; its tip is the camera's measurement, else tip_m.

    SessionError if the arm does not come to rest.
    """
    wait_for_rest(arm, how.still_limit_rad, how.still_s, how.patience_s, how.window_s)
    t_s = arm.now_s() + clock_offset_s
    sample = arm.average(how.average_s)
    seen = camera.measure(how.average_s) if camera is not None else None
    return Record(
        target.setup,
        target.point,
        target.repeat,
        sample.q_rad,
        sample.q_sd_rad,
        sample.direction,
        sample.current_A,
        t_s,
        how.payload_kg,
        tip_m if seen is None else seen.tip_m,
        sample.temperature_C,
        target.approach,
        orientation=None if seen is None else seen.orientation,
    )
