"""The camera for the loop: the newest sight of the tip, from frames of docs/camera.md or from a motion capture system."""

from __future__ import annotations

from typing import Protocol

from control.model.end_effector import Camera, CameraStream
from firmware_iface.camera import TIP_SOURCE, CameraReceiver
from firmware_iface.clock import Clock
from firmware_iface.errors import LinkError
from firmware_iface.mocap.bodies import (
    BodyFrame,
    BodyStream,
    LeapWatch,
    Quaternion,
    RigidPose,
    SteadyPose,
    Vector,
    compose,
    inverse,
)
from firmware_iface.mocap.natnet import NatNetStream
from firmware_iface.mocap.qtm import QtmStream
from firmware_iface.mocap.vicon import ViconStream

WITHOUT_A_STREAM = "no frames arrive"
UNPLACED = "its frame has no known place to the arm's base: a session and `calibrate` find it"


class TipCamera(Protocol):
    """A source of tip measurements. It never blocks.

    has_own_frame: it measures in a frame whose place to the arm's base is unknown, else in the base frame.
    """

    has_own_frame: bool

    def newest(self) -> tuple[Vector, Quaternion | None] | None:
        """Tip, and the orientation of its target if one is measured, of the newest frame since the last call that shows it."""

    def problem(self) -> str:
        """Why the tip is not measured now; empty if nothing is wrong."""

    def close(self) -> None:
        """End it."""


def open_camera(camera: Camera | None, port: int, clock: Clock) -> TipCamera:
    """The camera of an arm.toml, on `port`. LinkError if its port is taken, or the system does not answer."""
    if camera is None or camera.stream is None:
        return FrameCamera(CameraReceiver(port))
    stream = camera.stream
    return BodyCamera(open_stream(stream.system, stream.host, port, clock), stream)


class FrameCamera:
    """Meets TipCamera: frames of docs/camera.md, in the base frame."""

    has_own_frame = False

    def __init__(self, receiver: CameraReceiver) -> None:
        self._receiver = receiver
        self._is_hidden: bool | None = None

    def newest(self) -> tuple[Vector, Quaternion | None] | None:
        """Tip of the newest frame that shows it."""
        tip = None
        for frame in self._receiver.receive():
            if frame.source == TIP_SOURCE:
                self._is_hidden = not frame.is_visible
                tip = frame.position_m if frame.is_visible else tip
        return None if tip is None else (tip, None)

    def problem(self) -> str:
        """That no frame came, or that the marker is hidden."""
        if self._is_hidden is None:
            return WITHOUT_A_STREAM
        return "the marker is hidden" if self._is_hidden else ""

    def close(self) -> None:
        """Stop listening."""
        self._receiver.close()


class BodyCamera:
    """Meets TipCamera: a body of a motion capture system, relative to a body on the arm's base if there is one."""

    def __init__(self, stream: BodyStream, how: CameraStream) -> None:
        self.has_own_frame = not how.is_placed
        self._stream, self._body, self._base_body = stream, how.body, how.base_body
        self._place = None if how.origin_m is None else RigidPose(how.origin_m, how.orientation)
        self._leaps, self._base = LeapWatch(), SteadyPose()
        self._problem, self._is_lost = WITHOUT_A_STREAM, False

    def newest(self) -> tuple[Vector, Quaternion | None] | None:
        """Pose of the body in the newest frame that shows it."""
        if self._is_lost:
            return None
        pose = None
        for frame in self._received():
            self._leaps.look(frame)
            self._problem = self._fault_in(frame)
            pose = pose if self._problem else self._of(frame)
        return None if pose is None else (pose.position_m, pose.quaternion)

    def _received(self) -> list[BodyFrame]:
        """A stream that is lost takes only the tip's measurement away: it is no fault of the arm."""
        try:
            return self._stream.receive()
        except LinkError as error:
            self._is_lost, self._problem = True, f"{error}; restart `armwright serve` once it is back"
            return []

    def _of(self, frame: BodyFrame) -> RigidPose:
        poses = {body.name: body.pose for body in frame.bodies}
        pose = poses[self._body]
        if self._base_body:
            pose = compose(inverse(self._base.after(poses[self._base_body])), pose)
        return pose if self._place is None else compose(self._place, pose)

    def _fault_in(self, frame: BodyFrame) -> str:
        """Why the wanted bodies of a frame are not to be used; empty if they are."""
        bodies = {body.name: body for body in frame.bodies}
        for name in (self._body, *([self._base_body] if self._base_body else [])):
            if name not in bodies:
                there = ", ".join(sorted(bodies)) or "none"
                return f"body {name} is not in the stream: hidden, or named otherwise (bodies there: {there})"
            if not bodies[name].is_visible:
                return f"body {name} is hidden"
            if said := self._leaps.problem(name):
                return said
        return ""

    def problem(self) -> str:
        """What is wrong with the newest frame; counts packets that were not understood if no other came."""
        if self._problem == WITHOUT_A_STREAM and self._stream.rejected:
            return f"{self._stream.rejected} packets on {self._stream.name}, none of this system's format"
        return self._problem or (UNPLACED if self.has_own_frame else "")

    def close(self) -> None:
        """End the stream."""
        self._stream.close()


def open_stream(system: str, host: str, port: int, clock: Clock) -> BodyStream:
    """Open it, and wait for its names where it says them. LinkError if the port is taken or nothing answers."""
    if system == "natnet":
        return NatNetStream(host, port, clock)
    if system == "qualisys":
        return QtmStream(host, port, clock)
    return ViconStream(host, port)
