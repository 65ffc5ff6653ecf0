"""Recording of points: one record at rest, with the tip held in its place; the cavities of a board.

The arm is at rest if no joint has moved by more than a limit for some time. The session: `calib.session.conduct`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.errors import SessionError, UnusablePointsError
from calib.points.points import Points, make_points
from calib.points.writer import Record
from calib.session.moves import ArmPort, TipSeat, TipSensor, Vector
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


def wait_for_rest(arm: ArmPort, limit_rad: float, duration_s: float, patience_s: float, window_s: float) -> None:
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
    clock_offset_s: float = 0.0  # added to the arm's clock, so that times continue when a session is resumed


def take(target: Target, tip_m: Vector | None, arm: ArmPort, how: SessionSettings, camera: TipSensor | None) -> Record:
    """Record the target at the arm's present pose; its tip is the camera's measurement, else tip_m.

    SessionError if the arm does not come to rest.
    """
    wait_for_rest(arm, how.still_limit_rad, how.still_s, how.patience_s, how.window_s)
    t_s = arm.now_s() + how.clock_offset_s
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


@dataclass(frozen=True, slots=True)
class BoardPoint:
    """A cavity of the board in one setup: name, position and the board's normal, base frame."""

    setup: str
    point: str
    tip_m: Vector
    normal: Vector = (0.0, 0.0, 1.0)
    repeat: int = 1


@contextmanager
def seated(tip_m: Vector, arm: ArmPort, seat: TipSeat) -> Iterator[None]:
    """Seat the tip, with the drives holding; on every exit the drives hold and the hand has released the arm."""
    seat.grip()
    try:
        arm.release()
        seat.seat(tip_m)
        arm.hold()
        yield
    finally:
        try:
            arm.hold()
        finally:
            seat.let_go()


Cavities = Mapping[str, Sequence[float] | Array]


def board_points(setup: str, cavities: Cavities, repeat: int = 1) -> tuple[BoardPoint, ...]:
    """Cavities (name to base-frame position) of a board in `setup`, with its normal."""
    positions = np.array([np.asarray(p, dtype=float) for p in cavities.values()])
    normal = board_normal(positions)
    up = (float(normal[0]), float(normal[1]), float(normal[2]))
    return tuple(
        BoardPoint(setup, name, (float(x), float(y), float(z)), up, repeat)
        for name, (x, y, z) in zip(cavities, positions, strict=True)
    )


def board_normal(positions_m: Array) -> Array:
    """Unit normal of the plane through positions (m, 3), pointing up; z if they span no plane."""
    _, spread, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=True)
    if len(spread) < 2 or spread[1] < 1e-9:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(axes[2] * (1.0 if axes[2, 2] >= 0.0 else -1.0))


def with_reference_tips(points: Points, cavities_of: Callable[[str], Cavities]) -> Points:
    """Points whose tip was not measured get the cavity that they sat in; `cavities_of` gives a setup's
    cavities.

    UnusablePointsError if neither a measurement nor a cavity is known.
    """
    tip_m = np.array(points.tip_m)
    unmeasured = np.flatnonzero(np.isnan(tip_m).any(axis=1))
    known = {setup: cavities_of(setup) for setup in dict.fromkeys(points.setup[int(k)] for k in unmeasured)}
    for k in map(int, unmeasured):
        setup, point = points.setup[k], points.point[k]
        if point not in known[setup]:
            raise UnusablePointsError(
                f"point {point} of setup {setup} (pose {k + 1}) has no tip, and the table has no such cavity"
            )
        tip_m[k] = known[setup][point]
    return make_points(
        points.setup,
        points.point,
        points.repeat,
        points.q_rad,
        tip_m,
        points.direction,
        points.current_A,
        points.t_s,
        points.payload_kg,
        points.extra,
    )
