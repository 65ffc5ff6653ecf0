"""Mock cameras: rate, clock, latency; the one whose datagrams are those of docs/camera.md, and motion capture systems, written
from the vendors' descriptions and held to other people's clients.

In: what a scene shows, a body at the tip, one on the arm's base, and one that stands aside. Out: datagrams of docs/camera.md,
or bytes of Vicon's object stream, NatNet 4.1 and QTM's real-time protocol.
"""

from __future__ import annotations

import math
import random
import struct
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Literal, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float, float]
TipPose = tuple[Point, tuple[Point, Point, Point]]  # the tip, and the axes x, y, z of the last link


class Filmed(Protocol):
    """The arm before the camera, as it is now."""

    def tip_m(self) -> Point: ...

    def tip_pose(self) -> TipPose: ...


Transport = Literal["datagrams", "commands", "connection"]  # sent to a port; UDP commands answered; a TCP server
_DATAGRAM = struct.Struct("<4sBBHIdddd")
_VISIBLE = 1
TIP_MARKER = 0


@dataclass(frozen=True, slots=True)
class CameraSetup:
    """Rate, noise per axis (standard deviation), latency from image to datagram, share of frames without the tip."""

    rate_Hz: float = 100.0
    noise_m: float = 0.00014
    latency_s: float = 0.0
    dropout: float = 0.0
    clock_ppm: float = 0.0
    seed: int = 0


class PictureMock(ABC):
    """Takes an image at the first tick at or after each multiple of its period, stamped with that tick's time."""

    transport: Transport = "datagrams"
    is_exchanged = False  # two bodies have each other's name

    def __init__(self, setup: CameraSetup) -> None:
        self.setup = setup
        self.random = random.Random(f"camera {setup.seed}")
        self._pictures = 0
        self._rate = 1.0 + setup.clock_ppm * 1e-6
        self._on_its_way: deque[tuple[float, bytes]] = deque()
        self.next_s = 0.0  # nothing to do before this time

    def tick(self, now_s: float, arm: Filmed) -> list[bytes]:
        """What is sent now; `arm` is looked at only when an image is due."""
        due_s = self._pictures / self.setup.rate_Hz
        if now_s >= due_s - 1e-9:
            self._pictures = int((now_s + 1e-9) * self.setup.rate_Hz) + 1
            self._on_its_way.append((now_s + self.setup.latency_s, self.picture(now_s * self._rate, arm)))
        ready = []
        while self._on_its_way and self._on_its_way[0][0] <= now_s + 1e-9:
            ready.append(self._on_its_way.popleft()[1])
        arrival_s = self._on_its_way[0][0] if self._on_its_way else float("inf")
        self.next_s = min(self._pictures / self.setup.rate_Hz, arrival_s) - 1e-9
        return ready

    @abstractmethod
    def picture(self, time_s: float, arm: Filmed) -> bytes:
        """The packet of an image at a time of the camera's clock."""

    def answer(self, request: bytes) -> list[bytes]:
        """Packets that answer one of the host."""
        return []


class CameraMock(PictureMock):
    """Sees one marker at the tip, in the base frame."""

    def __init__(self, setup: CameraSetup) -> None:
        super().__init__(setup)
        self._sequence = 0

    def picture(self, time_s: float, arm: Filmed) -> bytes:
        """One datagram."""
        source, noise_m = self.random, self.setup.noise_m
        seen = [value + source.gauss(0.0, noise_m) for value in arm.tip_m()]
        is_visible = source.random() >= self.setup.dropout
        if not is_visible:
            seen = [0.0, 0.0, 0.0]
        flags = _VISIBLE if is_visible else 0
        coded = _DATAGRAM.pack(b"AWCM", 1, flags, TIP_MARKER, self._sequence & 0xFFFFFFFF, time_s, *seen)
        self._sequence += 1
        return coded


# What a mock motion capture system sees: a body at the tip, one on the arm's base, and one that stands
# aside.
#
# The system's frame is anywhere: a point of the base frame is at turn' (p - place) in it.


Array = NDArray[np.float64]
BASE_m, BASE_turn_rad = (-0.12, 0.08, 0.05), (0.3, -0.2, 0.9)  # of the body on the base, in the base frame
ASIDE_m, ASIDE_turn_rad = (0.3, -0.6, 0.2), (0.0, 0.4, 0.1)
TARGET_turn_rad = (0.5, -0.3, 0.2)  # of the body at the tip, on the last link
ASIDE = "wand"


@dataclass(frozen=True, slots=True)
class SceneSetup:
    """Names of the bodies (base: may be empty), place of the system's frame in the base frame, noise of orientations."""

    body: str
    base_body: str
    place_m: Point
    turn_rad: Point
    turn_noise_rad: float


@dataclass(frozen=True, slots=True)
class Sight:
    """A body in the system's frame: position (3,) [m], rotation (3, 3) of its axes."""

    name: str
    position_m: Array
    rotation: Array
    is_visible: bool


def rotation_of(vector_rad: Point) -> Array:
    """The rotation (3, 3) about a vector by its length."""
    angle = float(np.linalg.norm(vector_rad))
    axis = np.array(vector_rad) / angle if angle > 0.0 else np.array([0.0, 0.0, 1.0])
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, axis, angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


class MocapMock(PictureMock):
    """Sees bodies; a subclass says them in a vendor's format."""

    def __init__(self, setup: CameraSetup, scene: SceneSetup) -> None:
        super().__init__(setup)
        self.scene = scene
        self._turn, self._place = rotation_of(scene.turn_rad), np.array(scene.place_m)
        self._still = [(ASIDE, np.array(ASIDE_m), rotation_of(ASIDE_turn_rad))]
        if scene.base_body:
            self._still.append((scene.base_body, np.array(BASE_m), rotation_of(BASE_turn_rad)))
        self._number = 0

    @property
    def names(self) -> list[str]:
        """All bodies, in the order in which they are sent."""
        return [self.scene.body, *(name for name, _, _ in self._still)]

    def picture(self, time_s: float, arm: Filmed) -> bytes:
        """A packet of the vendor's format."""
        self._number += 1
        return self.packet(self._number, time_s, self._sights(arm.tip_pose()))

    @abstractmethod
    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """A frame in the vendor's format."""

    def _sights(self, tip: TipPose) -> list[Sight]:
        is_visible = self.random.random() >= self.setup.dropout
        place, axes = tip
        target = np.array(axes).T @ rotation_of(TARGET_turn_rad)
        sights = [self._sight(self.scene.body, np.array(place), target, is_visible)]
        sights += [self._sight(name, at, turn, True) for name, at, turn in self._still]
        if self.is_exchanged:
            first, second, *others = sights
            sights = [
                Sight(first.name, second.position_m, second.rotation, second.is_visible),
                Sight(second.name, first.position_m, first.rotation, first.is_visible),
                *others,
            ]
        return sights

    def _sight(self, name: str, place_m: Array, rotation: Array, is_visible: bool) -> Sight:
        noise_m, turn_rad = self.setup.noise_m, self.scene.turn_noise_rad
        shake = rotation_of(self._gauss(turn_rad))
        seen_m = self._turn.T @ (place_m - self._place) + self._gauss(noise_m)
        return Sight(name, seen_m, shake @ self._turn.T @ rotation, is_visible)

    def _gauss(self, sd: float) -> Point:
        source = self.random
        return source.gauss(0.0, sd), source.gauss(0.0, sd), source.gauss(0.0, sd)


# Vicon Tracker as a UDP object stream: docs/motion_capture.md has the bytes. Objects that are hidden are
# left out.


_OBJECT = struct.Struct("<BH24s6d")
_OBJECT_bytes = 72


class ViconMock(MocapMock):
    """Sends one datagram a frame."""

    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """Header and one item for each visible object."""
        seen = [sight for sight in sights if sight.is_visible]
        items = b"".join(
            _OBJECT.pack(0, _OBJECT_bytes, sight.name.encode(), *(1e3 * sight.position_m), *_euler_xyz(sight)) for sight in seen
        )
        return struct.pack("<IB", number & 0xFFFFFFFF, len(seen)) + items


def _euler_xyz(sight: Sight) -> tuple[float, float, float]:
    """Angles with rotation = Rx Ry Rz."""
    r = sight.rotation
    return (math.atan2(-r[1, 2], r[2, 2]), math.asin(max(-1.0, min(1.0, float(r[0, 2])))), math.atan2(-r[0, 1], r[0, 0]))


# Motive as NatNet 4.1, unicast: answers connect and model requests, sends rigid bodies to the client that
# has asked last.


_CONNECT, _SERVER_INFO, _REQUEST_MODELS, _MODELS, _FRAME = 0, 1, 4, 5, 7
_UNKNOWN_REQUEST = 100
_EMPTY = struct.pack("<ii", 0, 0)  # a kind of data without items: count and size
FIRST_ID = 11
MEAN_ERROR_m = 2e-4


class NatNetMock(MocapMock):
    """Answers commands, and sends a datagram a frame once a client has connected."""

    transport = "commands"

    def answer(self, request: bytes) -> list[bytes]:
        """Server info, names of the rigid bodies, or nothing."""
        if len(request) < 4:
            return []
        (message,) = struct.unpack_from("<H", request)
        match message:
            case 0:
                return [_packet(_SERVER_INFO, self._server_info())]
            case 4:
                return [_packet(_MODELS, self._models())]
            case 10:
                return []
        return [_packet(_UNKNOWN_REQUEST, b"")]

    def _server_info(self) -> bytes:
        name = b"Motive".ljust(256, b"\0")
        return name + bytes((3, 1, 0, 0, 4, 1, 0, 0)) + struct.pack("<QHB4B", 10_000_000, 1511, 0, 239, 255, 42, 99)

    def _models(self) -> bytes:
        markers = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)]
        models = []
        for number, name in enumerate(self.names, FIRST_ID):
            body = name.encode() + b"\0" + struct.pack("<ii3f", number, -1, 0.0, 0.0, 0.0) + struct.pack("<i", len(markers))
            body += b"".join(struct.pack("<3f", *marker) for marker in markers)
            body += struct.pack(f"<{len(markers)}i", *range(len(markers)))
            body += b"".join(b"Marker\0" for _ in markers)
            models.append(struct.pack("<ii", 1, len(body)) + body)
        marker_set = b"all\0" + struct.pack("<i", 1) + b"one\0"
        models.insert(0, struct.pack("<ii", 0, len(marker_set)) + marker_set)
        return struct.pack("<i", len(models)) + b"".join(models)

    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """One frame, with a marker set and labelled markers as Motive sends them."""
        marker_set = b"all\0" + struct.pack("<i3f", 1, 0.1, 0.2, 0.3)
        bodies = b"".join(_body(at, sight) for at, sight in enumerate(sights, FIRST_ID))
        labelled = struct.pack("<i3ffHf", 1, 0.1, 0.2, 0.3, 0.014, 2, 1e-4)
        parts = [
            struct.pack("<i", number),
            struct.pack("<ii", 1, len(marker_set)) + marker_set,
            _EMPTY,
            struct.pack("<ii", len(sights), len(bodies)) + bodies,
            _EMPTY,
            _EMPTY,
            struct.pack("<ii", 1, len(labelled)) + labelled,
            _EMPTY,
            _EMPTY,
            struct.pack("<IIdQQQH", 0, 0, time_s, 0, 0, 0, 0),
        ]
        return _packet(_FRAME, b"".join(parts))


def _packet(message: int, payload: bytes) -> bytes:
    return struct.pack("<HH", message, len(payload)) + payload


def _body(number: int, sight: Sight) -> bytes:
    if not sight.is_visible:
        return struct.pack("<i3f4ffH", number, *[0.0] * 7, 0.0, 0)
    w, x, y, z = quaternion_of(sight.rotation)
    return struct.pack("<i3f4ffH", number, *sight.position_m, x, y, z, w, MEAN_ERROR_m, 1)


def quaternion_of(rotation: Array) -> tuple[float, float, float, float]:
    """w, x, y, z by the eigenvector of Bar-Itzhack's matrix (J. Guidance 23, 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, 3].tolist()
    length = math.hypot(w, x, y, z)
    return w / length, x / length, y / length, z / length


# Qualisys Track Manager's real-time server: greets, agrees on a version, tells the bodies' names, streams
# 6D with residuals.


_ERROR, _COMMAND, _XML, _DATA = 0, 1, 2, 3
_6D_RESIDUAL = 11
RESIDUAL_mm = 0.2
GREETING = b"QTM RT Interface connected"


class QtmMock(MocapMock):
    """Answers commands on a TCP connection; `request` is one packet of the client, empty when it connects."""

    transport = "connection"
    _is_streaming = False

    def tick(self, now_s: float, arm: Filmed) -> list[bytes]:
        """Data packets, once the client has asked for them."""
        packets = super().tick(now_s, arm)
        return packets if self._is_streaming else []

    def answer(self, request: bytes) -> list[bytes]:
        """The answers to one command."""
        if not request:
            self._is_streaming = False
            return [_qtm_packet(_COMMAND, GREETING + b"\0")]
        words = request[8:].split(b"\0")[0].decode(errors="replace").split()
        match [word.lower() for word in words]:
            case ["version", version]:
                return [_qtm_packet(_COMMAND, f"Version set to {version}\0".encode())]
            case ["getparameters", "6d"]:
                return [_qtm_packet(_XML, self._parameters().encode() + b"\0")]
            case ["streamframes", *how]:
                self._is_streaming = how != ["stop"]
                return []
        return [_qtm_packet(_ERROR, b"Parse error\0")]

    def _parameters(self) -> str:
        bodies = "".join(
            f"<Body><Name>{name}</Name><RGBColor>255</RGBColor><Mesh><Name></Name></Mesh></Body>" for name in self.names
        )
        return f"<QTM_Parameters_Ver_1.19><The_6D><Bodies>{len(self.names)}</Bodies>{bodies}</The_6D></QTM_Parameters_Ver_1.19>"

    def packet(self, number: int, time_s: float, sights: list[Sight]) -> bytes:
        """One frame with one component."""
        bodies = b"".join(_qtm_body(sight) for sight in sights)
        content = struct.pack("<IHH", len(sights), 0, 0) + bodies
        component = struct.pack("<II", 8 + len(content), _6D_RESIDUAL) + content
        return _qtm_packet(_DATA, struct.pack("<QII", round(time_s * 1e6), number, 1) + component)


def _qtm_packet(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", 8 + len(content), kind) + content


def _qtm_body(sight: Sight) -> bytes:
    if not sight.is_visible:
        return struct.pack("<13f", *[math.nan] * 13)
    return struct.pack("<3f9ff", *(1e3 * sight.position_m), *sight.rotation.T.ravel(), RESIDUAL_mm)
