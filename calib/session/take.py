"""Recording of points: one record at rest, and a sequence of cavities without an operator.

The arm is at rest if no joint has moved by more than a limit for some time. With an operator: `calib.session.conduct`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum

import numpy as np

from calib.arrays import Array
from calib.errors import SessionError, UnusablePointsError
from calib.points.points import Points, make_points
from calib.points.writer import PointsWriter, Record
from calib.session.moves import ArmPort, Geometry, TipSeat, TipSensor, Transfers, Vector
from calib.session.plan import Target
from control.errors import ArmError


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


# Unattended recording of points, for mock arms, demos and verification.
#
# Above each point, the hand takes the tip down and seats it; rest, average, record, lift. The drives never take the tip down to
# the board, because an uncalibrated arm does not know its position.
#
# Every function here is a generator of Progress, so that the caller can show a bar and stop at any time: on every exit
# the hand releases the arm and the drives hold. A session with an operator is `calib.session.conduct`.


@dataclass(frozen=True, slots=True)
class BoardPoint:
    """A cavity of the board in one setup: name, position and the board's normal, base frame."""

    setup: str
    point: str
    tip_m: Vector
    normal: Vector = (0.0, 0.0, 1.0)
    repeat: int = 1


class PointStage(Enum):
    """Stage of a point."""

    SETUP = "setup stands"
    ABOVE = "above the point"
    SEATED = "tip seated"
    RECORDED = "recorded"
    KEPT = "recorded earlier"
    UNREACHABLE = "out of reach"


@dataclass(frozen=True, slots=True)
class SessionProgress:
    """One step: `done_count` of `total_count` points are done; with the record, or the reason for none."""

    stage: PointStage
    done_count: int
    total_count: int
    setup: str
    point: str
    record: Record | None = None
    reason: str = ""


def step_through(
    points: Sequence[BoardPoint],
    geometry: Geometry,
    arm: ArmPort,
    seat: TipSeat,
    writer: PointsWriter,
    settings: SessionSettings | None = None,
    camera: TipSensor | None = None,
    set_up: Callable[[str], None] | None = None,
) -> Iterator[SessionProgress]:
    """Visit the cavities in the order given and record each; those that the file holds already are passed
    over.

    The tip of a record is the cavity, or the camera's measurement if there is one. `set_up` is called with the
    name of each setup before its first point, with the arm lifted. A point that the nominal arm cannot reach
    is reported and skipped.
    """
    how = settings or SessionSettings()
    walk = Transfers(geometry, arm, how.approach_m, how.window_s)
    if points:
        walk.stands_over(points[0].tip_m, points[0].normal)
    standing = ""
    for done, point in enumerate(points, start=1):
        if (point.setup, point.point, point.repeat) in writer.recorded:
            yield _progress(PointStage.KEPT, done, points, point)
            continue
        try:
            above = walk.plan(point.tip_m, point.normal)
        except ArmError as error:
            yield _progress(PointStage.UNREACHABLE, done, points, point, reason=str(error))
            continue
        if point.setup != standing:
            walk.lift()
            if set_up is not None:
                set_up(point.setup)
            standing = point.setup
            yield _progress(PointStage.SETUP, done - 1, points, point)
        walk.go(above)
        yield _progress(PointStage.ABOVE, done - 1, points, point)
        walk.stands_at(point.normal)
        with seated(point.tip_m, arm, seat):
            yield _progress(PointStage.SEATED, done - 1, points, point)
            record = take(_target(point), point.tip_m, arm, how, camera)
            writer.append(record)
        yield _progress(PointStage.RECORDED, done, points, point, record)
    walk.lift()


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


def _target(point: BoardPoint) -> Target:
    return Target(point.setup, point.point, point.repeat)


def _progress(
    stage: PointStage,
    done: int,
    all_points: Sequence[BoardPoint],
    target: BoardPoint,
    record: Record | None = None,
    reason: str = "",
) -> SessionProgress:
    return SessionProgress(stage, done, len(all_points), target.setup, target.point, record, reason)


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
