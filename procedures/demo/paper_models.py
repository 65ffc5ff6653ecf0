"""What the replay of the paper does: its targets, how the arm is moved to them, and the models that are identified."""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.joint_effects import known_corrections, unclear_flanks, unphysical
from calib.arrays import Array
from calib.calibration import calibrated_arm
from calib.identify.identification import Identification, identify
from calib.points.points import Points, make_points
from calib.points.writer import PointsWriter, Record
from calib.session.moves import ArmGeometry, ClearPaths
from calib.session.plan import Target
from calib.session.take import BoardPoint, SessionSettings, seated, take
from control.dynamics.static_pose import friction_Nm, gravity_Nm, resting, torque_per_A
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics
from control.model import table as tables
from control.model.arm import Arm, Effect, Table, Vector3
from control.server.client import ArmClient
from procedures.mock import MockBench
from procedures.ports import HandPort, RuntimePort
from procedures.tour import Bench, How, Stop, tour

SETUPS: Final = ("normal", "roll", "pitch")
OTHER: Final = "other trajectory"
# Of points above the board: an uncalibrated arm is some 3 cm off, and approaches begin up to 4 cm below them.
HEIGHT_m: Final = 0.06
RADIUS_m: Final = 0.06
POINTS: Final = 6  # "points 1-6" of the paper's verification trajectory
STOPS: Final = 10
FREE_COUNT: Final = 12
CANDIDATES: Final = 2000
FREE_HEIGHT_m: Final = 0.2  # of the tip above the base
SHARE_OF_RANGE: Final = 0.85
YAW_rad: Final = 1.2  # in front of the arm, visible to the camera
TURNING: Final = 0.25  # of a joint's largest gravity torque: above this, friction does not change the flank

Goal = tuple[str, str, Vector3]  # setup, point, tip in the base frame


def verification_targets(table: Table) -> tuple[Goal, ...]:
    """Between the cavities and above each tilt of the board; none of them is a calibration point."""
    targets = []
    for setup in SETUPS:
        for number in range(POINTS):
            angle = 2.0 * np.pi * (number + 0.5) / POINTS
            place = (RADIUS_m * float(np.cos(angle)), RADIUS_m * float(np.sin(angle)), HEIGHT_m)
            targets.append((setup, f"v{number + 1}", tables.to_base(table, setup, place)))
    return tuple(targets)


def other_trajectory(table: Table) -> tuple[Goal, ...]:
    """Stops on a slanting ellipse over the board, larger than it and higher: the paper's Table 6 and Fig. 10."""
    turn = 2.0 * np.pi * np.arange(STOPS) / STOPS
    place = np.column_stack((0.1 * np.cos(turn), 0.15 * np.sin(turn), 0.14 + 0.06 * np.sin(turn + 0.7)))
    centre = np.array(tables.board_origin(table))
    return tuple((OTHER, f"t{k + 1}", (float(x), float(y), float(z))) for k, (x, y, z) in enumerate(centre + place))


def free_poses(arm: Arm) -> Array:
    """Joint angles (FREE_COUNT, n) spread over the workspace, including poses where gravity changes sign.

    Each next pose is the candidate farthest from those chosen, in joint angles and in gravity torques, where only
    those near 0 differ.
    """
    lower, upper = np.clip(np.array(arm.limits_rad), -np.pi, np.pi).T
    middle, half = 0.5 * (lower + upper), 0.5 * SHARE_OF_RANGE * (upper - lower)
    half[0] = min(half[0], YAW_rad)
    q = np.random.default_rng(0).uniform(middle - half, middle + half, (CANDIDATES, arm.joint_count))
    q = q[ForwardKinematics(arm).tips(q)[:, 2] > FREE_HEIGHT_m]
    gravity = gravity_Nm(arm, q)
    scale = np.maximum(TURNING * np.abs(gravity).max(axis=0), 1e-6)
    turning = np.clip(gravity / scale, -1.0, 1.0)
    features = np.hstack(((q - middle) / half, turning))
    chosen = [int(np.argmin(np.linalg.norm(features, axis=1)))]
    distance = np.full(len(q), np.inf)
    while len(chosen) < FREE_COUNT:
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(distance)))
    return np.asarray(q[chosen])


APPROACH_rad: Final = 0.06  # last approach of every joint: several times the backlash
# Of the joints' limits, for the approach. At full speed the links' inertia throws the gears onto the other flank when the arm
# brakes, which neither currents nor directions show; at 0.3, link friction brakes harder than the motors.
GENTLE: Final = 0.3
ABOVE_m: Final = 0.06  # an uncalibrated arm is some 3 cm off


@dataclass(frozen=True, slots=True)
class GentlePose:
    """Target encoder angles, and the sign of each joint's last motion."""

    setup: str
    point: str
    q_rad: tuple[float, ...]
    direction: tuple[int, ...]
    repeat: int = 1


class Mover:
    """The bench's arm, commanded in encoder angles: its runtime knows the nominal arm; identified errors are corrected here."""

    def __init__(self, arm: Arm, bench: MockBench, client: ArmClient) -> None:
        self._arm, self._bench = arm, Bench(client, speed=bench.speed)
        self._inverse, self._ways = InverseKinematics(arm), ClearPaths(arm, ArmGeometry(arm))
        self._port = RuntimePort(client, bench.speed, as_encoders=True)
        self._hand = HandPort(bench.rig.hand, bench.wait)

    @property
    def q_rad(self) -> tuple[float, ...]:
        """The pose by the encoders."""
        return tuple(self._bench.client.status()["q_rad"])

    def visit(self, poses: Sequence[GentlePose], writer: PointsWriter) -> Iterator[Stop[None]]:
        """Each pose before it is approached, gently and clear of table and floor; encoders, motors and camera are read there."""
        return tour(self._bench, How(SessionSettings(), as_encoders=True), map(self._stop, poses), writer)

    def _stop(self, pose: GentlePose) -> Stop[None]:
        start = inside(self._arm, np.array(pose.q_rad) - APPROACH_rad * np.array(pose.direction))
        way = tuple(self._ways.stops(self.q_rad, start.tolist(), None))
        return Stop(pose.point, pose.q_rad, way, GENTLE, (pose.setup, pose.point, pose.repeat))

    def seat(self, points: Sequence[BoardPoint], writer: PointsWriter) -> Iterator[Record]:
        """Each cavity: move above it by the nominal model, then by hand with the drives off, as the authors did."""
        for point in points:
            x, y, z = (p + ABOVE_m * n for p, n in zip(point.tip_m, point.normal, strict=True))
            above = self._inverse.nearest((x, y, z), self.q_rad)
            self._port.move_to_q(above)
            with seated(point.tip_m, self._port, self._hand):
                target = Target(point.setup, point.point, point.repeat)
                record = take(target, point.tip_m, self._port, SessionSettings(), None)
                writer.append(record)
            self._port.move_to_q(above)
            yield record


def inside(arm: Arm, q_rad: Array) -> Array:
    """The angles within the joints' limits."""
    lower, upper = np.array(arm.limits_rad).T
    return np.clip(q_rad, lower, upper)


TILTS, FREE, BACKLASH = "all tilts", "tilts and free", "with backlash"


@dataclass(frozen=True, slots=True)
class PaperModel:
    """An identification: the resulting arm, the points used, and remarks."""

    name: str
    what: str
    arm: Arm
    points_count: int
    found: Identification
    remarks: tuple[str, ...]

    @property
    def backlash(self) -> tuple[Effect, ...]:
        """Backlash of the model."""
        return tuple(effect for effect in self.arm.effects if effect.effect == "backlash")


def models_of(arm: Arm, points: Points) -> tuple[PaperModel, ...]:
    """The identifications: each tilt alone as the authors did, all tilts, free poses as well, backlash in the model."""
    tilts = [k for k, setup in enumerate(points.setup) if setup in SETUPS]
    alone = [
        _identified(arm, points.chosen([k for k in tilts if points.setup[k] == s]), s, f"the {s} board alone") for s in SETUPS
    ]
    return (
        *alone,
        _identified(arm, points.chosen(tilts), TILTS, "the three tilts together"),
        _identified(arm, points, FREE, "the tilts and free poses, geometry alone"),
        _identified(arm, points, BACKLASH, "the tilts and free poses, backlash in the model", True),
    )


def _identified(arm: Arm, points: Points, name: str, what: str, has_backlash: bool = False) -> PaperModel:
    """Identify by the sum of distances within 5 mm and 2 degrees, as in the paper."""
    wanted = [f"backlash:{joint}" for joint in range(1, arm.joint_count + 1)] if has_backlash else []
    identification = identify(problem_of(arm, points, Choice(effects=tuple(wanted))))
    notes = (*identification.in_words(), *unclear_flanks(arm, points, wanted), *unphysical(identification.solution.corrections))
    return PaperModel(name, what, calibrated_arm(arm, identification), len(points), identification, notes)


def table_says(arm: Arm, points: Points) -> tuple[str, ...]:
    """Remarks on backlash from the tilts alone: flanks that never change."""
    tilts = points.chosen([k for k, setup in enumerate(points.setup) if setup in SETUPS])
    wanted = [f"backlash:{joint}" for joint in range(1, arm.joint_count + 1)]
    return unclear_flanks(arm, tilts, wanted)


def with_friction(model: PaperModel, arm: Arm, points: Points) -> Arm:
    """The model's arm with the dry friction shown by its motors, from which flanks are predicted before motion."""
    gravity = gravity_Nm(arm, points.q_rad)
    level, _ = friction_Nm(arm, points.current_A * torque_per_A(arm) - gravity, gravity)
    shown = tuple(Effect("coulomb_friction", joint, {"torque_Nm": float(torque)}) for joint, torque in enumerate(level, 1))
    return dataclasses.replace(model.arm, effects=(*model.arm.effects, *shown))


def commands(arm: Arm, targets: Sequence[Goal], start_rad: Sequence[float]) -> tuple[GentlePose, ...]:
    """Encoder angles for tips, by the arm's own model; each joint comes from where it was.

    If the model has backlash, the angles are corrected for the predicted flank; a joint whose flank is
    ambiguous is approached from the side where gravity and friction agree.
    """
    inverse, way = InverseKinematics(arm), [np.array(start_rad)]
    for _, _, tip_m in targets:
        way.append(np.array(inverse.nearest(tip_m, way[-1].tolist())))
    joint_rad = np.array(way[1:])
    direction = np.where(np.diff(way, axis=0) >= 0.0, 1.0, -1.0)
    if any(effect.effect == "backlash" for effect in arm.effects):
        direction = _clear(arm, joint_rad, direction)
    encoder_rad = joint_rad - _ahead(arm, joint_rad, direction)
    return tuple(
        GentlePose(setup, point, tuple(q.tolist()), tuple(int(d) for d in signs))
        for (setup, point, _), q, signs in zip(targets, encoder_rad, direction, strict=True)
    )


def _clear(arm: Arm, joint_rad: Array, direction: Array) -> Array:
    """Directions (m, n) with an unambiguous flank."""
    rest = resting(arm, joint_rad, direction)
    with_gravity = np.where(rest.gravity_Nm >= 0.0, 1.0, -1.0)
    return np.where(rest.flank == 0.0, with_gravity, direction)


def _ahead(arm: Arm, joint_rad: Array, direction: Array) -> Array:
    """Joint minus encoder angles (m, n) by the arm's static effects."""
    m = len(joint_rad)
    there = make_points([""] * m, [str(k) for k in range(m)], [1] * m, joint_rad, np.full((m, 3), np.nan), direction)
    return known_corrections(arm, there)
