"""Moves an arm by either model, whichever the runtime uses, and measures with the camera.

Points are joint moves to the angles of the model's inverse kinematics, which need no geometry in the loop. A path goes to the
runtime in Cartesian space and through the runtime's own inverse kinematics, so it is converted to one that takes the
joints to the model's angles: q(t) by the model, x'(t) = f(q(t)) by the runtime's forward kinematics.

Only the runtime can correct effects between joints and encoders (backlash, springs, belt, encoder errors). For a model with the
same effects as the runtime's, motions are given in joint angles; for one without any, in encoder angles.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from calib.points.writer import PointsWriter
from calib.session.plan import Target
from calib.session.take import SessionSettings
from control.errors import ArmError
from control.model.arm import Arm
from control.motion.guard import Guard
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.plan import PlannedPath, plan_path
from control.motion.setpoint import at_rest
from control.motion.spline import hermite
from control.motion.waypoints import Waypoints
from control.server.client import ArmClient
from procedures.tour import Bench, How, Stop, tour
from procedures.verify.models import Model
from procedures.verify.places import Place, Way

AVERAGE_s = 0.2  # 20 camera frames
# Section length of a converted path: a cubic of 10 mm follows the original within a few nanometres.
SECTION_m = 0.01


@dataclass(frozen=True, slots=True)
class Run:
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
            kinematics=model.kinematics,
        )
    except ArmError as error:
        raise ArmError(f"{way.name} above the board's setup {way.setup}: {error}") from error


def run(path: PlannedPath, model: Model, runtime_model: Model, client: ArmClient, speed: float) -> Run:
    """Go to the path's start and run it as planned by `model`."""
    as_encoders = not model.has_gears_of(runtime_model)
    client.move_joints(path.q_start_rad, speed, as_encoders=as_encoders)
    client.run_path(handed_over(path, model, runtime_model).to_message(), as_encoders=as_encoders)
    status = client.status()
    in_joints = path if runtime_model.gears and not as_encoders else None
    return Run(int(status["run"]), in_joints, float(status["override"]))


def handed_over(path: PlannedPath, model: Model, runtime_model: Model) -> PlannedPath:
    """The path in the base frame of the runtime's model: the same joint angles at the same times."""
    if runtime_model is model or path.joints is not None:
        return path
    motion = path.motion(model.inverse, model.kinematics)
    points, velocities, poses = [], [], []
    times_s = _times_s(path)
    for time_s in times_s:
        wanted = motion.at(time_s)
        tip_m, rows = runtime_model.kinematics.tip_jacobian(*wanted.q_rad)
        x, y, z = (
            sum(slope * speed for slope, speed in zip(row, wanted.speed_rad_s, strict=True)) for row in rows
        )
        points.append(tip_m)
        velocities.append((x, y, z))
        poses.append(tuple(wanted.q_rad))
    durations_s = [end - start for start, end in pairwise(times_s)]
    return replace(path, spline=hermite(points, velocities, durations_s), q_waypoints_rad=tuple(poses))


def _times_s(path: PlannedPath) -> list[float]:
    """The path's own times, with its sections divided into short ones."""
    times_s = [0.0]
    for start, end in pairwise(path.spline.times_s):
        way_m = max(abs(b - a) for a, b in zip(path.spline.at(start)[0], path.spline.at(end)[0], strict=True))
        cuts = 1 + int(way_m / SECTION_m)
        times_s += [start + (end - start) * k / cuts for k in range(1, cuts)] + [end]
    return times_s
