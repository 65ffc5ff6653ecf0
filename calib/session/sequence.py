"""The order of a session: above a point, the hand takes the tip down and seats it, rest, average, record, up, on.

The drives never take the tip down to the board: an arm that is not calibrated yet does not know where that is.

Every function here is a generator of Progress, so that whoever runs it can draw a bar and stop at any time:
on every way out the hand lets go and the drives hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

from calib.points_writer import PointsWriter, Record
from calib.session.ports import ArmPort, Camera, Inverse, Sample, TipSeat, Vector
from calib.session.still import wait_for_rest
from control.errors import ArmError


@dataclass(frozen=True, slots=True)
class BoardPoint:
    """A cavity as the board stands in one setup: name, position and the board's normal, base frame."""

    setup: str
    point: str
    tip_m: Vector
    normal: Vector = (0.0, 0.0, 1.0)
    repeat: int = 1


@dataclass(frozen=True, slots=True)
class FreePose:
    """A pose away from the board, where the camera measures the tip."""

    setup: str
    point: str
    q_rad: tuple[float, ...]
    repeat: int = 1


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """How a point is taken. The defaults suit encoders of some 0.03 mrad at the joint."""

    approach_m: float = 0.06  # an uncalibrated arm of half a metre is some 3 cm off
    still_limit_rad: float = 1e-4
    still_s: float = 0.1
    patience_s: float = 10.0
    window_s: float = 0.02
    average_s: float = 0.1
    payload_kg: float = 0.0


class Stage(Enum):
    """What has just happened."""

    SETUP = "setup stands"
    ABOVE = "above the point"
    SEATED = "tip seated"
    RECORDED = "recorded"
    KEPT = "recorded earlier"
    UNREACHABLE = "out of reach"


@dataclass(frozen=True, slots=True)
class Progress:
    """One step: `done_count` of `total_count` points are through; with the record, or the reason for none."""

    stage: Stage
    done_count: int
    total_count: int
    setup: str
    point: str
    record: Record | None = None
    reason: str = ""


def step_through(
    points: Sequence[BoardPoint],
    inverse: Inverse,
    arm: ArmPort,
    seat: TipSeat,
    writer: PointsWriter,
    settings: SessionSettings | None = None,
    camera: Camera | None = None,
    set_up: Callable[[str], None] | None = None,
) -> Iterator[Progress]:
    """Visit the cavities in the order given and record each; those that the file holds already are passed
    over.

    The tip of a record is the cavity, or what the camera saw if there is one. `set_up` is called with the
    name of each setup before its first point, with the arm lifted. A point that the nominal arm cannot reach
    is reported and left.
    """
    how = settings or SessionSettings()
    walk = _Walk(inverse, arm, how)
    standing = ""
    for done, target in enumerate(points, start=1):
        if (target.setup, target.point, target.repeat) in writer.recorded:
            yield _progress(Stage.KEPT, done, points, target)
            continue
        try:
            above = walk.plan(target)
        except ArmError as error:
            yield _progress(Stage.UNREACHABLE, done, points, target, reason=str(error))
            continue
        if target.setup != standing:
            walk.lift()
            if set_up is not None:
                set_up(target.setup)
            standing = target.setup
            yield _progress(Stage.SETUP, done - 1, points, target)
        walk.go_above(above)
        yield _progress(Stage.ABOVE, done - 1, points, target)
        seat.grip()
        try:
            arm.release()
            seat.seat(target.tip_m)
            arm.hold()
            yield _progress(Stage.SEATED, done - 1, points, target)
            record = _record(target, target.tip_m, arm, how, camera)
            writer.append(record)
        finally:
            try:
                arm.hold()
            finally:
                seat.let_go()
        yield _progress(Stage.RECORDED, done, points, target, record)
    walk.lift()


def take_free_poses(
    poses: Sequence[FreePose],
    arm: ArmPort,
    camera: Camera,
    writer: PointsWriter,
    settings: SessionSettings | None = None,
) -> Iterator[Progress]:
    """Visit poses away from the board, or verification points; the camera says where the tip is."""
    how = settings or SessionSettings()
    for done, pose in enumerate(poses, start=1):
        if (pose.setup, pose.point, pose.repeat) in writer.recorded:
            yield _progress(Stage.KEPT, done, poses, pose)
            continue
        arm.move_to_q(pose.q_rad)
        record = _record(pose, None, arm, how, camera)
        writer.append(record)
        yield _progress(Stage.RECORDED, done, poses, pose, record)


class _Walk:
    """Moves between points: up along the board's normal, and across."""

    def __init__(self, inverse: Inverse, arm: ArmPort, how: SessionSettings) -> None:
        self._inverse, self._arm, self._how = inverse, arm, how
        self._q_rad = arm.average(how.window_s).q_rad
        self._above: tuple[float, ...] | None = None

    def plan(self, target: BoardPoint) -> tuple[float, ...]:
        """Angles above the point, nearest to where the arm is; ArmError if it or the one above is out of reach."""
        x, y, z = (p + self._how.approach_m * n for p, n in zip(target.tip_m, target.normal, strict=True))
        above = tuple(self._inverse.nearest((x, y, z), self._q_rad))
        self._inverse.nearest(target.tip_m, above)
        return above

    def lift(self) -> None:
        """Up from the point where the arm is, if it is at one."""
        if self._above is not None:
            self._arm.move_to_q(self._above)
            self._above = None

    def go_above(self, above: tuple[float, ...]) -> None:
        """Up, and across to above the next point."""
        self.lift()
        self._arm.move_to_q(above)
        self._q_rad = self._above = above


def _record(
    target: BoardPoint | FreePose,
    tip_m: Vector | None,
    arm: ArmPort,
    how: SessionSettings,
    camera: Camera | None,
) -> Record:
    """Wait for rest, average, and look with the camera if there is one."""
    wait_for_rest(arm, how.still_limit_rad, how.still_s, how.patience_s, how.window_s)
    t_s = arm.now_s()
    sample: Sample = arm.average(how.average_s)
    seen_m = camera.measure(how.average_s)[0] if camera is not None else tip_m
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
        seen_m,
    )


def _progress(
    stage: Stage,
    done: int,
    all_points: Sequence[BoardPoint] | Sequence[FreePose],
    target: BoardPoint | FreePose,
    record: Record | None = None,
    reason: str = "",
) -> Progress:
    return Progress(stage, done, len(all_points), target.setup, target.point, record, reason)
