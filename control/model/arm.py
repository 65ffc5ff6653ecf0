"""The contents of an arm.toml: one frozen dataclass per table.

`control.model.description` reads and writes it. The field names are the keys of the file; the annotations hold
the conditions on values (`control.model.rules`).
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import ArmError, MissingModel
from control.model.rules import (
    ANGLE,
    DIRECTION,
    ENCODER_BITS,
    FOLLOWING,
    LAG,
    LIMIT,
    NAME,
    NODE,
    NOT_NEGATIVE,
    ONE_OR_MORE,
    POSITIVE,
    ROTATE_BYTES,
    SHARE_ABOVE_1,
    SHARE_BELOW_1,
    STALE,
    TILT,
    WATCHDOG,
    ZERO_OR_MORE,
    Rule,
)

Convention = Literal["standard", "modified"]
Vector3 = tuple[float, float, float]
Direction = Annotated[int, DIRECTION]
NonNegative = Annotated[float, NOT_NEGATIVE]
Positive = Annotated[float, POSITIVE]
ENCODER_CHANNELS = 3  # an encoder board reads three encoders


@dataclass(frozen=True, slots=True)
class Link:
    """One row of the DH table, and the body that moves with its frame (no mass: unknown)."""

    joint: Literal["revolute", "fixed"]
    d_m: float
    theta_rad: Annotated[float, ANGLE]
    L_m: float
    alpha_rad: Annotated[float, ANGLE]
    mass_kg: NonNegative | None = None
    com_m: Vector3 | None = None
    inertia_kg_m2: tuple[NonNegative, NonNegative, NonNegative] | None = None
    radius_m: NonNegative = 0.0  # of its body about the line to its frame's origin; the tip is a point


@dataclass(frozen=True, slots=True)
class DrivePid:
    """A joint's position control; missing gains are derived from the model.

    In voltage and position mode kp is in V/rad, ki in V/(rad s), kd in V s/rad, all at the joint; in current
    mode the same with amperes.
    """

    mode: Literal["voltage", "current", "position"] = "voltage"
    kp: NonNegative | None = None
    ki: NonNegative | None = None
    kd: NonNegative | None = None
    derivative_filter_s: NonNegative | None = None


@dataclass(frozen=True, slots=True)
class Home:
    """How a joint homes: its switch, the index pulse after it, and the speed."""

    switch_rad: float
    index_rad: float
    speed_rad_s: Positive = 0.2
    backoff_rad: Positive = 0.05


@dataclass(frozen=True, slots=True)
class Drive:
    """A joint's motor, gear and encoder; a missing limit is infinite."""

    joint: Annotated[int, ONE_OR_MORE]
    gear_ratio: Positive
    encoder_counts_per_rev: Annotated[int, ONE_OR_MORE]
    torque_constant_Nm_A: Positive
    resistance_ohm: Positive
    supply_V: Positive
    encoder_bits: Annotated[int, ENCODER_BITS] = 32
    inductance_H: NonNegative = 0.0
    rotor_inertia_kg_m2: NonNegative = 0.0
    current_limit_A: Positive = math.inf
    joint_lower_rad: Annotated[float, LIMIT] = -math.inf
    joint_upper_rad: Annotated[float, LIMIT] = math.inf
    joint_speed_limit_rad_s: Positive = math.inf
    joint_acceleration_limit_rad_s2: Positive = math.inf
    joint_jerk_limit_rad_s3: Positive = math.inf
    encoder_board: Annotated[int, ZERO_OR_MORE] = -1  # by default the joints fill the boards in order
    encoder_channel: Annotated[int, ZERO_OR_MORE] = -1
    encoder_direction: Direction = 1
    motor_node: Annotated[int, NODE] = -1  # by default the joint's number
    motor_direction: Direction = 1
    motor_serial_number: Annotated[int, ZERO_OR_MORE] | None = None
    zero_count: int = 0
    board_holds: bool = True  # the motor board's own encoder is connected and counts up with positive voltage
    pid: DrivePid = DrivePid()
    home: Home | None = None

    def __post_init__(self) -> None:
        """Fill in the default wiring from the joint's number."""
        board, channel = divmod(self.joint - 1, ENCODER_CHANNELS)
        for name, default in (
            ("encoder_board", board),
            ("encoder_channel", channel),
            ("motor_node", self.joint),
        ):
            if getattr(self, name) < 0:
                object.__setattr__(self, name, default)


@dataclass(frozen=True, slots=True)
class Tool:
    """Position of the tip in the last frame, and whether it is known or to be identified."""

    position_m: Vector3 = (0.0, 0.0, 0.0)
    known: bool = True


@dataclass(frozen=True, slots=True)
class Table:
    """The calibration table; `control.model.table` computes its points."""

    origin_m: Vector3 | None = None
    circle_radius_m: Positive | None = None
    circle_points: Annotated[int, ZERO_OR_MORE] = 0
    line_points: Annotated[int, ZERO_OR_MORE] = 0
    line_pitch_m: Positive | None = None
    roll_tilt_rad: Annotated[float, TILT] = 0.0
    pitch_tilt_rad: Annotated[float, TILT] = 0.0
    known_pose: bool = True
    cavities_m: Mapping[str, Vector3] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Camera:
    """The camera that measures the tip."""

    position_noise_m: NonNegative = 0.0
    udp_port: Annotated[int, Rule("a UDP port from 1 to 65535", lambda n: 1 <= n <= 65535)] = (
        47_310  # docs/camera.md
    )


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect of the model; `control.model.effects` lists names and parameters."""

    effect: str
    joint: Annotated[int, ONE_OR_MORE] | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EncoderBoardPort:
    """The port of an encoder board; a given serial number is checked."""

    name: str
    port: str
    baud: Annotated[int, ONE_OR_MORE] = 1_000_000
    serial_number: Annotated[int, ZERO_OR_MORE] | None = None


@dataclass(frozen=True, slots=True)
class CanBus:
    """The bus of the motor boards, in python-can's terms; `options` are passed to the interface unchanged."""

    interface: str
    channel: str
    bitrate: Annotated[int, ONE_OR_MORE] = 1_000_000
    options: Mapping[str, str | int | float | bool] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Rest:
    """A pose in which the arm can wait: inside its limits, clear of the table, with little gravity torque."""

    q_rad: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that the loop enforces. A joint's following error may be `a + b |speed|`."""

    tip_speed_m_s: Positive = 1.0
    following_error_rad: Annotated[float, FOLLOWING] = 0.05
    following_error_per_speed_s: Annotated[float, LAG] = 0.05
    floor_z_m: float = 0.0  # the arm stays above this height in the base frame: on what the base stands
    floor_clearance_m: NonNegative = 0.0
    floor_tolerance_m: NonNegative = 0.01  # by which the model of an arm may be wrong before its calibration
    base_radius_m: NonNegative = 0.0  # of the arm's own base about axis 1, up to joint 2; 0: not checked
    watchdog_s: Annotated[float, WATCHDOG] = (
        0.2  # a host may pause 40-170 ms; a board watchdog must tolerate it
    )
    stale_s: Annotated[float, STALE] = 0.02
    jog_tip_speed_m_s: Positive = 0.25  # the reduced speed of ISO 10218-1 for people beside the arm
    payload_limit_kg: NonNegative = 5.0  # the largest mass that a client may state: feed-forward follows it
    jog_silence_s: Positive = 0.2  # a jog that is not renewed for this long comes to rest
    speed_contradiction_rad_s: Positive = 0.02  # between motor and encoder, at rest; see docs/safety.md
    unexplained_torque: Positive = 0.3  # share of the torque at the current limit; see there
    supply_low: Annotated[float, SHARE_BELOW_1] = 0.75  # of the drive's supply_V
    supply_high: Annotated[float, SHARE_ABOVE_1] = 1.4
    temperature_degC: Positive = 95.0  # of a power stage; boards trip by themselves at their own rating


@dataclass(frozen=True, slots=True)
class RecordingPolicy:
    """Size at which a recording continues in a new file, and the total size of this arm's recordings.

    keep_bytes: beyond it, the oldest finished recordings in the folder are removed; 0: none is ever removed.
    unrecorded: what becomes of motions while nothing is recorded (a full disk). "refuse": none begins, and one that runs makes a
    controlled stop; jogs and hand guiding are free, to get the arm away. "allow": all go on.
    """

    rotate_bytes: Annotated[int, ROTATE_BYTES] = 500_000_000
    keep_bytes: Annotated[int, ZERO_OR_MORE] = 0
    unrecorded: Literal["refuse", "allow"] = "refuse"


@dataclass(frozen=True, slots=True)
class Calibration:
    """Origin of a calibrated arm; `inputs` maps files to their SHA-256."""

    source: str = field(metadata={"key": "from"})
    inputs: Mapping[str, str]
    date: str
    objective: str
    program_version: str


@dataclass(frozen=True, slots=True)
class Arm:
    """An arm: geometry, masses, drives, boards and limits, read from the file `path`."""

    name: Annotated[str, NAME]
    links: tuple[Link, ...] = field(metadata={"key": "link"})
    gravity_m_s2: Vector3 = (0.0, 0.0, -9.81)
    dh_convention: Convention = "standard"
    drives: tuple[Drive, ...] = field(default=(), metadata={"key": "drive"})
    tool: Tool = Tool()
    table: Table | None = None
    camera: Camera | None = None
    effects: tuple[Effect, ...] = field(default=(), metadata={"key": "effect"})
    encoder_boards: tuple[EncoderBoardPort, ...] = field(default=(), metadata={"key": "encoder_board"})
    can: CanBus | None = None
    rest: Rest | None = None
    limits: Limits = Limits()
    recording: RecordingPolicy = RecordingPolicy()
    calibration: Calibration | None = None
    path: Path | None = field(default=None, compare=False, metadata={"key": ""})

    @property
    def joints(self) -> tuple[bool, ...]:
        """For every link, whether its joint is revolute (True) or fixed."""
        return tuple(link.joint == "revolute" for link in self.links)

    @property
    def joint_count(self) -> int:
        """The number of revolute joints, n."""
        return sum(self.joints)

    @property
    def dh(self) -> NDArray[np.float64]:
        """The DH table (links, 4): columns d [m], theta [rad], L [m], alpha [rad]; a read-only copy."""
        table = np.array([(k.d_m, k.theta_rad, k.L_m, k.alpha_rad) for k in self.links], dtype=np.float64)
        table.flags.writeable = False
        return table

    def with_dh(self, dh: ArrayLike) -> "Arm":
        """Return the same arm with another DH table (links, 4)."""
        table = np.asarray(dh, dtype=np.float64)
        if table.shape != (len(self.links), 4) or not np.isfinite(table).all():
            raise ArmError(
                f"arm {self.name}: expected a finite DH table ({len(self.links)}, 4), got {table.shape}"
            )
        links = tuple(
            dataclasses.replace(link, d_m=d, theta_rad=theta, L_m=length, alpha_rad=alpha)
            for link, (d, theta, length, alpha) in zip(self.links, table.tolist(), strict=True)
        )
        return dataclasses.replace(self, links=links)

    def drive(self, joint: int) -> Drive:
        """Return the drive of a joint (1-based); MissingModel if the file has none."""
        for drive in self.drives:
            if drive.joint == joint:
                return drive
        has = ", ".join(str(drive.joint) for drive in self.drives) or "none"
        raise MissingModel(
            f"arm {self.name}: joint {joint} has no [[drive]] (joints with a drive: {has}); add one"
        )

    @property
    def limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper limit of every joint [rad]; infinite if no drive gives one."""
        ranges = {drive.joint: (drive.joint_lower_rad, drive.joint_upper_rad) for drive in self.drives}
        return tuple(ranges.get(j, (-math.inf, math.inf)) for j in range(1, self.joint_count + 1))
