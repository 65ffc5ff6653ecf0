"""One model's part of a verification: planned before anything moves, then visits of the points and runs of the paths.

The arm is moved by either model, whichever the runtime uses, and the camera measures. Points and paths go to the runtime as
joint angles by the model's inverse kinematics, which need no geometry in the loop.

Only the runtime can correct effects between joints and encoders (backlash, springs, belt, encoder errors). For a model with
the same effects as the runtime's, motions are given in joint angles; for one without any, in encoder angles.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from calib.arrays import frozen
from calib.points.points import Points, joined, make_points
from calib.points.reading import read_points
from calib.points.writer import PointsWriter
from calib.session.plan import Target
from calib.session.take import SessionSettings
from calib.validation.verify import Comparison, Track, TrackPair, compare_repeated
from control.errors import ArmError
from control.model.arm import Arm
from control.motion.guard import Guard
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.plan import PlannedPath, plan_path
from control.motion.setpoint import at_rest
from control.motion.waypoints import Waypoints
from control.recording.frame_decoder import row_type
from control.recording.parts import parts_from
from control.recording.reading import Recording
from control.safety.table import Mode
from control.server.client import ArmClient
from procedures.tour import Bench, How, Stop, tour
from procedures.verify.models import Model
from procedures.verify.places import Place, Way

AVERAGE_s = 0.2  # 20 camera frames


@dataclass(frozen=True, slots=True)
class SurveyedPath:
    """A path that was run: its run number in the recording; `path` if the recorded set-points are not the joints'."""

    number: int
    path: PlannedPath | None = None
    pace: float = 1.0


def poses_at(places: Sequence[Place], model: Model, q_near_rad: Sequence[float]) -> tuple[Target, ...]:
    """Joint angles at the places, each near its own posture, or on the branch of the previous one.

    ArmError names the first out of reach.
    """
    poses = []
    for place in places:
        try:
            q_near_rad = model.inverse.nearest(model.in_base(place.tip_m), place.near_rad or q_near_rad)
        except ArmError as error:
            raise ArmError(
                f"verification point {place.setup} {place.point}: {error}; nothing moved"
            ) from error
        poses.append(Target(place.setup, place.point, q_rad=tuple(q_near_rad)))
    return tuple(poses)


def require_clear(arm: Arm, stages: Sequence[tuple[Sequence[float], Sequence[float]]]) -> None:
    """ArmError if a joint move from one stage's end to the next one's beginning meets the floor, the table or the base.

    `stages`: joint angles at the beginning and at the end of each.
    """
    limits = JointLimits.of(arm)
    guard = Guard(arm, limits)
    for (_, start), (end, _) in pairwise(stages):
        guard.require_move(JointMove(start, end, limits), at_rest(tuple(start)), end)


def visit(
    poses: Sequence[Target],
    repeat: int,
    client: ArmClient,
    speed: float,
    writer: PointsWriter,
    as_encoders: bool = False,
) -> Iterator[Stop[None]]:
    """Visit all poses once; the camera measures at each, and each is saved before the next."""
    how = How(SessionSettings(average_s=AVERAGE_s), as_encoders)
    stops: list[Stop[None]] = [
        Stop(f"{pose.setup} {pose.point}", pose.q_rad, key=(pose.setup, pose.point, repeat))
        for pose in poses
        if pose.q_rad is not None
    ]
    return tour(Bench(client, speed=speed), how, stops, writer)


def planned(way: Way, model: Model, speed_m_s: float, q_near_rad: Sequence[float]) -> PlannedPath:
    """Plan the path by the model; ArmError if the arm cannot run it. Nothing moves."""
    points = tuple(model.in_base(point) for point in way.waypoints.points)
    try:
        return plan_path(
            model.arm,
            Waypoints(points, None, way.waypoints.places),
            speed_m_s,
            q_near_rad=q_near_rad,
            setup=way.setup,
            inverse=model.inverse,
        )
    except ArmError as error:
        raise ArmError(f"{way.name} above the board's setup {way.setup}: {error}") from error


def run(
    path: PlannedPath, model: Model, runtime_model: Model, client: ArmClient, speed: float
) -> SurveyedPath:
    """Go to the path's start and run it as planned by `model`."""
    as_encoders = not model.has_gears_of(runtime_model)
    client.move_joints(path.q_start_rad, speed, as_encoders=as_encoders)
    client.run_path(path.to_message(), as_encoders=as_encoders)
    status = client.status()
    in_joints = path if runtime_model.gears and not as_encoders else None
    return SurveyedPath(int(status["run"]), in_joints, float(status["override"]))


LONGEST_DELAY_S = 0.1  # for a usable camera
DELAY_STEP_S = 0.001
MOVING = list(Mode).index(Mode.MOVING)
PATIENCE_S = 5.0  # for the recording's writer process


def track_of(recording: Path, model: Model, ran: SurveyedPath, name: str) -> Track:
    """The tip along a run: planned by the model, measured by the camera.

    Planned is the tip at the recorded set-points; if those are encoder angles that differ from the joints', the tip of the path
    at that time of the run. In the frame of table and camera. Camera frames arrive with a constant delay. It is
    estimated as the one for which the measured path best follows the planned one, and removed, so that the error is that of
    the arm.
    """
    rows = recorded(recording)
    rows = rows[(rows["run"] == ran.number) & (rows["mode"] == MOVING)]
    if not len(rows):
        raise ArmError(f"{recording}: contains no run {ran.number}")
    time_s = np.asarray(rows["t_s"])
    planned_m = planned_tips_m(rows, model, ran)
    seen_m = np.column_stack([rows[name] for name in ("x_m", "y_m", "z_m")])
    seen = ~np.isnan(seen_m).any(axis=1)
    if not seen.any():
        raise ArmError(f"{recording}: no camera frame in run {ran.number}: check that the camera was on")
    taken_s = time_s[seen] - _camera_delay_s(time_s, planned_m, time_s[seen], seen_m[seen])
    within = taken_s >= time_s[0]  # the first frames to arrive were taken before the run
    at_s = taken_s[within]
    planned_at_m = _at(at_s, time_s, planned_m)
    return Track(name, frozen(at_s - time_s[0]), frozen(planned_at_m), frozen(seen_m[seen][within]))


def planned_tips_m(rows: np.ndarray, model: Model, ran: SurveyedPath) -> np.ndarray:
    """Planned tips (m, 3) at the rows' times. The first row of a run is one cycle into it."""
    if ran.path is None:
        joints = range(1, model.arm.joint_count + 1)
        return model.tips(np.column_stack([rows[f"q{joint}_set_rad"] for joint in joints]))
    time_s = np.asarray(rows["t_s"])
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    spline = ran.path.spline
    at_s = (ran.pace * (time_s - time_s[0] + period_s)).tolist()
    return model.seen(np.array([spline.at(t)[0] for t in at_s]))


def recorded(recording: Path) -> np.ndarray:
    """The rows of a recording and of its later parts, which may still be growing, as a structured array."""
    return np.concatenate([_rows(part) for part in parts_from(recording)])


def _rows(part: Path) -> np.ndarray:
    opened = Recording.open(part)
    return np.frombuffer(opened.packed(), dtype=row_type(opened.layout.names, opened.layout.packing))


def wait_until_recorded(recording: Path, t_s: float, wait: Callable[[float], None]) -> None:
    """Return when the recording has reached the loop's time `t_s`; ArmError if it does not."""
    for _ in range(int(PATIENCE_S / 0.1)):
        newest = _rows(parts_from(recording)[-1])
        if len(newest) and newest["t_s"][-1] >= t_s:
            return
        wait(0.1)
    raise ArmError(f"{recording}: has stopped growing: check for a full disk")


def _at(time_s: np.ndarray, times_s: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Points (m, 3) between those of times_s."""
    return np.column_stack([np.interp(time_s, times_s, points_m[:, axis]) for axis in range(3)])


def _camera_delay_s(
    time_s: np.ndarray, planned_m: np.ndarray, seen_s: np.ndarray, seen_m: np.ndarray
) -> float:
    """The delay with the least scatter of measured minus planned; a constant offset is not a delay."""
    delays_s = np.arange(0.0, LONGEST_DELAY_S, DELAY_STEP_S)
    scatter = []
    for delay_s in delays_s:
        error = seen_m - _at(seen_s - delay_s, time_s, planned_m)
        scatter.append(float(np.sum((error - error.mean(axis=0)) ** 2)))
    return float(delays_s[int(np.argmin(scatter))])


PATH_SPEED_m_s = 0.15


@dataclass(frozen=True, slots=True)
class Programme:
    """The places of a verification, and the visits of each."""

    places: tuple[Place, ...]
    ways: tuple[Way, ...]
    repeats: int = 1
    path_speed_m_s: float = PATH_SPEED_m_s


class Survey:
    """The arm moved by one model. ArmError if a place or a path is out of reach, or a move from one to the next meets
    something, before anything moves.
    """

    def __init__(self, model: Model, programme: Programme, q_near_rad: Sequence[float], file: Path) -> None:
        self.model = model
        self._programme = programme
        self._file = file
        self._poses = poses_at(programme.places, model, q_near_rad)
        angles = [pose.q_rad or () for pose in self._poses]
        near = angles[0] if angles else q_near_rad
        self._paths = [planned(way, model, programme.path_speed_m_s, near) for way in programme.ways]
        stays = [(q_rad, q_rad) for q_rad in angles]
        runs = [(path.q_start_rad, path.q_waypoints_rad[-1]) for path in self._paths]
        require_clear(model.arm, [*stays, *runs])
        self._runs: list[tuple[Way, SurveyedPath]] = []

    @property
    def q_rad(self) -> np.ndarray:
        """The poses of the places, (m, n)."""
        return np.array([pose.q_rad for pose in self._poses])

    def tour(
        self, repeat: int, runtime_model: Model, client: ArmClient, speed: float
    ) -> Iterator[Stop[None]]:
        """Visit every place once."""
        as_encoders = not self.model.has_gears_of(runtime_model)
        with PointsWriter(self._file, self.model.arm.joint_count) as writer:
            yield from visit(self._poses, repeat, client, speed, writer, as_encoders)

    def run_ways(self, runtime_model: Model, client: ArmClient, speed: float) -> Iterator[Way]:
        """Run every path once; yields each run."""
        for way, path in zip(self._programme.ways, self._paths, strict=True):
            self._runs.append((way, run(path, self.model, runtime_model, client, speed)))
            yield way

    def points(self) -> Points:
        """The measurements at the places, from the file."""
        return read_points(self._file, self.model.arm.joint_count)[0]

    def tracks(self, recording: Path) -> list[Track]:
        """The measured tracks of the paths."""
        return [track_of(recording, self.model, ran, way.name) for way, ran in self._runs]


def compared(programme: Programme, before: Points, after: Points) -> Comparison:
    """Errors (measured minus target) at every place, by both models."""
    wanted = {(place.setup, place.point): place.tip_m for place in programme.places}
    found = [_by_key(points) for points in (before, after)]
    keys = [key for key in found[0] if key in found[1]]
    tips = np.array([wanted[setup, point] for setup, point, _ in keys])
    errors = [np.array([measured[key] for key in keys]) - tips for measured in found]
    return compare_repeated([key[0] for key in keys], [key[1] for key in keys], tips, *errors)


def _by_key(points: Points) -> dict[tuple[str, str, int], np.ndarray]:
    return {
        key: points.tip_m[row]
        for row, key in enumerate(zip(points.setup, points.point, points.repeat, strict=True))
    }


def paired(programme: Programme, before: Sequence[Track], after: Sequence[Track]) -> tuple[TrackPair, ...]:
    """The tracks by both models."""
    return tuple(
        TrackPair(way.name, way.setup, first, second)
        for way, first, second in zip(programme.ways, before, after, strict=True)
    )


def raw_points(programme: Programme, before: Points, after: Points) -> Points:
    """All measurements as one points.csv: columns `model` and `wanted_x_m` ... beyond those of the format."""
    both = joined([before, after])
    wanted = {(place.setup, place.point): place.tip_m for place in programme.places}
    tips = [wanted[name] for name in zip(both.setup, both.point, strict=True)]
    extra = {"model": ("nominal",) * len(before) + ("calibrated",) * len(after)} | {
        f"wanted_{axis}_m": tuple(f"{tip[k]:.9f}" for tip in tips) for k, axis in enumerate("xyz")
    }
    return make_points(
        both.setup,
        both.point,
        both.repeat,
        both.q_rad,
        both.tip_m,
        both.direction,
        both.current_A,
        both.t_s,
        both.payload_kg,
        extra,
    )
