"""What an arm.toml promises: reach, torques and payload, loads of the buses, and what is missing.

In: the file alone, by sampled poses within its limits; nothing is connected. Out: figures, and their text
(`armwright arm`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.design.candidates import joint_box, spread_poses
from control.dynamics.dynamics import Dynamics
from control.errors import MissingModel
from control.kinematics.kinematics import Corners, ForwardKinematics
from control.model.arm import Arm, Drive
from control.model.can_bus import USUAL_LOAD, bus_load, good_rate_Hz
from control.model.drive import JointMap
from control.plain_text import aligned
from firmware_iface.encoder.wire import REPORT_WIRE_BYTES

POSES: Final = 4000
BITS_A_BYTE: Final = 10  # 8N1


@dataclass(frozen=True, slots=True)
class Reach:
    """Where the tip gets within the joint limits, of poses that stay above the floor; heights in the base frame."""

    farthest_m: float  # from axis 1
    highest_m: float
    lowest_m: float
    above_floor: float  # share of the sampled poses


@dataclass(frozen=True, slots=True)
class JointFigures:
    """One joint; torques at the joint, NaN where masses or a drive are missing."""

    joint: int
    lower_rad: float
    upper_rad: float
    speed_rad_s: float  # limit
    free_speed_rad_s: float  # of the motor without load
    torque_Nm: float  # at the current limit
    gravity_Nm: float  # in the worst pose
    moving_Nm: float  # there, accelerating as limited
    step_rad: float  # of the encoder, at the joint

    @property
    def share(self) -> float:
        """Gravity's share of the torque."""
        return self.gravity_Nm / self.torque_Nm


@dataclass(frozen=True, slots=True)
class Payload:
    """Masses at the tip, in kg, that all motors hold: in every pose above the floor, and in half of them; and move.

    moving_kg: in every pose, whichever way all joints accelerate at their limits; moving_joint: the joint that has no torque
    for more. Friction is left out.
    """

    everywhere_kg: float
    in_half_kg: float
    moving_kg: float
    moving_joint: int


@dataclass(frozen=True, slots=True)
class Buses:
    """Loads at a cycle rate, and the highest rate with a CAN load that `doctor` calls good."""

    rate_Hz: float
    can: float
    serial: tuple[float, ...]  # of each encoder board
    can_rate_Hz: float


@dataclass(frozen=True, slots=True)
class ArmSheet:
    """All figures; None where the file lacks what they need (`procedures.arm_sheet.missing`)."""

    reach: Reach
    joints: tuple[JointFigures, ...]
    payload: Payload | None
    buses: Buses | None


def sheet(arm: Arm) -> ArmSheet:
    """The figures of an arm, at its usual cycle rate."""
    q = spread_poses(joint_box(arm, margin_rad=0.0), POSES)
    above = _above_floor(arm, q)
    poses = q[above] if above.any() else q
    gravity = _torques(arm, poses, 0.0)
    payload = None
    if gravity is not None and len(arm.drives) == arm.joint_count:
        payload = _payload(arm, poses, gravity, _torques(arm, poses, 1.0))
    return ArmSheet(
        reach=_reach(arm, poses, float(above.mean())),
        joints=tuple(_joint(arm, joint, poses, gravity) for joint in range(1, arm.joint_count + 1)),
        payload=payload,
        buses=_buses(arm, arm.usual_rate_Hz),
    )


def _above_floor(arm: Arm, q: Array) -> np.ndarray:
    lowest = np.min([corner[2] for corner in Corners(arm).batch(q)], axis=0)
    return np.asarray(lowest >= arm.limits.floor_z_m + arm.limits.floor_clearance_m)


def _reach(arm: Arm, q: Array, above_floor: float) -> Reach:
    tips = ForwardKinematics(arm).tips(q)
    x, y = _axis_1(arm)
    across = np.hypot(tips[:, 0] - x, tips[:, 1] - y)
    heights = tips[:, 2]
    return Reach(float(across.max()), float(heights.max()), float(heights.min()), above_floor)


def _axis_1(arm: Arm) -> tuple[float, float]:
    """Where joint 1's axis meets the base plane: not at the origin if fixed rows come before."""
    first = arm.joints.index(True)
    if first == 0:
        return 0.0, 0.0
    frame = ForwardKinematics(arm).link_transforms(np.zeros((1, arm.joint_count)))[0][first]
    return float(frame[0, 3]), float(frame[1, 3])


def _torques(arm: Arm, q: Array, payload_kg: float) -> Array | None:
    """Gravity torques (poses, n); None if masses are missing."""
    try:
        dynamics = Dynamics(arm, payload_kg)
    except MissingModel:
        return None
    return dynamics.gravities(q)


def _joint(arm: Arm, joint: int, q: Array, gravity: Array | None) -> JointFigures:
    drive = next((one for one in arm.drives if one.joint == joint), None)
    lower, upper = arm.limits_rad[joint - 1]
    held = math.nan if gravity is None else float(np.abs(gravity[:, joint - 1]).max())
    if drive is None:
        nothing = math.nan
        return JointFigures(joint, lower, upper, nothing, nothing, nothing, held, nothing, nothing)
    return JointFigures(
        joint=joint,
        lower_rad=lower,
        upper_rad=upper,
        speed_rad_s=drive.joint_speed_limit_rad_s,
        free_speed_rad_s=drive.supply_V / (drive.torque_constant_Nm_A * drive.gear_ratio),
        torque_Nm=drive.torque_limit_Nm,
        gravity_Nm=held,
        moving_Nm=_moving_Nm(arm, drive, q, gravity),
        step_rad=1.0 / abs(JointMap(drive).counts_per_radian),
    )


def _moving_Nm(arm: Arm, drive: Drive, q: Array, gravity: Array | None) -> float:
    """Gravity and this joint's own acceleration limit together, in the worst pose."""
    if gravity is None or not math.isfinite(drive.joint_acceleration_limit_rad_s2):
        return math.nan
    j = drive.joint - 1
    inertia = Dynamics(arm).mass_matrices(q)[:, j, j]
    return float((np.abs(gravity[:, j]) + inertia * drive.joint_acceleration_limit_rad_s2).max())


def _payload(arm: Arm, q: Array, empty: Array, laden: Array | None) -> Payload | None:
    """Torques are linear in the mass: limit >= |empty + m (laden - empty)| for each joint and pose.

    Moving, the inertia takes sum_j |M_ij| a_j of joint i's torque.
    """
    if laden is None:
        return None
    limits = np.array([arm.drive(j).torque_limit_Nm for j in range(1, arm.joint_count + 1)])
    per_kg = laden - empty
    with np.errstate(divide="ignore"):
        most = (limits - np.sign(per_kg) * empty) / np.abs(per_kg)
    held = np.maximum(most.min(axis=1), 0.0)
    accelerations = np.nan_to_num([drive.joint_acceleration_limit_rad_s2 for drive in arm.drives], posinf=0.0)
    light, heavy = (np.abs(Dynamics(arm, kg).mass_matrices(q)) @ accelerations for kg in (0.0, 1.0))
    needed_per_kg = np.maximum(np.abs(per_kg) + heavy - light, 0.0)  # 0: the mass takes from the coupling of joints
    with np.errstate(divide="ignore"):
        moved = (limits - np.abs(empty) - light) / needed_per_kg
    least = moved.min(axis=0)
    joint = int(least.argmin()) + 1
    return Payload(float(held.min()), float(np.median(held)), max(0.0, float(least.min())), joint)


def _buses(arm: Arm, rate_Hz: float) -> Buses | None:
    if arm.can is None or not arm.drives or not arm.encoder_boards:
        return None
    reports = 2 * REPORT_WIRE_BYTES * BITS_A_BYTE  # two a cycle
    return Buses(
        rate_Hz=rate_Hz,
        can=bus_load([arm], rate_Hz),
        serial=tuple(reports * rate_Hz / board.baud for board in arm.encoder_boards),
        can_rate_Hz=good_rate_Hz([arm], rate_Hz),
    )


@dataclass(frozen=True, slots=True)
class Missing:
    """Something that is not in the file, and what is not possible without it."""

    what: str
    needed_for: str


def missing(arm: Arm) -> tuple[Missing, ...]:
    """Everything that is missing, the most needed first."""
    return tuple(_found(arm))


def _found(arm: Arm) -> Iterator[Missing]:
    has = {drive.joint for drive in arm.drives}
    bare = [joint for joint in range(1, arm.joint_count + 1) if joint not in has]
    if bare:
        yield Missing(f"[[drive]] of {_joints(bare)}", "serve, mock, bringup and every motion; torque margins")
    counts = not arm.drives or any(drive.encoder_board >= 0 for drive in arm.drives)
    talks = not arm.drives or any(arm.kind_of(drive).line == "can" for drive in arm.drives)
    absent = ["[[encoder_board]]"] if counts and not arm.encoder_boards else []
    absent += ["[can]"] if talks and arm.can is None else []
    if absent:
        yield Missing(" and ".join(absent), "serve (or give the ports as options)")
    yield from _masses(arm)
    yield from _limits(arm)
    homeless = [drive.joint for drive in arm.drives if drive.home is None and not arm.has_absolute_encoder(drive)]
    if homeless:
        yield Missing(f"[drive.home] of {_joints(homeless)}", "home (else set the zero on the encoder board)")
    guessed = [drive.joint for drive in arm.drives if _is_turn_guessed(arm, drive)]
    if guessed:
        yield Missing(
            f"absolute_turns of the boards of {_joints(guessed)}",
            "knowing the pose at power-up: the encoder is taken to be at the joint; one at the motor knows one motor turn",
        )
    yield from _electrical(arm)
    if arm.table is None:
        yield Missing(
            "[table]", "session without --camera --free, calibrate without measured tips, verify without --points, demo"
        )
    if arm.camera is None:
        yield Missing("[camera]", "the noise of verify, iso9283 and gap (else it is estimated or assumed)")
    if arm.rest is None:
        yield Missing("[rest]", "tune without --pose; the mock begins at joint angles 0")


def _is_turn_guessed(arm: Arm, drive: Drive) -> bool:
    board = arm.board(drive)
    is_said = board is None or board.absolute_turns is not None or arm.kind_of(drive).is_absolute
    return arm.has_absolute_encoder(drive) and not is_said and drive.gear_ratio != 1.0


def _masses(arm: Arm) -> Iterator[Missing]:
    try:
        Dynamics(arm)
    except MissingModel as error:
        gains = any(None in (drive.pid.kp, drive.pid.ki, drive.pid.kd) for drive in arm.drives)
        what = "feed-forward, guide, mock, payload and torque margins" + ("; serve, without gains" * gains)
        yield Missing(str(error).partition(": ")[2].partition(";")[0], what)


def _limits(arm: Arm) -> Iterator[Missing]:
    for key, needed_for in (
        ("joint_lower_rad", "the joint's end: mock, and motions that stay inside it"),
        ("joint_speed_limit_rad_s", "every motion"),
        ("joint_acceleration_limit_rad_s2", "every motion"),
        ("joint_jerk_limit_rad_s3", "every motion"),
        ("current_limit_A", "a limited torque; torque margins are those at stall"),
    ):
        without = [drive.joint for drive in arm.drives if not math.isfinite(getattr(drive, key))]
        if without:
            yield Missing(f"{key} of {_joints(without)}", needed_for)


def _electrical(arm: Arm) -> Iterator[Missing]:
    for key, needed_for in (
        ("rotor_inertia_kg_m2", "right feed-forward of accelerations and gains from the model"),
        ("inductance_H", "the mock's and gap's current; gap may call its lag a delay"),
    ):
        without = [drive.joint for drive in arm.drives if getattr(drive, key) == 0.0]
        if without:
            yield Missing(f"{key} of {_joints(without)}", needed_for)


def _joints(numbers: list[int]) -> str:
    return f"joint{'s' * (len(numbers) > 1)} {', '.join(map(str, numbers))}"


FULL = 1.0
LITTLE = 0.8  # of the torque: above it, friction and feedback have little left
HEAD = ("joint", "range", "speed", "free", "torque", "gravity", "share", "moving", "step")
UNITS = ("", "deg", "deg/s", "deg/s", "N m", "N m", "%", "N m", "mdeg")


def sheet_lines(arm: Arm, figures: ArmSheet, absent: tuple[Missing, ...]) -> Iterator[str]:
    """The lines of `armwright arm` behind the DH table."""
    reach = figures.reach
    if arm.placeholders:
        yield (
            f"{' and '.join(arm.placeholders)}: PLACEHOLDERS, chosen by `armwright new`: torques, speeds and payload below are"
            " theirs, not your arm's. Write in what your parts have, then take the words out of `placeholders`"
        )
    yield (
        f"reach: {1e3 * reach.farthest_m:.0f} mm from axis 1; heights {1e3 * reach.lowest_m:.0f} to"
        f" {1e3 * reach.highest_m:.0f} mm; {100 * reach.above_floor:.0f} % of all poses stay above the floor"
    )
    yield aligned((HEAD, UNITS, *(_row(joint) for joint in figures.joints)))
    yield "free: without load; gravity, moving (at the acceleration limit): worst pose above the floor; step: of the encoder"
    if figures.payload is not None:
        payload = figures.payload
        yield f"payload: {payload.everywhere_kg:.2f} kg held in every pose, {payload.in_half_kg:.2f} kg in half of them;"
        yield (
            f"  {payload.moving_kg:.2f} kg moved in every pose, with all joints at their acceleration limits at once:"
            f" joint {payload.moving_joint} has no torque for more"
        )
    if figures.buses is not None:
        yield _buses_in_words(arm, figures.buses)
    yield from (f"warning: {text}" for text in warnings(figures))
    yield from (f"missing: {one.what}, needed for {one.needed_for}" for one in absent)


def warnings(figures: ArmSheet) -> Iterator[str]:
    """What cannot work, although nothing is missing."""
    for joint in figures.joints:
        if joint.share > FULL:
            yield f"joint {joint.joint} does not hold the arm: {joint.gravity_Nm:.3g} of {joint.torque_Nm:.3g} N m"
        elif joint.share > LITTLE:
            yield f"joint {joint.joint} has little torque left: gravity takes {100 * joint.share:.0f} %"
        elif joint.moving_Nm > joint.torque_Nm:
            yield (f"joint {joint.joint} cannot accelerate as its limit says: {joint.moving_Nm:.3g} of {joint.torque_Nm:.3g} N m")
        if math.isfinite(joint.speed_rad_s) and joint.speed_rad_s > joint.free_speed_rad_s:
            yield f"joint {joint.joint} is slower than its speed limit, even without load"
    if figures.buses is not None:
        if figures.buses.can > USUAL_LOAD:
            yield "the CAN bus is too slow for its boards: choose a higher bitrate"
        if max(figures.buses.serial) > FULL:
            yield "an encoder board's line is too slow: choose a higher baud rate"


def _row(joint: JointFigures) -> tuple[str, ...]:
    ends = (_number(math.degrees(joint.lower_rad), 1), _number(math.degrees(joint.upper_rad), 1))
    return (
        str(joint.joint),
        " to ".join(ends),
        _number(math.degrees(joint.speed_rad_s), 0),
        _number(math.degrees(joint.free_speed_rad_s), 0),
        _number(joint.torque_Nm, 2),
        _number(joint.gravity_Nm, 2),
        _number(100 * joint.share, 0),
        _number(joint.moving_Nm, 2),
        _number(1e3 * math.degrees(joint.step_rad), 2),
    )


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _buses_in_words(arm: Arm, buses: Buses) -> str:
    lines = ", ".join(f"{board.name} {100 * load:.0f} %" for board, load in zip(arm.encoder_boards, buses.serial, strict=True))
    return f"at {buses.rate_Hz:.0f} Hz: CAN {100 * buses.can:.0f} % (good up to {buses.can_rate_Hz:.0f} Hz); serial {lines}"
