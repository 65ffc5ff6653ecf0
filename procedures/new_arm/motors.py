"""Motors and gears for a first arm.toml: the smallest of a short list that hold the arm with reserve.

They are placeholders with the values of usual parts; the file says so. Currents stay within the motor boards' 20 A.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arm_import.dh_rows import Axis
from calib.arm_import.serial_arm import Mass, SerialArm, TreeJoint
from control.dynamics.dynamics import Dynamics
from control.model.arm import Arm, Drive, Home
from control.model.board_kinds import KINDS
from control.model.drive import SERVOS as DATA_SHEETS
from procedures.new_arm.answers import ChosenParts, Shape
from procedures.on_boards import REFERENCE, HOMING_SPEED_rad_s

POSES: Final = 400
RESERVE: Final = 3.0  # torque at the current limit over what the worst pose needs; homing has half the current
GEARS: Final = (50.0, 80.0, 100.0, 120.0, 160.0, 200.0, 300.0, 500.0)
FREE_SHARE: Final = 0.7  # of the speed without load that a loaded motor reaches
USUAL_SPEED_rad_s: Final = 2.0
MOST_ACCELERATION_rad_s2: Final = 10.0
SERVO_SPEED_rad_s, SERVO_ACCELERATION_rad_s2 = (1.0, 3.0)  # a servo's own loop lags by some hundredths of a second
WANTED_ACCELERATION_rad_s2: Final = 5.0  # against gravity, in the worst pose
MISMATCH: Final = 5.0  # largest inertia over that of the rotor at the joint: a lighter rotor hunts in its gear's backlash
ACCELERATING: Final = 0.5  # share of the torque beyond gravity that accelerates
JERK_PER_ACCELERATION_1_s: Final = 20.0
WITHOUT_LIMIT_rad: Final = math.pi  # range of a joint whose file has no limits
SWITCH_BEFORE_REST_rad: Final = 0.1
TURN_SPARE_rad: Final = 0.1  # that a range leaves of the one turn that an absolute encoder knows


@dataclass(frozen=True, slots=True)
class TypicalMotor:
    """A usual brushed or block-commutated motor; or a servo at its output, whose gear takes from torque and speed.

    A value of 0 is not known.
    """

    torque_constant_Nm_A: float
    resistance_ohm: float
    inductance_H: float
    rotor_inertia_kg_m2: float
    supply_V: float
    current_A: float
    free_rad_s: float = 0.0  # without load, where that is not supply over torque constant
    name: str = ""

    def torque_Nm(self, gear: float) -> float:
        """At the joint, at the current limit."""
        return self.torque_constant_Nm_A * self.current_A * gear

    def speed_rad_s(self, gear: float) -> float:
        """Of the joint that a loaded motor still reaches."""
        return FREE_SHARE * (self.free_rad_s or self.supply_V / self.torque_constant_Nm_A) / gear


MOTORS: Final = (
    TypicalMotor(0.024, 4.8, 4.8e-4, 1.0e-6, 24.0, 1.0),
    TypicalMotor(0.0302, 0.299, 8.2e-5, 1.42e-5, 24.0, 8.0),  # the reference arm's
    TypicalMotor(0.1, 0.12, 1.5e-4, 1.2e-4, 48.0, 20.0),
)


def _servo(name: str) -> TypicalMotor:
    servo = DATA_SHEETS[name]
    return TypicalMotor(
        servo.torque_constant_Nm_A, servo.resistance_ohm, 0.0, 0.0, servo.supply_V, servo.stall_A, servo.free_rad_s, name
    )


# To choose from, the smallest first. One line has one supply, but for the XL330, which a step-down feeds.
SERVOS: Final = {"dynamixel": tuple(map(_servo, ("XL330-M288", "XM430-W350", "XM540-W270"))), "feetech": (_servo("STS3215-12V"),)}


@dataclass(frozen=True, slots=True)
class JointLoad:
    """What a joint has to move: the largest gravity torque and the largest inertia of poses within the limits."""

    torque_Nm: float
    inertia_kg_m2: float


def range_of(joint: TreeJoint, kind: str) -> tuple[float, float]:
    """Limits of a joint on a kind of board, both finite: the mock's end stops stand there.

    Where the board knows the angle at power-up, it knows it within one turn: a wider range is narrowed around its middle.
    """
    lower = joint.lower_rad if math.isfinite(joint.lower_rad) else -WITHOUT_LIMIT_rad
    upper = joint.upper_rad if math.isfinite(joint.upper_rad) else WITHOUT_LIMIT_rad
    is_absolute = kind != REFERENCE and (KINDS[kind].is_absolute or not KINDS[kind].has_switch)
    excess = upper - lower - (2.0 * math.pi - TURN_SPARE_rad)
    if is_absolute and excess > 0.0:
        lower, upper = (_within(lower + 0.5 * excess, lower, upper), _within(upper - 0.5 * excess, lower, upper))
    return lower, upper


def loads(arm: Arm, ranges: Sequence[tuple[float, float]]) -> tuple[JointLoad, ...]:
    """The load of each joint; unknown masses weigh nothing."""
    if not any(link.mass_kg for link in arm.links):
        return (JointLoad(0.0, 0.0),) * arm.joint_count
    low, high = np.array(ranges).T
    q = np.random.default_rng(0).uniform(low, high, (POSES, arm.joint_count))
    q[0] = np.clip(0.0, low, high)
    dynamics = Dynamics(arm)
    torques = np.abs(dynamics.gravities(q)).max(axis=0)
    inertias = np.diagonal(dynamics.mass_matrices(q), axis1=1, axis2=2).max(axis=0)
    return tuple(JointLoad(float(t), float(j)) for t, j in zip(torques, inertias, strict=True))


def drives(
    joints: Sequence[TreeJoint], needed: Sequence[JointLoad], parts: ChosenParts, rest_rad: Sequence[float]
) -> tuple[Drive, ...]:
    """A drive for every joint."""
    return tuple(
        _drive(number, joint, load, parts, rest)
        for number, (joint, load, rest) in enumerate(zip(joints, needed, rest_rad, strict=True), start=1)
    )


def _drive(number: int, joint: TreeJoint, load: JointLoad, parts: ChosenParts, rest_rad: float) -> Drive:
    gear_ratio = None if parts.gear_ratios is None else parts.gear_ratios[number - 1]
    kind = parts.boards[number - 1]
    with_gear = SERVOS.get(kind, ())
    gears = (1.0,) if with_gear else (gear_ratio,) if gear_ratio else GEARS
    highest_V = math.inf if kind == REFERENCE else KINDS[kind].highest_supply_V
    motors = with_gear or tuple(motor for motor in MOTORS if motor.supply_V <= highest_V)
    motor, gear = _chosen(joint, load, motors, gears)
    current_A = motor.current_A
    if math.isfinite(joint.torque_Nm) and joint.torque_Nm < motor.torque_Nm(gear):
        current_A = joint.torque_Nm / (motor.torque_constant_Nm_A * gear)
    speed = min(motor.speed_rad_s(gear), joint.speed_rad_s if math.isfinite(joint.speed_rad_s) else USUAL_SPEED_rad_s)
    acceleration = _acceleration(motor, gear, current_A, load, joint)
    lower, upper = range_of(joint, kind)
    zero_count = 0
    if with_gear:
        acceleration = min(acceleration, SERVO_ACCELERATION_rad_s2)
        speed = speed if math.isfinite(joint.speed_rad_s) else min(speed, SERVO_SPEED_rad_s)
        per_rad = KINDS[kind].counts_per_turn / (2.0 * math.pi)
        zero_count = round(0.5 * (KINDS[kind].counts_per_turn - (lower + upper) * per_rad))
    return Drive(
        joint=number,
        gear_ratio=gear,
        encoder_counts_per_rev=parts.counts_per_rev[number - 1],
        encoder_on="motor" if with_gear else parts.encoder_on,
        torque_constant_Nm_A=motor.torque_constant_Nm_A,
        resistance_ohm=motor.resistance_ohm,
        supply_V=motor.supply_V,
        inductance_H=motor.inductance_H,
        rotor_inertia_kg_m2=_rotor(motor, gear, joint),
        current_limit_A=current_A,
        joint_lower_rad=lower,
        joint_upper_rad=upper,
        joint_speed_limit_rad_s=_rounded(speed),
        joint_acceleration_limit_rad_s2=_rounded(acceleration),
        joint_jerk_limit_rad_s3=_rounded(JERK_PER_ACCELERATION_1_s * acceleration),
        zero_count=zero_count,
        servo=motor.name,
        home=_home(rest_rad, gear, (lower, upper), speed) if parts.has_home_switches else None,
    )


def _chosen(
    joint: TreeJoint, load: JointLoad, motors: Sequence[TypicalMotor], gears: Sequence[float]
) -> tuple[TypicalMotor, float]:
    """The smallest motor with a gear that gives torque and speed; else torque alone; else the strongest."""
    wanted_rad_s = joint.speed_rad_s if math.isfinite(joint.speed_rad_s) else 0.5 * USUAL_SPEED_rad_s
    choices = [(motor, gear) for motor in motors for gear in gears]
    strong = [(motor, gear) for motor, gear in choices if _is_strong(motor, gear, joint, load)]
    quick = [(motor, gear) for motor, gear in strong if motor.speed_rad_s(gear) >= wanted_rad_s]
    return (quick or strong or choices[-1:])[0]


def _is_strong(motor: TypicalMotor, gear: float, joint: TreeJoint, load: JointLoad) -> bool:
    """As strong as the file says, else it holds the arm with reserve and accelerates it; and its rotor fits the load."""
    torque, rotor = motor.torque_Nm(gear), gear**2 * _rotor(motor, gear, joint)
    if load.inertia_kg_m2 > MISMATCH * rotor > 0.0:
        return False
    if math.isfinite(joint.torque_Nm):
        return torque >= joint.torque_Nm
    spare = load.torque_Nm + WANTED_ACCELERATION_rad_s2 * (load.inertia_kg_m2 + rotor) / ACCELERATING
    return torque >= max(RESERVE * load.torque_Nm, spare)


def _rotor(motor: TypicalMotor, gear: float, joint: TreeJoint) -> float:
    """The file's own inertia at the joint, if it has one."""
    return joint.rotor_kg_m2 / gear**2 if joint.rotor_kg_m2 > 0.0 else motor.rotor_inertia_kg_m2


def _acceleration(motor: TypicalMotor, gear: float, current_A: float, load: JointLoad, joint: TreeJoint) -> float:
    torque = motor.torque_constant_Nm_A * current_A * gear
    inertia = load.inertia_kg_m2 + gear**2 * _rotor(motor, gear, joint)
    spare = ACCELERATING * max(torque - load.torque_Nm, 0.1 * torque)
    return min(MOST_ACCELERATION_rad_s2, spare / inertia) if inertia > 0.0 else MOST_ACCELERATION_rad_s2


def _home(rest_rad: float, gear: float, limits: tuple[float, float], speed: float) -> Home:
    """Beside the rest pose, so that homing moves little; the index half a motor turn further, both within the limits."""
    lower, upper = limits
    switch = _within(rest_rad - SWITCH_BEFORE_REST_rad, lower, upper)
    if switch + math.pi / gear > upper:  # a narrow range: the index then lies at its end
        switch = _within(upper - math.pi / gear, lower, upper)
    index = min(round(switch + math.pi / gear, 7), upper)
    return Home(switch, index, min(HOMING_SPEED_rad_s, _rounded(0.5 * speed)))


def _within(angle: float, lower: float, upper: float) -> float:
    """An angle of four digits, if one is within the limits; else the nearer limit."""
    clipped = min(max(angle, lower), upper)
    rounded = round(clipped, 4)
    return rounded if lower <= rounded <= upper else clipped


def _rounded(value: float) -> float:
    """To two digits, downwards: these are limits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.floor(value / step + 1e-9) * step:.2g}")


DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
ALONG_LIMIT_rad, ACROSS_LIMIT_rad = 2.6, 1.9  # cables; and a link that does not fold into the one before
LEAST_LINK_m = 0.07  # as which a shorter link weighs
RADIUS_m = 0.03  # of a link as a rod


def stretched_arm(shape: Shape) -> SerialArm:
    """Axes, estimated masses and the tip of an arm that stands upright."""
    heights = [0.0]
    for length in shape.lengths_m:
        heights.append(heights[-1] + length)
    joints, axes, masses = [], [], []
    for number, (letter, length) in enumerate(zip(shape.axes, shape.lengths_m, strict=True), start=1):
        axis = np.array(DIRECTIONS[letter])
        place = np.array([0.0, 0.0, heights[number - 1]])
        limit = ALONG_LIMIT_rad if letter == "z" else ACROSS_LIMIT_rad
        joints.append(TreeJoint(f"joint{number}", "revolute", "revolute", axis, np.zeros(3), -limit, limit))
        axes.append(Axis(place, axis))
        tube_kg = shape.tube_kg_m * max(length, LEAST_LINK_m)
        masses.append(_rod(place, length, tube_kg, shape.joint_kg if number < len(shape.axes) else 0.0))
    tip = np.eye(4)
    tip[2, 3] = heights[-1]
    return SerialArm(tuple(joints), ("",) * len(joints), tuple(axes), tuple(masses), tip, "base", "tip", (0.0, 0.0, -9.81), ())


def _rod(start_m: np.ndarray, length_m: float, tube_kg: float, end_kg: float) -> Mass:
    """A tube that carries the next joint at its end, in the base frame."""
    total_kg = tube_kg + end_kg
    com_m = (0.5 * tube_kg + end_kg) / total_kg * length_m
    across = tube_kg * (length_m**2 / 12 + (com_m - 0.5 * length_m) ** 2) + end_kg * (length_m - com_m) ** 2
    along = 0.5 * total_kg * RADIUS_m**2
    return Mass(total_kg, start_m + np.array([0.0, 0.0, com_m]), np.diag([across + 0.5 * along, across + 0.5 * along, along]))


def is_level(gravity_m_s2: tuple[float, float, float]) -> bool:
    """Whether gravity points along -z, so that a floor below the base is where it seems."""
    x, y, z = gravity_m_s2
    return z < 0.0 and math.hypot(x, y) < 1e-6 * -z
