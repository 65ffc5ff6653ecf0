"""What an arm.toml says about the end of the arm: tools, gripper, pins; and the cameras that see it: frames of docs/camera.md, or
the stream of a motion capture system (docs/motion_capture.md). A field's name is its key in the file.
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

from control.model import rules
from control.model.reader import Rejected, read_table

Vector3 = tuple[float, float, float]
Positive = Annotated[float, rules.POSITIVE]
NonNegative = Annotated[float, rules.NOT_NEGATIVE]
Position = Annotated[Vector3, rules.POSITION]


@dataclass(frozen=True, slots=True)
class Tool:
    """What is mounted on the last link: one [tool], or several [[tool]] of which the first is on at the start.

    `armwright tool NAME` changes it (docs/tools.md).
    """

    position_m: Annotated[Position, "the tip (tool centre point) in the last link's frame"] = (0.0, 0.0, 0.0)
    known: Annotated[bool, "false: `calibrate` identifies it"] = True
    name: Annotated[str, rules.WORD, "required and unique where there are several"] = ""
    mass_kg: Annotated[NonNegative, rules.TOOL_MASS, "a point mass, beyond the masses of the links"] = 0.0
    com_m: Annotated[Position | None, "where it is, in the last link's frame", "at the tip"] = None

    @property
    def centre_m(self) -> Vector3:
        """The centre of its mass in the last frame."""
        return self.position_m if self.com_m is None else self.com_m


NO_TOOL = Tool()


@dataclass(frozen=True, slots=True)
class Gripper:
    """A gripper: one motor, on a motor board of its own or a [[board]], opens and closes the fingers (docs/tools.md).

    The opening is the distance that the motor moves them: 0 closed, `travel_m` open.
    """

    travel_m: Annotated[Positive, rules.TRAVEL, "from closed to open"]
    travel_per_turn_m: Annotated[Positive, rules.TRAVEL, "of the opening, per motor turn"]
    torque_constant_Nm_A: Annotated[Positive, "of the motor; equals its back-EMF constant in V s/rad"]
    resistance_ohm: Annotated[Positive, "of the winding, between terminals"]
    supply_V: Annotated[Positive, "of the motor board"]
    current_limit_A: Annotated[Positive, "continuous, of the motor"]
    speed_limit_m_s: Annotated[Positive, rules.FINGER_SPEED, "of the opening"]
    motor_node: Annotated[int, rules.NODE, "CAN node of its motor board; or `board`", "none"] = -1
    board: Annotated[str, "name of the [[board]] that drives it"] = ""
    board_channel: Annotated[int, rules.ONE_OR_MORE, "which motor of that board, from 1"] = 1
    servo: Annotated[str, "as in [[drive]]; it does not give current_limit_A, which a held object needs lower"] = ""
    encoder_counts_per_rev: Annotated[int, rules.ZERO_OR_MORE, "per motor turn; 0: no encoder, so it can only open and close"] = 0
    rotor_inertia_kg_m2: Annotated[NonNegative, rules.ROTOR, "of the rotor; for the mock"] = 0.0
    motor_direction: Annotated[int, rules.DIRECTION, "-1: a positive voltage closes"] = 1
    motor_serial_number: Annotated[Annotated[int, rules.ZERO_OR_MORE] | None, "compared with the board's, if given"] = None
    force_N: Annotated[Positive | None, "where no force is asked for", "half of that at the current limit"] = None
    on_fault: Annotated[
        Literal["hold", "release"], "after a fault of the arm, and without the host: keep what it has, or open the circuit"
    ] = "hold"

    @property
    def constant_N_A(self) -> float:
        """Force per current without friction, and voltage per speed [V s/m]: 2 pi k_t / travel per turn."""
        return 2.0 * math.pi * self.torque_constant_Nm_A / self.travel_per_turn_m

    @property
    def force_limit_N(self) -> float:
        """The force at the current limit."""
        return self.constant_N_A * self.current_limit_A

    @property
    def usual_force_N(self) -> float:
        """The force where none is asked for."""
        return 0.5 * self.force_limit_N if self.force_N is None else self.force_N


@dataclass(frozen=True, slots=True)
class Digital:
    """A spare pin of a motor board, by name (docs/tools.md)."""

    name: Annotated[str, rules.WORD, "unique"]
    board: Annotated[int, rules.NODE, "CAN node of the motor board, of a joint or the gripper"]
    pin: Annotated[int, rules.PIN, "its number on the board"]
    direction: Annotated[Literal["input", "output"], "seen from the board"]
    safe: Annotated[
        Literal["low", "high", "keep"], 'of an output while the drives are off and after a fault; "keep": as it was'
    ] = "low"


def read_tools(document: dict[str, Any]) -> tuple[dict[str, Any], tuple[Tool, ...]]:
    """Read the `[[tool]]`s of a document: the rest of it, and the tools. There are none if it has one `[tool]`, or nothing."""
    tables = document.get("tool")
    if not isinstance(tables, list) or not tables:
        return document, ()
    tools = tuple(read_table(Tool, table, ("tool", index)) for index, table in enumerate(tables))
    seen: set[str] = set()
    for index, tool in enumerate(tools):
        path = ("tool", index, "name")
        if not tool.name:
            raise Rejected(path, "a name for every [[tool]]", "nothing", "`armwright tool NAME` chooses one")
        if tool.name in seen:
            raise Rejected(path, "a unique name for every [[tool]]", f"{tool.name} a second time")
        seen.add(tool.name)
    return {key: value for key, value in document.items() if key != "tool"}, tools


System = Literal["vicon", "natnet", "qualisys"]
USUAL_PORT = {"vicon": 51001, "natnet": 1510, "qualisys": 22223}
Unit = Annotated[tuple[float, float, float, float], rules.QUATERNION]


@dataclass(frozen=True, slots=True)
class CameraStream:
    """A motion capture system whose bodies are followed (docs/motion_capture.md)."""

    system: Annotated[System, "whose stream it is"]
    body: Annotated[str, "the body at the tip"]
    base_body: Annotated[str, "a body on the arm's base: the tip is then measured relative to it"] = ""
    host: Annotated[str, "the computer that sends; for vicon, empty takes packets of any"] = ""
    port: Annotated[
        Annotated[int, rules.UDP_PORT] | None,
        "vicon: on which packets arrive; natnet: of Motive's commands; qualisys: of QTM",
        "51001, 1510, 22223",
    ] = None
    origin_m: Annotated[
        Position | None, "of the system's frame, or of the base body, in the arm's base frame; absent: `calibrate` finds it"
    ] = None
    orientation: Annotated[Unit, "of the same frame: quaternion w, x, y, z"] = (1.0, 0.0, 0.0, 0.0)

    @property
    def is_placed(self) -> bool:
        """Whether measured tips can be said in the arm's base frame."""
        return self.origin_m is not None

    @property
    def usual_port(self) -> int:
        """The port of the file, else the one that the system uses."""
        return self.port or USUAL_PORT[self.system]


@dataclass(frozen=True, slots=True)
class Camera:
    """The camera that measures the tip (docs/camera.md, docs/motion_capture.md)."""

    position_noise_m: Annotated[NonNegative, rules.CAMERA_NOISE, "standard deviation per axis"] = 0.0
    orientation_noise_rad: Annotated[
        NonNegative, rules.TURN_NOISE, "standard deviation about each axis of measured orientations", "0.002 is assumed"
    ] = 0.0
    udp_port: Annotated[int, rules.UDP_PORT, "on which its frames arrive"] = 47_310
    stream: Annotated[CameraStream | None, "absent: frames of docs/camera.md"] = None

    @property
    def measures_orientation(self) -> bool:
        """Whether it sends orientations beside positions; a camera of docs/camera.md sends positions only."""
        return self.stream is not None

    @property
    def has_own_frame(self) -> bool:
        """Whether it measures in a frame whose place to the arm's base is unknown."""
        return self.stream is not None and not self.stream.is_placed

    @property
    def port(self) -> int:
        """On which frames arrive, or where the system answers."""
        return self.udp_port if self.stream is None else self.stream.usual_port

    @property
    def listens(self) -> bool:
        """Whether its port is one of this computer, which no other arm can have."""
        return self.stream is None or self.stream.system == "vicon"

    def with_port(self, port: int | None) -> "Camera":
        """The same camera on another port (None: the usual one)."""
        if self.stream is None:
            return replace(self, udp_port=Camera().udp_port if port is None else port)
        return replace(self, stream=replace(self.stream, port=port))

    def on_this_machine(self, port: int) -> "Camera":
        """The same camera as a mock on loopback plays it."""
        there = self if self.stream is None else replace(self, stream=replace(self.stream, host="127.0.0.1"))
        return there.with_port(port)
