"""One model's part of a verification: places and paths, planned before anything moves, then visited and run.

The arm is moved by either model, whichever the runtime uses, and the camera measures. Points and paths go to the runtime as
joint angles by the model's inverse kinematics, which need no geometry in the loop.

"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import base_frame_of
from calib.arm_problem.observations import Frame
from calib.arrays import frozen
from calib.points.points import Points, joined, make_points, read_points
from calib.points.writer import PointsWriter
from calib.session.plan import Target
from calib.session.take import SessionSettings
from calib.validation.verify import Comparison, Track, TrackPair, compare_repeated
from control.dynamics.joint_side import SIDE_EFFECTS
from control.errors import ArmError, MissingModel
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm, Table, Vector3
from control.model.description import arm_names, load_arm
from control.model.fingerprint import fingerprint
from control.motion.guard import Guard
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.plan import PlannedPath, plan_path
from control.motion.setpoint import at_rest
from control.motion.waypoints import Waypoints
from control.recording.frame_decoder import row_type
from control.recording.reading import Recording
from control.recording.recorder_state import parts_from
from control.safety.modes import Mode
from control.server.channel import Message
from control.server.client import ArmClient
from procedures.tour import Bench, How, Stop, tour


class Model:
    """One model of the arm, and what is needed to move the tip in the frame of table and camera."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.frame: Frame = base_frame_of(arm)

    @cached_property
    def kinematics(self) -> ForwardKinematics:
        """Forward kinematics of this model."""
        return self.inverse.kinematics

    @cached_property
    def inverse(self) -> InverseKinematics:
        """Inverse kinematics of this model."""
        return InverseKinematics(self.arm)

    @cached_property
    def gears(self) -> frozenset[tuple[object, ...]]:
        """Effects of the model between joints and encoders."""
        return frozenset((e.effect, e.joint, *sorted(e.parameters.items())) for e in self.arm.effects if e.effect in SIDE_EFFECTS)

    def has_gears_of(self, runtime_model: "Model") -> bool:
        """Whether a runtime with the other model corrects exactly this model's gear effects."""
        return self.gears == runtime_model.gears

    def in_base(self, point_m: Sequence[float]) -> Vector3:
        """A point of the frame of table and camera, in the model's base frame."""
        x, y, z = self.frame.to_base(np.array([point_m]))[0].tolist()
        return x, y, z

    def tips(self, q_rad: np.ndarray) -> np.ndarray:
        """Tips (m, 3) of poses (m, n), in the frame of table and camera."""
        return self.seen(self.kinematics.tips(q_rad))

    def seen(self, base_m: np.ndarray) -> np.ndarray:
        """Points (m, 3) of the model's base frame, in the frame of table and camera."""
        return np.asarray((base_m - self.frame.origin_m) @ self.frame.rotation)


@dataclass(frozen=True, slots=True)
class ModelPair:
    """The two models that are compared."""

    nominal: Model
    calibrated: Model


def nominal_of(calibrated: Arm, against: str | None) -> Arm:
    """The arm that a calibrated one is compared with: the given one, or the one that it was calibrated from.

    ArmError if its file does not name one, the file is missing, or the two have other joints. Fixed rows and the convention may
    differ: each model predicts by its own.
    """
    nominal = load_arm(against or _source_of(calibrated))
    if nominal.joint_count != calibrated.joint_count:
        shapes = [f"{arm.joint_count} joints, {len(arm.links)} links and {arm.dh_convention} DH" for arm in (nominal, calibrated)]
        raise ArmError(f"{calibrated.path} has {shapes[1]}, {nominal.path} {shapes[0]}: not the same arm")
    return nominal


def _source_of(calibrated: Arm) -> str:
    if calibrated.calibration is None:
        raise ArmError(f"{calibrated.path}: has no [calibration], so its nominal arm is unknown; give it with --against")
    source = calibrated.calibration.source
    beside = (calibrated.path or Path()).parent / source
    for candidate in (beside, Path(source)):
        if candidate.is_file() and (calibrated.path is None or not candidate.samefile(calibrated.path)):
            return str(candidate)
    if Path(source).stem in arm_names():
        return Path(source).stem
    raise ArmError(
        f"{calibrated.path}: its nominal arm {source} was found neither beside it nor in this folder; give it with --against"
    )


def active_model(status: Message, pair: ModelPair) -> Model:
    """The model of the pair that the runtime uses. ArmError if neither."""
    if not status["is_homed"] or status["tip_m"] is None:
        raise ArmError("the arm is not homed, so its angles are unknown: run `armwright home`")
    for model in (pair.calibrated, pair.nominal):
        if fingerprint(model.arm) == status["fingerprint"]:
            return model
    raise ArmError(
        f"the runtime uses another arm than {pair.calibrated.arm.path} or {pair.nominal.arm.path}, so its tip"
        " positions would differ; start `armwright serve` with one of the two"
    )


# Places of a verification: points between the cavities and paths above every tilt of the board, 5 cm up.
#
# No pose here is one of calibration's, which are in the cavities. The board need not be present.


SETUPS = ("normal", "roll", "pitch")
HEIGHT_m = 0.05  # above the board: an uncalibrated arm is some 3 cm off
POINTS = 6
POINTS_RADIUS = 2.0 / 3.0  # of the outermost cavity's
CIRCLE_POINTS = 24
LINE_POINTS = 9
_LEAST_RADIUS_m = 0.02


@dataclass(frozen=True, slots=True)
class Place:
    """A verification point: the wanted tip position in the frame of table and camera.

    `near_rad`: the posture near which an arm with free joints reaches it; None: that of the point before.
    """

    setup: str
    point: str
    tip_m: Vector3
    near_rad: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Way:
    """A path to run: its name, the tilt of the board that it is parallel to, way-points in the frame of table and camera."""

    name: str
    setup: str
    waypoints: Waypoints


def places(table: Table, setups: Sequence[str], height_m: float = HEIGHT_m) -> tuple[Place, ...]:
    """Six points on a circle above each tilt, between the cavities. MissingModel if the board's pose is unknown."""
    radius = POINTS_RADIUS * _radius_m(table)
    return tuple(
        Place(setup, f"v{number + 1}", _above(table, setup, radius, (number + 0.5) / POINTS, height_m))
        for setup in setups
        for number in range(POINTS)
    )


def ways(table: Table, setups: Sequence[str], height_m: float = HEIGHT_m) -> tuple[Way, ...]:
    """A circle, and a straight line across the board's own, above each tilt."""
    return tuple(
        Way(name, setup, Waypoints(tuple(points), None))
        for setup in setups
        for name, points in (("circle", _circle(table, setup, height_m)), ("line", _line(table, setup, height_m)))
    )


def _circle(table: Table, setup: str, height_m: float) -> list[Vector3]:
    radius = _radius_m(table)
    turns = [number / CIRCLE_POINTS for number in range(CIRCLE_POINTS)]
    return [_above(table, setup, radius, turn, height_m) for turn in (*turns, 0.0)]


def _line(table: Table, setup: str, height_m: float) -> list[Vector3]:
    """Along the board's y axis; the cavities' line runs along x."""
    radius = _radius_m(table)
    shares = [2.0 * number / (LINE_POINTS - 1) - 1.0 for number in range(LINE_POINTS)]
    return [tables.to_base(table, setup, (0.0, share * radius, height_m)) for share in shares]


def _above(table: Table, setup: str, radius_m: float, turn: float, height_m: float) -> Vector3:
    angle = 2.0 * math.pi * turn
    return tables.to_base(table, setup, (radius_m * math.cos(angle), radius_m * math.sin(angle), height_m))


def _radius_m(table: Table) -> float:
    """Distance of the outermost cavity from the board's centre."""
    radius = max((math.hypot(x, y) for x, y, _ in tables.board_cavities(table).values()), default=0.0)
    if radius < _LEAST_RADIUS_m:
        raise MissingModel(
            f"the table's cavities reach {radius:.3f} m from the board's centre, expected at least {_LEAST_RADIUS_m}"
            " m for the verification points and paths"
        )
    return radius


# Only the runtime can correct effects between joints and encoders (backlash, springs, belt, encoder errors). For a model with
# the same effects as the runtime's, motions are given in joint angles; for one without any, in encoder angles.


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
            raise ArmError(f"verification point {place.setup} {place.point}: {error}; nothing moved") from error
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


def run(path: PlannedPath, model: Model, runtime_model: Model, client: ArmClient, speed: float) -> SurveyedPath:
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


def _camera_delay_s(time_s: np.ndarray, planned_m: np.ndarray, seen_s: np.ndarray, seen_m: np.ndarray) -> float:
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

    def __init__(self, model: Model, programme: Programme, file: Path) -> None:
        """Plan by the model; the branch is that of the rest pose. Measurements go to `file`."""
        self.model = model
        self._programme = programme
        self._file = file
        q_near_rad = model.arm.rest_rad
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

    def tour(self, repeat: int, runtime_model: Model, client: ArmClient, speed: float) -> Iterator[Stop[None]]:
        """Visit every place once; the camera measures at each, and each is saved before the next."""
        how = How(SessionSettings(average_s=AVERAGE_s), not self.model.has_gears_of(runtime_model))
        stops: list[Stop[None]] = [
            Stop(f"{pose.setup} {pose.point}", pose.q_rad, key=(pose.setup, pose.point, repeat))
            for pose in self._poses
            if pose.q_rad is not None
        ]
        with PointsWriter(self._file, self.model.arm.joint_count) as writer:
            yield from tour(Bench(client, speed=speed), how, stops, writer)

    def drive(self, runtime_model: Model, client: ArmClient, speed: float) -> None:
        """Visit every place and run every path, once."""
        for _ in (*self.tour(1, runtime_model, client, speed), *self.run_ways(runtime_model, client, speed)):
            pass

    @property
    def runs(self) -> list[int]:
        """Numbers of the paths' runs in the recording."""
        return [ran.number for _, ran in self._runs]

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
    by_model = [_by_key(points) for points in (before, after)]
    keys = [key for key in by_model[0] if key in by_model[1]]
    tips = np.array([wanted[setup, point] for setup, point, _ in keys])
    errors = [np.array([measured[key] for key in keys]) - tips for measured in by_model]
    return compare_repeated([key[0] for key in keys], [key[1] for key in keys], tips, *errors)


def _by_key(points: Points) -> dict[tuple[str, str, int], np.ndarray]:
    return {key: points.tip_m[row] for row, key in enumerate(zip(points.setup, points.point, points.repeat, strict=True))}


def paired(programme: Programme, before: Sequence[Track], after: Sequence[Track]) -> tuple[TrackPair, ...]:
    """The tracks by both models."""
    return tuple(
        TrackPair(way.name, way.setup, first, second) for way, first, second in zip(programme.ways, before, after, strict=True)
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
