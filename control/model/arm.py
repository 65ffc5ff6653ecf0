"""The contents of an arm.toml: one frozen dataclass per table.

`control.model.description` reads and writes it. The field names are the keys of the file. An annotation holds the
conditions on a value (`control.model.rules`), then what the key says and, where the code's default says it badly, its default
in words; `control.model.reference` makes docs/arm_toml.md of all of them.
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
from control.model.board_kinds import KINDS, REFERENCE, BoardKind
from control.model.camera import Camera as Camera
from control.model.end_effector import NO_TOOL, Digital, Gripper
from control.model.end_effector import Tool as Tool
from control.model.end_effector import Vector3 as Vector3
from control.model.maps import CorrectionMap
from control.model.rules import (
    ANGLE,
    BACKOFF,
    BOARD_SIZE,
    CLEARANCE,
    DIRECTION,
    ENCODER_BITS,
    FOLLOWING,
    GRAVITY,
    HEIGHT,
    JOINT_SPEED,
    KIND,
    LAG,
    LENGTH,
    LIMIT,
    NAME,
    NODE,
    NOT_NEGATIVE,
    ONE_OR_MORE,
    PAYLOAD,
    POSITION,
    POSITIVE,
    ROTATE_BYTES,
    ROTOR,
    SHARE_ABOVE_1,
    SHARE_BELOW_1,
    STALE,
    TILT,
    TIP_SPEED,
    WATCHDOG,
    ZERO_OR_MORE,
)

Convention = Literal["standard", "modified"]
Position = Annotated[Vector3, POSITION]
Direction = Annotated[int, DIRECTION]
NonNegative = Annotated[float, NOT_NEGATIVE]
Positive = Annotated[float, POSITIVE]
ENCODER_CHANNELS = 3  # an encoder board reads three encoders


@dataclass(frozen=True, slots=True)
class Link:
    """One row of the DH table, and the body that moves with its frame (no mass: unknown)."""

    joint: Annotated[
        Literal["revolute", "fixed"], "what moves the row: a joint, numbered from the base, or nothing"
    ]
    d_m: Annotated[float, LENGTH, "offset along z"]
    theta_rad: Annotated[float, ANGLE, "angle about z; a joint's angle adds to it"]
    L_m: Annotated[float, LENGTH, "length along x"]
    alpha_rad: Annotated[float, ANGLE, "twist about x"]
    mass_kg: Annotated[NonNegative | None, "mass of all that moves with this frame"] = None
    com_m: Annotated[Position | None, "its centre, in this link's frame"] = None
    inertia_kg_m2: Annotated[
        tuple[NonNegative, NonNegative, NonNegative] | None,
        "moments about the centre of mass, about the axes of this link's frame",
    ] = None
    radius_m: Annotated[
        NonNegative,
        "of its body, for floor, table and own base; 0: a line. The tip is a point",
    ] = 0.0


@dataclass(frozen=True, slots=True)
class DrivePid:
    """A joint's position control; missing gains are derived from the model.

    In voltage and position mode kp is in V/rad, ki in V/(rad s), kd in V s/rad, all at the joint; in current
    mode the same with amperes.
    """

    mode: Annotated[
        Literal["voltage", "current", "position"],
        'what is sent to the motor board; "position": the PID runs on the board',
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
    speed_rad_s: Annotated[Positive, JOINT_SPEED, "towards the switch"] = 0.2
    backoff_rad: Annotated[Positive, BACKOFF, "how far it moves back off an active switch"] = 0.05


@dataclass(frozen=True, slots=True)
class Drive:
    """A joint's motor, gear and encoder; a missing limit is infinite."""

    joint: Annotated[int, ONE_OR_MORE, "which joint, counted from 1 at the base"]
    gear_ratio: Annotated[Positive, "motor turns per joint turn, belts included"]
    encoder_counts_per_rev: Annotated[int, ONE_OR_MORE, "per motor turn, after quadrature decoding"]
    torque_constant_Nm_A: Annotated[Positive, "of the motor; equals its back-EMF constant in V s/rad"]
    resistance_ohm: Annotated[Positive, "of the winding, from terminal to terminal"]
    supply_V: Annotated[Positive, "of the motor board"]
    encoder_bits: Annotated[int, ENCODER_BITS, "width of the counter"] = 32
    inductance_H: Annotated[NonNegative, "of the winding"] = 0.0
    rotor_inertia_kg_m2: Annotated[
        NonNegative, ROTOR, "of the rotor; counts gear_ratio^2 times at the joint"
    ] = 0.0
    current_limit_A: Annotated[Positive, "largest motor current"] = math.inf
    joint_lower_rad: Annotated[float, LIMIT, "lower end of the joint's range"] = -math.inf
    joint_upper_rad: Annotated[float, LIMIT, "upper end"] = math.inf
    joint_speed_limit_rad_s: Annotated[Positive, JOINT_SPEED, "of plans and set-points"] = math.inf
    joint_acceleration_limit_rad_s2: Annotated[Positive, "of plans and set-points"] = math.inf
    joint_jerk_limit_rad_s3: Annotated[Positive, "of plans"] = math.inf
    encoder_board: Annotated[
        int, ZERO_OR_MORE, "which [[encoder_board]], from 0", "joints fill the boards in order, three each"
    ] = -1
    encoder_channel: Annotated[int, ZERO_OR_MORE, "its channel, 0 to 2", "in order"] = -1
    encoder_direction: Annotated[
        Direction, "-1: counts down while the joint turns in its positive direction"
    ] = 1
    motor_node: Annotated[int, NODE, "CAN node of the motor board", "the joint's number"] = -1
    motor_direction: Annotated[Direction, "-1: a positive voltage turns the joint backwards"] = 1
    motor_serial_number: Annotated[
        Annotated[int, ZERO_OR_MORE] | None, "compared with the board's, if given"
    ] = None
    zero_count: Annotated[int, "the encoder's count at joint angle 0"] = 0
    board: Annotated[
        str, "name of the [[board]] that drives it; else a motor board of docs/motor_board.md"
    ] = ""
    board_channel: Annotated[int, ONE_OR_MORE, "which motor of that board, from 1"] = 1
    board_holds: Annotated[
        bool,
        "the motor board's own encoder counts up with positive voltage; false: without the loop the"
        " board brakes and cannot hold; `bringup` finds out",
    ] = True
    pid: Annotated[DrivePid, ""] = DrivePid()
    home: Annotated[Home | None, "absent: the joint cannot be homed; its zero is set on the board"] = None

    def __post_init__(self) -> None:
        """Fill in the default wiring from the joint's number; a drive with a `board` has none."""
        if self.board and self.encoder_board < 0:
            return
        board, channel = divmod(self.joint - 1, ENCODER_CHANNELS)
        for name, default in (
            ("encoder_board", board),
            ("encoder_channel", channel),
            ("motor_node", self.joint),
        ):
            if getattr(self, name) < 0:
                object.__setattr__(self, name, default)


@dataclass(frozen=True, slots=True)
class Table:
    """The calibration table (points: `control.model.table`)."""

    origin_m: Annotated[
        Position | None, "the board's centre in the base frame; required unless known_pose is false"
    ] = None
    circle_radius_m: Annotated[Positive | None, BOARD_SIZE, "of the circle of cavities"] = None
    circle_points: Annotated[int, ZERO_OR_MORE, "cavities on it, counter-clockwise from +x"] = 0
    line_points: Annotated[int, ZERO_OR_MORE, "cavities on the line along x"] = 0
    line_pitch_m: Annotated[Positive | None, BOARD_SIZE, "between two of them"] = None
    roll_tilt_rad: Annotated[float, TILT, "of the setup `roll`, about the board's x axis"] = 0.0
    pitch_tilt_rad: Annotated[float, TILT, "of the setup `pitch`, about its y axis"] = 0.0
    known_pose: Annotated[bool, "false: where the board stands is identified, per setup"] = True
    cavities_m: Annotated[
        Mapping[str, Position], "further cavities in the board's frame, `{ name = [x, y, z], ... }`"
    ] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect of the model; docs/formats.md#effects lists names and parameters."""

    effect: Annotated[str, "its name"]
    joint: Annotated[Annotated[int, ONE_OR_MORE] | None, "joint or link on which it acts"] = None
    parameters: Annotated[Mapping[str, float], "`{ name = value, ... }`"] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EncoderBoardPort:
    """The port of an encoder board, which reads three encoders."""

    name: Annotated[str, "in messages; each board's own"]
    port: Annotated[str, "a device or any pyserial URL"]
    baud: Annotated[int, ONE_OR_MORE, "of the port"] = 1_000_000
    serial_number: Annotated[Annotated[int, ZERO_OR_MORE] | None, "compared with the board's, if given"] = (
        None
    )


@dataclass(frozen=True, slots=True)
class CanBus:
    """The bus of the motor boards, in python-can's terms."""

    interface: Annotated[str, "socketcan, slcan, ..."]
    channel: Annotated[str, "can0, /dev/ttyACM1, ..."]
    bitrate: Annotated[int, ONE_OR_MORE, "of the bus, in bit/s"] = 1_000_000
    options: Annotated[Mapping[str, str | int | float | bool], "passed to the interface unchanged"] = field(
        default_factory=dict
    )


@dataclass(frozen=True, slots=True)
class Board:
    """A bought board that drives joints: a kind, and where it is. docs/boards.md has the kinds."""

    name: Annotated[str, NAME, "drives name it; each board's own"]
    kind: Annotated[str, KIND, "docs/boards.md"]
    address: Annotated[int, ZERO_OR_MORE, "on its line: an address, a node id or a servo's id"]
    port: Annotated[str, "on a serial line: a device or any pyserial URL; boards may share it"] = ""
    baud: Annotated[int, ONE_OR_MORE, "of that port"] = 115_200
    absolute: Annotated[
        bool,
        "its encoder knows the joint's angle at power-up, which its kind does not ensure: see the kind's page",
    ] = False


@dataclass(frozen=True, slots=True)
class Rest:
    """A pose in which the arm can wait: inside its limits, clear of the table, with little gravity torque."""

    q_rad: Annotated[tuple[Annotated[float, LIMIT], ...], "one angle per joint"]


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that the loop enforces (docs/safety.md)."""

    tip_speed_m_s: Annotated[Positive, TIP_SPEED, "of the tip, in plans"] = 1.0
    tip_turn_speed_rad_s: Annotated[Positive, JOINT_SPEED, "of the tip's orientation, in plans"] = 2.0
    tip_turn_acceleration_rad_s2: Annotated[Positive, "of the tip's orientation, in plans"] = 20.0
    following_error_rad: Annotated[float, FOLLOWING, "largest error of a joint at rest"] = 0.05
    following_error_per_speed_s: Annotated[
        float, LAG, "this much more with every rad/s of set-point speed"
    ] = 0.05
    floor_z_m: Annotated[float, HEIGHT, "height in the base frame that the arm stays above"] = 0.0
    floor_clearance_m: Annotated[NonNegative, CLEARANCE, "distance kept from the floor"] = 0.0
    floor_tolerance_m: Annotated[
        NonNegative, CLEARANCE, "by which the model may be wrong before calibration"
    ] = 0.01
    base_radius_m: Annotated[
        NonNegative, BOARD_SIZE, "of the arm's own base about axis 1, up to joint 2; 0: not checked"
    ] = 0.0
    watchdog_s: Annotated[
        float,
        WATCHDOG,
        "a board without commands for this long goes to FAULT; hosts pause for 40 to 170 ms",
    ] = 0.2
    stale_s: Annotated[float, STALE, "an older value is a fault"] = 0.02
    jog_tip_speed_m_s: Annotated[
        Positive, TIP_SPEED, "reduced speed for people beside the arm (ISO 10218-1)"
    ] = 0.25
    payload_limit_kg: Annotated[NonNegative, PAYLOAD, "largest mass that a client may state"] = 5.0
    jog_silence_s: Annotated[
        Positive, "a jog that is not renewed for this long comes to rest; at most 0.5"
    ] = 0.2
    speed_contradiction_rad_s: Annotated[
        Positive, JOINT_SPEED, "between motor and encoder, at rest (docs/safety.md)"
    ] = 0.02
    unexplained_torque: Annotated[Positive, "share of the torque at the current limit (docs/safety.md)"] = 0.3
    supply_low: Annotated[float, SHARE_BELOW_1, "of the drive's supply_V"] = 0.75
    supply_high: Annotated[float, SHARE_ABOVE_1, "of the drive's supply_V"] = 1.4
    temperature_degC: Annotated[Positive, "of a power stage; boards also trip at their own rating"] = 95.0


@dataclass(frozen=True, slots=True)
class RecordingPolicy:
    """Size of recordings, and what happens while the disk takes none."""

    rotate_bytes: Annotated[int, ROTATE_BYTES, "size at which a new file begins"] = 500_000_000
    keep_bytes: Annotated[
        int,
        ZERO_OR_MORE,
        "above this total the oldest recordings of this arm are removed; 0: none is ever removed; at least"
        " twice rotate_bytes",
    ] = 0
    unrecorded: Annotated[
        Literal["refuse", "allow"],
        'while the disk takes no rows: "refuse": no motion begins, one that runs is stopped, jogs and hand guiding are'
        ' free; "allow": motions go on',
    ] = "refuse"


@dataclass(frozen=True, slots=True)
class Calibration:
    """Origin of a calibrated arm, written by `calibrate` and `gap`."""

    source: Annotated[str, "the arm.toml it came from"] = field(metadata={"key": "from"})
    inputs: Annotated[Mapping[str, str], "file name to SHA-256"]
    date: Annotated[str, "when"]
    objective: Annotated[str, "what was minimised"]
    program_version: Annotated[str, "of armwright"]


@dataclass(frozen=True, slots=True)
class Arm:
    """An arm: geometry, masses, drives, boards and limits, read from the file `path`. `tool` is the one that is on."""

    name: Annotated[str, NAME, "sockets and recordings carry it"]
    links: Annotated[tuple[Link, ...], "base to tip"] = field(metadata={"key": "link"})
    gravity_m_s2: Annotated[Vector3, GRAVITY, "in the base frame"] = (0.0, 0.0, -9.81)
    dh_convention: Annotated[
        Convention,
        '"standard": Tz(d) Rz(theta) Tx(L) Rx(alpha); "modified": Rx(alpha) Tx(L) Rz(theta) Tz(d)',
    ] = "standard"
    drives: Annotated[tuple[Drive, ...], "one per joint"] = field(default=(), metadata={"key": "drive"})
    tool: Annotated[Tool, ""] = NO_TOOL
    table: Annotated[Table | None, ""] = None
    camera: Annotated[Camera | None, ""] = None
    gripper: Annotated[Gripper | None, ""] = None
    digital: Annotated[tuple[Digital, ...], "spare pins of the motor boards"] = ()
    effects: Annotated[tuple[Effect, ...], ""] = field(default=(), metadata={"key": "effect"})
    maps: Annotated[tuple[CorrectionMap, ...], "what `gap --map` measured beyond every effect"] = field(
        default=(), metadata={"key": "map"}
    )
    encoder_boards: Annotated[tuple[EncoderBoardPort, ...], "three channels each"] = field(
        default=(), metadata={"key": "encoder_board"}
    )
    boards: Annotated[tuple[Board, ...], "bought boards that drive joints"] = field(
        default=(), metadata={"key": "board"}
    )
    can: Annotated[CanBus | None, ""] = None
    rest: Annotated[Rest | None, ""] = None
    limits: Annotated[Limits, ""] = Limits()
    recording: Annotated[RecordingPolicy, ""] = RecordingPolicy()
    calibration: Annotated[Calibration | None, ""] = None
    spare_tools: tuple[Tool, ...] = field(default=(), metadata={"key": ""})  # the other [[tool]]s of the file
    path: Path | None = field(default=None, compare=False, metadata={"key": ""})

    @property
    def tools(self) -> tuple[Tool, ...]:
        """All tools; the first is on."""
        return (self.tool, *self.spare_tools)

    def with_tool(self, name: str) -> "Arm":
        """Return the same arm with another of its tools on. ArmError lists the tools if there is none of this name."""
        if name == self.tool.name:
            return self
        named = {tool.name: tool for tool in self.spare_tools}
        if name not in named:
            known = ", ".join(tool.name for tool in self.tools if tool.name)
            raise ArmError(
                f"arm {self.name}: no tool {name!r}: expected one of {known}"
                if known
                else f"arm {self.name}: no tool {name!r}: its file names none; add a [[tool]] for each, with a name"
            )
        others = tuple(tool for tool in self.tools if tool.name != name)
        return dataclasses.replace(self, tool=named[name], spare_tools=others)

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

    def board(self, drive: Drive) -> Board | None:
        """Return the [[board]] of a drive, None if it is on a reference motor board."""
        return next((board for board in self.boards if board.name == drive.board), None)

    def kind_of(self, drive: Drive) -> BoardKind:
        """Return what the board of a drive offers."""
        board = self.board(drive)
        return REFERENCE if board is None else KINDS[board.kind]

    @property
    def motors(self) -> tuple[Drive, ...]:
        """The drives of the joints, and of a gripper on a [[board]] as of one joint more, whose angle is its motor's."""
        gripper = self.gripper
        if gripper is None or not gripper.board:
            return self.drives
        own = Drive(
            joint=self.joint_count + 1, gear_ratio=1.0, encoder_counts_per_rev=max(gripper.encoder_counts_per_rev, 1),
            torque_constant_Nm_A=gripper.torque_constant_Nm_A, resistance_ohm=gripper.resistance_ohm, supply_V=gripper.supply_V,
            rotor_inertia_kg_m2=gripper.rotor_inertia_kg_m2, current_limit_A=gripper.current_limit_A,
            encoder_direction=gripper.motor_direction, motor_direction=gripper.motor_direction, board=gripper.board,
            board_channel=gripper.board_channel,
        )  # fmt: skip
        return (*self.drives, own)

    def has_absolute_encoder(self, drive: Drive) -> bool:
        """Return whether a drive's encoder knows the joint's angle at power-up."""
        board = self.board(drive)
        is_absolute = self.kind_of(drive).is_absolute or (board is not None and board.absolute)
        return drive.encoder_board < 0 and is_absolute

    @property
    def can_home(self) -> bool:
        """Whether every joint can find its zero: by [drive.home], or an absolute encoder."""
        return all(drive.home is not None or self.has_absolute_encoder(drive) for drive in self.drives)

    @property
    def usual_rate_Hz(self) -> float:
        """The loop's rate if none is asked for: what the slowest kind of board carries."""
        return min(
            (self.kind_of(drive).usual_rate_Hz for drive in self.motors), default=REFERENCE.usual_rate_Hz
        )

    @property
    def limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper limit of every joint [rad]; infinite if no drive gives one."""
        ranges = {drive.joint: (drive.joint_lower_rad, drive.joint_upper_rad) for drive in self.drives}
        return tuple(ranges.get(j, (-math.inf, math.inf)) for j in range(1, self.joint_count + 1))
