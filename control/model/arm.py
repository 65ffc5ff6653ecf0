"""The contents of an arm.toml: one frozen dataclass per table.

`control.model.description` reads and writes it. The field names are the keys of the file. An annotation holds the
conditions on a value (`control.model.rules`), then what the key says and, where the code's default says it badly, its default
in words; `control.model.reference` prints all of them.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from control.errors import ArmError, MissingModel
from control.model import rules
from control.model.board_kinds import KINDS, REFERENCE, BoardKind
from control.model.can_bus import CanBus as CanBus
from control.model.can_bus import usual_rate_Hz
from control.model.drive import ENCODER_CHANNELS as ENCODER_CHANNELS
from control.model.drive import Drive as Drive
from control.model.drive import DrivePid as DrivePid
from control.model.drive import Home as Home
from control.model.drive import LimitSwitches as LimitSwitches
from control.model.drive import NonNegative, Positive
from control.model.effects import EFFECTS, moved_joint
from control.model.end_effector import NO_TOOL, Digital, Gripper
from control.model.end_effector import Camera as Camera
from control.model.end_effector import Tool as Tool
from control.model.end_effector import Vector3 as Vector3
from control.model.maps import CorrectionMap
from control.model.tolerances import ArmTolerances

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits that the loop enforces (docs/safety.md)."""

    tip_speed_m_s: Annotated[Positive, rules.TIP_SPEED, "of the tip, in plans"] = 1.0
    tip_turn_speed_rad_s: Annotated[Positive, rules.JOINT_SPEED, "of the tip's orientation, in plans"] = 2.0
    tip_turn_acceleration_rad_s2: Annotated[Positive, "of the tip's orientation, in plans"] = 20.0
    following_error_rad: Annotated[float, rules.FOLLOWING, "largest error of a joint at rest"] = 0.05
    following_error_per_speed_s: Annotated[
        float, rules.LAG, "this much more with every rad/s of set-point speed; dies away in this time"
    ] = 0.05
    floor_z_m: Annotated[float, rules.HEIGHT, "height in the base frame that the arm stays above"] = 0.0
    floor_clearance_m: Annotated[NonNegative, rules.CLEARANCE, "distance kept from the floor"] = 0.0
    floor_tolerance_m: Annotated[NonNegative, rules.CLEARANCE, "error of the model before calibration"] = 0.01
    base_radius_m: Annotated[
        NonNegative, rules.BOARD_SIZE, "of the arm's own base about axis 1, up to joint 2; 0: not checked"
    ] = 0.0
    watchdog_s: Annotated[
        float, rules.WATCHDOG, "a board without commands for this long goes to FAULT; hosts pause for 40 to 170 ms"
    ] = 0.2
    stale_s: Annotated[float, rules.STALE, "an older value is a fault"] = 0.02
    jog_tip_speed_m_s: Annotated[Positive, rules.TIP_SPEED, "reduced speed for people beside the arm (ISO 10218-1)"] = 0.25
    payload_limit_kg: Annotated[NonNegative, rules.PAYLOAD, "largest that a client may state"] = 5.0
    jog_silence_s: Annotated[Positive, "a jog that is not renewed for this long comes to rest; at most 0.5"] = 0.2
    speed_contradiction_rad_s: Annotated[Positive, rules.JOINT_SPEED, "between motor and encoder, at rest (docs/safety.md)"] = (
        0.02
    )
    transmission_slack_rad: Annotated[
        NonNegative, "play and springs between motor and joint: by so much they may differ, where an encoder is on the joint"
    ] = 0.05
    unexplained_torque: Annotated[Positive, "share of the torque at the current limit (docs/safety.md)"] = 0.3
    supply_low: Annotated[float, rules.SHARE_BELOW_1, "of the drive's supply_V"] = 0.75
    supply_high: Annotated[float, rules.SHARE_ABOVE_1, "of the drive's supply_V"] = 1.4
    temperature_degC: Annotated[Positive, "of a power stage; boards also trip at their own rating"] = 95.0


@dataclass(frozen=True, slots=True)
class RecordingPolicy:
    """Size of recordings, and what happens while the disk takes none."""

    rotate_bytes: Annotated[int, rules.ROTATE_BYTES, "size at which a new file begins"] = 500_000_000
    keep_bytes: Annotated[
        int,
        rules.ZERO_OR_MORE,
        "above this total the oldest recordings of this arm are removed; 0: none is ever removed; at least twice rotate_bytes",
    ] = 0
    unrecorded: Annotated[
        Literal["refuse", "allow"],
        'while the disk takes no rows: "refuse": no motion begins, one that runs is stopped, jogs and hand guiding are'
        ' free; "allow": motions go on',
    ] = "refuse"


USUAL_LIMITS, USUAL_RECORDING = Limits(), RecordingPolicy()


Convention = Literal["standard", "modified"]
Position = Annotated[Vector3, rules.POSITION]


@dataclass(frozen=True, slots=True)
class Link:
    """One row of the DH table, and the body that moves with its frame (no mass: unknown)."""

    joint: Annotated[Literal["revolute", "fixed"], "what moves the row: a joint, numbered from the base, or nothing"]
    d_m: Annotated[float, rules.LENGTH, "offset along z"]
    theta_rad: Annotated[float, rules.ANGLE, "angle about z; a joint's angle adds to it"]
    L_m: Annotated[float, rules.LENGTH, "length along x"]
    alpha_rad: Annotated[float, rules.ANGLE, "twist about x"]
    mass_kg: Annotated[NonNegative | None, "mass of all that moves with this frame"] = None
    com_m: Annotated[Position | None, "its centre, in this link's frame"] = None
    inertia_kg_m2: Annotated[
        tuple[NonNegative, NonNegative, NonNegative] | None,
        "moments about the centre of mass, along the axes of this link's frame",
    ] = None
    radius_m: Annotated[NonNegative, "of its body, for floor, table and own base; 0: a line. The tip is a point"] = 0.0
    joint_name: Annotated[str, rules.PART_NAME, "in messages and exported models", '"joint N"'] = ""
    link_name: Annotated[str, rules.PART_NAME, "of its body in exported models; of a fixed first or last row, base or tip"] = ""


@dataclass(frozen=True, slots=True)
class Table:
    """The calibration table (points: `control.model.table`)."""

    origin_m: Annotated[Position | None, "the board's centre in the base frame; required unless known_pose is false"] = None
    circle_radius_m: Annotated[Positive | None, rules.BOARD_SIZE, "of the circle of cavities"] = None
    circle_points: Annotated[int, rules.ZERO_OR_MORE, "cavities on it, counter-clockwise from +x"] = 0
    line_points: Annotated[int, rules.ZERO_OR_MORE, "cavities on the line along x"] = 0
    line_pitch_m: Annotated[Positive | None, rules.BOARD_SIZE, "between two of them"] = None
    roll_tilt_rad: Annotated[float, rules.TILT, "of the setup `roll`, about the board's x axis"] = 0.0
    pitch_tilt_rad: Annotated[float, rules.TILT, "of the setup `pitch`, about its y axis"] = 0.0
    known_pose: Annotated[bool, "false: where the board stands is identified, per setup"] = True
    cavities_m: Annotated[Mapping[str, Position], "further cavities in the board's frame, `{ name = [x, y, z], ... }`"] = field(
        default_factory=dict
    )


@dataclass(frozen=True, slots=True)
class Effect:
    """An effect of the model; docs/formats.md#effects lists names and parameters."""

    effect: Annotated[str, "its name"]
    joint: Annotated[Annotated[int, rules.ONE_OR_MORE] | None, "joint or link on which it acts"] = None
    parameters: Annotated[Mapping[str, float], "`{ name = value, ... }`"] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class EncoderBoardPort:
    """The port of an encoder board, which reads three encoders."""

    name: Annotated[str, "in messages; each board's own"]
    port: Annotated[str, "a device or any pyserial URL"]
    baud: Annotated[int, rules.ONE_OR_MORE, "of the port"] = 1_000_000
    serial_number: Annotated[Annotated[int, rules.ZERO_OR_MORE] | None, "compared with the board's, if given"] = None


@dataclass(frozen=True, slots=True)
class Board:
    """A bought board that drives joints: a kind, and where it is. docs/boards.md has the kinds."""

    name: Annotated[str, rules.NAME, "drives name it; each board's own"]
    kind: Annotated[str, rules.KIND, "docs/boards.md"]
    address: Annotated[int, rules.ZERO_OR_MORE, "on its line: an address, a node id or a servo's id"]
    port: Annotated[str, "on a serial line: a device or any pyserial URL; boards may share it"] = ""
    baud: Annotated[int, rules.ONE_OR_MORE, "of that port"] = 115_200
    absolute: Annotated[
        bool, "its encoder knows the joint's angle at power-up, which its kind does not ensure: see the kind's page"
    ] = False
    absolute_turns: Annotated[
        Positive | None,
        "turns of `encoder_counts_per_rev` after which an absolute encoder says the same again",
        "one turn of the joint",
    ] = None


@dataclass(frozen=True, slots=True)
class Rest:
    """A pose in which the arm can wait: inside its limits, clear of the table, with little gravity torque."""

    q_rad: Annotated[tuple[Annotated[float, rules.LIMIT], ...], "one angle per joint"]


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

    name: Annotated[str, rules.NAME, "sockets and recordings carry it"]
    links: Annotated[tuple[Link, ...], "base to tip"] = field(metadata={"key": "link"})
    gravity_m_s2: Annotated[Vector3, rules.GRAVITY, "in the base frame"] = (0.0, 0.0, -9.81)
    as_given: Annotated[bool, "overrides guesses about units that refuse the file"] = False
    placeholders: Annotated[
        tuple[Literal["masses", "motors"], ...],
        "chosen by `armwright new`, not measured; take a word out when its values are those of your parts",
    ] = ()
    dh_convention: Annotated[
        Convention, '"standard": Tz(d) Rz(theta) Tx(L) Rx(alpha); "modified": Rx(alpha) Tx(L) Rz(theta) Tz(d)'
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
    boards: Annotated[tuple[Board, ...], "bought boards that drive joints"] = field(default=(), metadata={"key": "board"})
    can: Annotated[CanBus | None, ""] = None
    rest: Annotated[Rest | None, ""] = None
    limits: Annotated[Limits, ""] = USUAL_LIMITS
    recording: Annotated[RecordingPolicy, ""] = USUAL_RECORDING
    tolerances: Annotated[ArmTolerances | None, ""] = None
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
    def joint_names(self) -> tuple[str, ...]:
        """What the joints are called: as the file says, else `joint 1` and so on."""
        turning = [link for link in self.links if link.joint == "revolute"]
        return tuple(link.joint_name or f"joint {number}" for number, link in enumerate(turning, 1))

    @property
    def dh(self) -> "NDArray[np.float64]":
        """The DH table (links, 4): columns d [m], theta [rad], L [m], alpha [rad]; a read-only copy."""
        import numpy as np  # a tenth of a second, which no command that only asks the runtime needs

        table = np.array([(k.d_m, k.theta_rad, k.L_m, k.alpha_rad) for k in self.links], dtype=np.float64)
        table.flags.writeable = False
        return table

    def with_dh(self, dh: "ArrayLike") -> "Arm":
        """Return the same arm with another DH table (links, 4); its parts were made to the one that it had first."""
        import numpy as np

        table = np.asarray(dh, dtype=np.float64)
        if table.shape != (len(self.links), 4) or not np.isfinite(table).all():
            raise ArmError(f"arm {self.name}: expected a finite DH table ({len(self.links)}, 4), got {table.shape}")
        links = tuple(
            dataclasses.replace(link, d_m=d, theta_rad=theta, L_m=length, alpha_rad=alpha)
            for link, (d, theta, length, alpha) in zip(self.links, table.tolist(), strict=True)
        )
        made = self.tolerances
        if made is not None and not made.about:
            made = dataclasses.replace(made, about=tuple((k.d_m, k.theta_rad, k.L_m, k.alpha_rad) for k in self.links))
        return dataclasses.replace(self, links=links, tolerances=made)

    def drive(self, joint: int) -> Drive:
        """Return the drive of a joint (1-based); MissingModel if the file has none."""
        for drive in self.drives:
            if drive.joint == joint:
                return drive
        has = ", ".join(str(drive.joint) for drive in self.drives) or "none"
        raise MissingModel(f"arm {self.name}: joint {joint} has no [[drive]] (joints with a drive: {has}); add one")

    def is_behind_encoder(self, effect: str, joint: int | None) -> bool:
        """Return whether an effect, by the key `joint` of its [[effect]], is between an encoder and its joint, or beyond.

        What the transmission does is not where the encoder is on the joint: it moves the motor there.
        """
        if not EFFECTS[effect].is_of_transmission:
            return True
        moved = moved_joint(effect, joint)
        return not any(drive.joint == moved and drive.encoder_on == "joint" for drive in self.drives)

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
        kind = next(KINDS[board.kind] for board in self.boards if board.name == gripper.board)
        motor = Drive(
            joint=self.joint_count + 1,
            pid=DrivePid("position" if kind.limits_force else "voltage"),
            gear_ratio=1.0,
            encoder_counts_per_rev=max(gripper.encoder_counts_per_rev, 1),
            torque_constant_Nm_A=gripper.torque_constant_Nm_A,
            resistance_ohm=gripper.resistance_ohm,
            supply_V=gripper.supply_V,
            rotor_inertia_kg_m2=gripper.rotor_inertia_kg_m2,
            current_limit_A=gripper.current_limit_A,
            joint_speed_limit_rad_s=gripper.speed_limit_m_s * 2.0 * math.pi / gripper.travel_per_turn_m,
            encoder_direction=gripper.motor_direction,
            motor_direction=gripper.motor_direction,
            board=gripper.board,
            board_channel=gripper.board_channel,
            servo=gripper.servo,
        )
        return (*self.drives, motor)

    def has_absolute_encoder(self, drive: Drive) -> bool:
        """Return whether a drive's encoder knows the joint's angle at power-up, within `unique_rad`."""
        return self._repeats_rad(drive) < math.inf and not self.turn_of_home_rad(drive)

    def turn_of_home_rad(self, drive: Drive) -> float:
        """Return the joint's angle after which an absolute encoder repeats whose turn homing has to tell; 0 of others.

        It repeats within the joint's range, and [drive.home] says how the turn is found; smart servos read no switch.
        """
        repeats_rad = self._repeats_rad(drive)
        if drive.home is None or repeats_rad == math.inf or self.kind_of(drive).is_absolute:
            return 0.0
        return repeats_rad if drive.joint_upper_rad - drive.joint_lower_rad >= repeats_rad else 0.0

    def _repeats_rad(self, drive: Drive) -> float:
        """The joint's angle after which an absolute encoder says the same again at power-up; infinite of others."""
        board, kind = self.board(drive), self.kind_of(drive)
        is_absolute = kind.is_absolute or (board is not None and board.absolute)
        if drive.encoder_board >= 0 or not is_absolute:
            return math.inf
        turns = 1.0 if kind.is_absolute else board.absolute_turns if board else None
        return 2.0 * math.pi * (drive.encoder_turns if turns is None else turns) / drive.encoder_turns

    def unique_rad(self, drive: Drive) -> float:
        """Return the joint's angle after which an absolute encoder says the same again at power-up; infinite for others."""
        return self._repeats_rad(drive) if self.has_absolute_encoder(drive) else math.inf

    @property
    def can_home(self) -> bool:
        """Whether every joint can find its zero: by [drive.home], or an absolute encoder."""
        return all(drive.home is not None or self.has_absolute_encoder(drive) for drive in self.drives)

    @property
    def usual_rate_Hz(self) -> float:
        """The loop's rate if none is asked for: what the slowest kind of board carries, and its CAN bus."""
        return usual_rate_Hz([self])

    @property
    def boards_rate_Hz(self) -> float:
        """What the slowest kind of its boards carries."""
        return min((self.kind_of(drive).usual_rate_Hz for drive in self.motors), default=REFERENCE.usual_rate_Hz)

    @property
    def rest_rad(self) -> tuple[float, ...]:
        """The rest pose [rad]; all joints at zero where none is given."""
        return self.rest.q_rad if self.rest is not None else (0.0,) * self.joint_count

    @property
    def limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper limit of every joint [rad]; infinite if no drive gives one."""
        ranges = {drive.joint: (drive.joint_lower_rad, drive.joint_upper_rad) for drive in self.drives}
        return tuple(ranges.get(j, (-math.inf, math.inf)) for j in range(1, self.joint_count + 1))
