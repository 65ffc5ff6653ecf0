"""The cameras of an arm.toml: frames of docs/camera.md, or the stream of a motion capture system (docs/motion_capture.md)."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from control.model.end_effector import Vector3
from control.model.rules import CAMERA_NOISE, NOT_NEGATIVE, POSITION, QUATERNION, TURN_NOISE, UDP_PORT

System = Literal["vicon", "natnet", "qualisys"]
USUAL_PORT = {"vicon": 51001, "natnet": 1510, "qualisys": 22223}
NonNegative = Annotated[float, NOT_NEGATIVE]
Position = Annotated[Vector3, POSITION]
Unit = Annotated[tuple[float, float, float, float], QUATERNION]


@dataclass(frozen=True, slots=True)
class CameraStream:
    """A motion capture system whose bodies are followed (docs/motion_capture.md)."""

    system: Annotated[System, "whose stream it is"]
    body: Annotated[str, "the body at the tip"]
    base_body: Annotated[str, "a body on the arm's base: the tip is then measured relative to it"] = ""
    host: Annotated[str, "the computer that sends; for vicon, empty takes packets of any"] = ""
    port: Annotated[
        Annotated[int, UDP_PORT] | None,
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

    position_noise_m: Annotated[NonNegative, CAMERA_NOISE, "standard deviation per axis"] = 0.0
    orientation_noise_rad: Annotated[
        NonNegative, TURN_NOISE, "standard deviation about each axis of measured orientations", "0.002 is assumed"
    ] = 0.0
    udp_port: Annotated[int, UDP_PORT, "on which its frames arrive"] = 47_310
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
