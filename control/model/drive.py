"""The joints' tables of an arm.toml: motor, gear and encoder, position control, homing (see `control.model.arm`); and the
conversion between counts of an encoder and radians of its joint, with counter unwrapping.

A smart servo's data sheet is what `servo = "..."` of a [[drive]] or [gripper] stands for. A key that stands in the file beside it
counts instead: a servo that was measured, or one on another supply.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal

from control.errors import BadTarget
from control.model import rules
from control.model.board_kinds import KINDS
from control.model.reader import Rejected, show

Direction = Annotated[int, rules.DIRECTION]
NonNegative = Annotated[float, rules.NOT_NEGATIVE]
Positive = Annotated[float, rules.POSITIVE]
ENCODER_CHANNELS = 3  # an encoder board reads three encoders


@dataclass(frozen=True, slots=True)
class DrivePid:
    """A joint's position control; missing gains are derived from the model.

    In voltage and position mode kp is in V/rad, ki in V/(rad s), kd in V s/rad, all at the joint; in current
    mode the same with amperes.
    """

    mode: Annotated[
        Literal["voltage", "current", "position"], 'sent to the motor board; "position": the PID runs on the board'
    ] = "voltage"
    kp: Annotated[NonNegative | None, "V/rad or A/rad", "from the model"] = None
    ki: Annotated[NonNegative | None, "V/(rad s) or A/(rad s)", "from the model"] = None
    kd: Annotated[NonNegative | None, "V s/rad or A s/rad", "from the model"] = None
    derivative_filter_s: Annotated[NonNegative | None, "time constant of the speed's filter", "0.001"] = None


@dataclass(frozen=True, slots=True)
class Home:
    """How a joint homes: its switch, the index pulse after it, and the speed.

    The switch is active on the side of `index_rad`; homing moves from `switch_rad` towards `index_rad`.
    """

    switch_rad: Annotated[float, "where the home switch changes"]
    index_rad: Annotated[float, "the index pulse after it, best half a motor turn further"]
    speed_rad_s: Annotated[Positive, rules.JOINT_SPEED, "towards the switch"] = 0.2
    backoff_rad: Annotated[Positive, rules.BACKOFF, "back off an active switch"] = 0.05
    switch: Annotated[
        Literal["own", "lower", "upper"], "the joint's home switch, or one of its limit switches, which takes its place"
    ] = "own"

    @property
    def sense(self) -> float:
        """The direction in which homing seeks the switch: that of its end, or from switch to index, or upwards."""
        if self.switch != "own":
            return -1.0 if self.switch == "lower" else 1.0
        return 1.0 if self.index_rad >= self.switch_rad else -1.0


OWN_INPUT: Final = "drive"


@dataclass(frozen=True, slots=True)
class LimitSwitches:
    """Switches at the ends of a joint's range: nothing moves further towards one that is active.

    They are inputs of motor boards, [[digital]]. Wire a contact that opens, so that a broken wire is an active switch.
    Some drives have inputs of their own for them, and say which end is meant: OWN_INPUT.
    """

    lower: Annotated[str, 'name of the [[digital]] of the one at the lower end, or "drive": its own input'] = ""
    upper: Annotated[str, "and at the upper end"] = ""
    lower_rad: Annotated[float | None, rules.LIMIT, "where it changes", "a little beyond the range"] = None
    upper_rad: Annotated[float | None, rules.LIMIT, "where it changes", "a little beyond the range"] = None
    active: Annotated[Literal["high", "low"], "the level of an active one"] = "high"


@dataclass(frozen=True, slots=True)
class Drive:
    """A joint's motor, gear and encoder; a missing limit is infinite."""

    joint: Annotated[int, rules.ONE_OR_MORE, "from 1 at the base"]
    gear_ratio: Annotated[Positive, "motor turns per joint turn, belts included"]
    encoder_counts_per_rev: Annotated[int, rules.ONE_OR_MORE, "per turn of the encoder, after quadrature decoding"]
    torque_constant_Nm_A: Annotated[Positive, "of the motor; equals its back-EMF constant in V s/rad"]
    resistance_ohm: Annotated[Positive, "of the winding, between terminals"]
    supply_V: Annotated[Positive, "of the motor board"]
    encoder_on: Annotated[
        Literal["motor", "joint"],
        "the side of gear and belts on which the encoder is: play and springs are behind it, or before it",
    ] = "motor"
    encoder_ratio: Annotated[Positive, "turns of the encoder per turn of that motor or joint"] = 1.0
    motor_counts_per_rev: Annotated[
        Annotated[int, rules.ONE_OR_MORE] | None,
        'per motor turn, of a second encoder that the motor board reads: with encoder_on = "joint"',
    ] = None
    encoder_bits: Annotated[int, rules.ENCODER_BITS, "width of the counter"] = 32
    inductance_H: Annotated[NonNegative, "of the winding"] = 0.0
    rotor_inertia_kg_m2: Annotated[NonNegative, "of the rotor; counts gear_ratio^2 times at the joint"] = 0.0
    current_limit_A: Annotated[Positive, "of the motor"] = math.inf
    joint_lower_rad: Annotated[float, rules.LIMIT, "lower end of the joint's range"] = -math.inf
    joint_upper_rad: Annotated[float, rules.LIMIT, "upper end"] = math.inf
    joint_speed_limit_rad_s: Annotated[Positive, "of plans and set-points"] = math.inf
    joint_acceleration_limit_rad_s2: Annotated[Positive, "of plans and set-points"] = math.inf
    joint_jerk_limit_rad_s3: Annotated[Positive, "of plans"] = math.inf
    encoder_board: Annotated[
        int, rules.ZERO_OR_MORE, "which [[encoder_board]], from 0", "joints fill the boards in order, three each"
    ] = -1
    encoder_channel: Annotated[int, rules.ZERO_OR_MORE, "its channel, 0 to 2", "in order"] = -1
    encoder_direction: Annotated[Direction, "-1: counts down while the joint turns in its positive direction"] = 1
    motor_node: Annotated[int, rules.NODE, "CAN node of the motor board", "the joint's number"] = -1
    motor_direction: Annotated[Direction, "-1: a positive voltage turns the joint backwards"] = 1
    motor_serial_number: Annotated[Annotated[int, rules.ZERO_OR_MORE] | None, "compared with the board's, if given"] = None
    zero_count: Annotated[int, "the encoder's count at joint angle 0"] = 0
    board: Annotated[str, "name of the [[board]] that drives it; else a motor board of docs/motor_board.md"] = ""
    board_channel: Annotated[int, rules.ONE_OR_MORE, "which motor of that board, from 1"] = 1
    servo: Annotated[str, "a smart servo of docs/arms.md: default of gear_ratio to supply_V and current_limit_A"] = ""
    servos: Annotated[
        int, rules.ONE_OR_MORE, "that turn the joint together: a shadow has the board's address as its secondary id"
    ] = 1
    board_holds: Annotated[
        bool,
        "the motor board's own encoder counts up with positive voltage; false: without the loop the"
        " board brakes and cannot hold; `bringup` finds out",
    ] = True
    pid: Annotated[DrivePid, ""] = DrivePid()
    limit_switches: Annotated[LimitSwitches | None, "absent: the joint has none"] = None
    home: Annotated[Home | None, "absent: the joint cannot be homed; its zero is set on the board"] = None

    def __post_init__(self) -> None:
        """Fill in the default wiring from the joint's number; a drive with a `board` has none."""
        if self.board and self.encoder_board < 0:
            return
        board, channel = divmod(self.joint - 1, ENCODER_CHANNELS)
        for name, default in (("encoder_board", board), ("encoder_channel", channel), ("motor_node", self.joint)):
            if getattr(self, name) < 0:
                object.__setattr__(self, name, default)

    @property
    def encoder_turns(self) -> float:
        """Turns of the encoder per turn of the joint."""
        return (self.gear_ratio if self.encoder_on == "motor" else 1.0) * self.encoder_ratio

    @property
    def counts_per_joint_turn(self) -> float:
        """Counts of the encoder per turn of the joint, without sign."""
        return self.encoder_counts_per_rev * self.encoder_turns

    @property
    def encoder_turn_rad(self) -> float:
        """The joint's angle in one turn of the encoder: from one index pulse to the next."""
        return 2.0 * math.pi / self.encoder_turns

    @property
    def torque_limit_Nm(self) -> float:
        """At the joint: at the current limit, or stalled at the full supply if that is less."""
        return min(self.current_limit_A, self.supply_V / self.resistance_ohm) * self.torque_constant_Nm_A * self.gear_ratio

    @property
    def lag_s(self) -> float:
        """L/R of the winding: the time in which its current comes to 63 % of what a new voltage drives."""
        return self.inductance_H / self.resistance_ohm

    @property
    def at_motor(self) -> "Drive":
        """The drive by the encoder that its motor board reads, which counts up with the motor's angle at the joint's sign."""
        if self.motor_counts_per_rev is None:
            return self
        return replace(
            self,
            encoder_counts_per_rev=self.motor_counts_per_rev,
            encoder_on="motor",
            encoder_ratio=1.0,
            encoder_bits=32,
            encoder_direction=1,
            zero_count=0,
            motor_counts_per_rev=None,
        )


class JointMap:
    """Counts to joint angle and back: ratio, counts per turn, direction, and the count at zero.

    `angle = direction (count - zero_count) 2 pi / (counts_per_rev turns)`; counts are unwrapped ones, `turns` those of the
    encoder per turn of the joint: `gear_ratio` of one on the motor, 1 of one on the joint.
    """

    __slots__ = ("counts_per_radian", "radians_per_count", "zero_count")

    def __init__(self, drive: Drive) -> None:
        counts_per_turn = drive.counts_per_joint_turn * drive.encoder_direction
        self.counts_per_radian = counts_per_turn / (2.0 * math.pi)  # signed by the encoder's direction
        self.radians_per_count = (2.0 * math.pi) / counts_per_turn
        self.zero_count = drive.zero_count

    def radians(self, count: float) -> float:
        """Return the joint angle at an unwrapped count."""
        return (count - self.zero_count) * self.radians_per_count

    def count(self, q_rad: float) -> int:
        """Return the nearest unwrapped count of a joint angle."""
        try:
            return round(q_rad * self.counts_per_radian) + self.zero_count
        except (ValueError, OverflowError):
            raise BadTarget(f"joint angle: expected a finite number, got {q_rad}") from None


class Unwrapper:
    """Unwraps a counter of `bits` bits; steps must be below half of its range.

    The first count is the reference: `start` unwraps to itself.
    """

    __slots__ = ("_half", "_mask", "unwrapped_count")

    def __init__(self, bits: int, start: int) -> None:
        self._mask = (1 << bits) - 1
        self._half = 1 << (bits - 1)
        self.unwrapped_count = start

    def update(self, raw_count: int) -> int:
        """Return the unwrapped count of the latest raw one, signed or unsigned."""
        step = (raw_count - self.unwrapped_count + self._half & self._mask) - self._half
        self.unwrapped_count += step
        return self.unwrapped_count


RPM: Final = 2.0 * math.pi / 60.0


KG_CM: Final = 0.0980665  # N m


HORN_TEETH: Final = 25  # of an STS3215


DRIVE_KEYS: Final = (
    "gear_ratio",
    "encoder_counts_per_rev",
    "torque_constant_Nm_A",
    "resistance_ohm",
    "supply_V",
    "current_limit_A",
)


GRIPPER_KEYS: Final = ("encoder_counts_per_rev", "torque_constant_Nm_A", "resistance_ohm", "supply_V")


@dataclass(frozen=True, slots=True)
class ServoType:
    """A servo at its output, whose gear is inside: stalled and without load, at its nominal supply; a speed of 0 is not known."""

    kind: str
    supply_V: float
    stall_Nm: float
    stall_A: float
    free_rad_s: float
    horn_teeth: int = 0  # places in which the horn fits its shaft, where it can be put on wrongly

    @property
    def torque_constant_Nm_A(self) -> float:
        """At the output, less what its gear loses when stalled."""
        return self.stall_Nm / self.stall_A

    @property
    def resistance_ohm(self) -> float:
        """Of the winding: a stalled motor has no other voltage."""
        return self.supply_V / self.stall_A

    def values(self, servos: int = 1) -> dict[str, float | int]:
        """What it gives a drive that so many of them turn together: one motor of their summed current."""
        return {
            "gear_ratio": 1.0,
            "encoder_counts_per_rev": KINDS[self.kind].counts_per_turn,
            "torque_constant_Nm_A": self.torque_constant_Nm_A,
            "resistance_ohm": self.resistance_ohm / servos,
            "supply_V": self.supply_V,
            "current_limit_A": self.stall_A * servos,
        }


SERVOS: Final[Mapping[str, ServoType]] = MappingProxyType(
    {
        # ROBOTIS e-Manual: stall torque and current, speed without load, at the recommended voltage
        "XL330-M288": ServoType("dynamixel", 5.0, 0.52, 1.47, 103.0 * RPM),
        "XL430-W250": ServoType("dynamixel", 12.0, 1.5, 1.4, 61.0 * RPM),
        "XM430-W350": ServoType("dynamixel", 12.0, 4.1, 2.3, 46.0 * RPM),
        "XM540-W270": ServoType("dynamixel", 12.0, 10.6, 4.4, 30.0 * RPM),
        # Feetech's data sheet of the ST-3215-C018, gear 1:345: 30 kg cm, 2.7 A, 0.222 s for 60 deg
        "STS3215-12V": ServoType("feetech", 12.0, 30.0 * KG_CM, 2.7, 45.0 * RPM, HORN_TEETH),
        # C001, the same gear: 19.5 kg cm by those who sell it. The current is reckoned: a motor of the same size loses as much
        # heat for the square of its torque, however it is wound
        "STS3215-7.4V": ServoType("feetech", 7.4, 19.5 * KG_CM, 12.0 * 2.7 / 7.4 * (19.5 / 30.0) ** 2, 0.0, HORN_TEETH),
    }
)


def with_servo_values(document: dict[str, Any]) -> dict[str, Any]:
    """A parsed arm.toml with what its servos' data sheets say where it says nothing. Rejected: no such servo."""

    def filled(table: Any, path: tuple[str | int, ...], keys: tuple[str, ...]) -> Any:
        return _sheet(table, path, keys) | table if _names_servo(table) else table

    return _each(document, filled)


def without_servo_values(document: dict[str, Any]) -> dict[str, Any]:
    """The opposite, for a file that is written: what the data sheet says is left out."""

    def emptied(table: Any, path: tuple[str | int, ...], keys: tuple[str, ...]) -> Any:
        said = _sheet(table, path, keys) if _names_servo(table) else {}
        return {key: value for key, value in table.items() if said.get(key) != value}

    return _each(document, emptied)


def _each(document: dict[str, Any], changed: Callable[[Any, tuple[str | int, ...], tuple[str, ...]], Any]) -> dict[str, Any]:
    """The document with what may name a servo changed; what is no table is left to the reader to refuse."""
    others = dict(document)
    if isinstance(drives := document.get("drive"), list):
        others["drive"] = [changed(drive, ("drive", i), DRIVE_KEYS) for i, drive in enumerate(drives)]
    if "gripper" in document:
        others["gripper"] = changed(document["gripper"], ("gripper",), GRIPPER_KEYS)
    return others


def _names_servo(table: Any) -> bool:
    return isinstance(table, dict) and table.get("servo", "") != ""


def _sheet(table: dict[str, Any], path: tuple[str | int, ...], keys: tuple[str, ...]) -> dict[str, float | int]:
    named, servos = table["servo"], table.get("servos", 1)
    if not isinstance(named, str) or named not in SERVOS:
        raise Rejected((*path, "servo"), " or ".join(f'"{name}"' for name in SERVOS), show(named))
    values = SERVOS[named].values(servos if type(servos) is int and servos > 0 else 1)
    return {key: values[key] for key in keys}
