"""Qualisys Track Manager by its real-time protocol over TCP: version, names of the bodies, then every frame.

Packets, on its little-endian port (QTM RT server protocol, 1.19 and later). Each: its size u32 (with these 8 bytes), kind
u32, content.

    kind 0 error, 1 command, 2 XML   text, zero-terminated
    kind 3 data                      time u64 [us], frame u32, components u32; each: size u32 (with these 8 bytes), kind u32,
                                     content
    component 11, 6D with residual   bodies u32, drop rate u16, out of sync u16; each body: x y z f32 [mm], rotation matrix 9 f32
                                     column by column, residual f32 [mm]; not tracked: NaN

Bodies have no names here: they come in the order of the XML parameters "6D".
"""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Callable, Sequence
from struct import Struct
from xml.etree import ElementTree

from firmware_iface.clock import Clock
from firmware_iface.errors import BoardSilent, LinkLost, PortMissing, WrongIdentity
from firmware_iface.mocap.bodies import (
    MOST_ITEMS,
    NOWHERE,
    BodyFrame,
    FARTHEST_m,
    Fields,
    Malformed,
    Quaternion,
    RigidPose,
    SeenBody,
    unit,
)

ERROR, COMMAND, XML, DATA = 0, 1, 2, 3
LONGEST_bytes = 4_000_000  # of a packet; XML of all parameters has some 100 kB
HEADER = Struct("<II")
_DATA, _BODIES, _BODY = Struct("<QII"), Struct("<IHH"), Struct("<3f9ff")
_6D_RESIDUAL = 11
_MM = 1e-3


class Packets:
    """Cuts a stream of bytes into packets."""

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, received: bytes) -> list[tuple[int, bytes]]:
        """Kind and content of each packet that is complete. Malformed for a size that no packet has."""
        self._buffer += received
        packets = []
        while len(self._buffer) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._buffer)
            if not HEADER.size <= size <= LONGEST_bytes:
                raise Malformed
            if len(self._buffer) < size:
                break
            packets.append((kind, self._buffer[HEADER.size : size]))
            self._buffer = self._buffer[size:]
        return packets


def command(text: str) -> bytes:
    """A client's command."""
    content = text.encode() + b"\0"
    return HEADER.pack(HEADER.size + len(content), COMMAND) + content


def text_of(content: bytes) -> str:
    """The text of an error, a command or XML."""
    return content.split(b"\0", 1)[0].decode(errors="replace")


def unpack_names(content: bytes) -> list[tuple[str, bool]] | None:
    """Names of the 6D bodies in order, and whether each is enabled, from the XML parameters; None if it is something else."""
    text = text_of(content)
    if "<!" in text.replace("<!--", ""):  # no document types: entities could grow without end
        return None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return None
    bodies = root.findall(".//The_6D/Body")
    found = [(body.findtext("Name", ""), body.findtext("Enabled", "true").lower() == "true") for body in bodies]
    return found if all(name for name, _ in found) and len(found) <= MOST_ITEMS else None


def unpack_data(content: bytes, names: Sequence[tuple[str, bool]]) -> BodyFrame | None:
    """The bodies of a data packet, or None. Bodies that are not enabled may be left out."""
    fields = Fields(content)
    try:
        time_us, number, components = fields.read(_DATA)
        bodies: tuple[SeenBody, ...] | None = None
        for _ in range(int(components)):
            size, kind = fields.read(HEADER)
            end = fields.at - HEADER.size + int(size)
            if kind == _6D_RESIDUAL:
                bodies = _bodies(fields, names)
            fields.skip(end - fields.at)
    except Malformed:
        return None
    if fields.left or bodies is None:
        return None
    return BodyFrame(int(number), bodies, 1e-6 * time_us)


def _bodies(fields: Fields, names: Sequence[tuple[str, bool]]) -> tuple[SeenBody, ...]:
    count, *_ = fields.read(_BODIES)
    called = [name for name, _ in names]
    if count != len(called):
        called = [name for name, is_enabled in names if is_enabled]
    if count != len(called) or len(set(called)) < len(called):
        raise Malformed
    return tuple(_body(name, *fields.read(_BODY, is_finite=False)) for name in called)


def _body(name: str, x: float, y: float, z: float, *rest: float) -> SeenBody:
    *matrix, residual_mm = rest
    if not all(map(math.isfinite, (x, y, z, *matrix))):
        return SeenBody(name, NOWHERE, is_visible=False)
    quaternion = _quaternion(matrix)
    if quaternion is None or max(abs(x), abs(y), abs(z)) > FARTHEST_m / _MM:
        raise Malformed
    return SeenBody(name, RigidPose((_MM * x, _MM * y, _MM * z), quaternion), True, _MM * residual_mm)


def _quaternion(columns: Sequence[float]) -> Quaternion | None:
    """Of a rotation matrix column by column; None if it is none. Each square from the diagonal; the largest divides."""
    a, d, g, b, e, h, c, f, i = columns
    squares = (1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i)
    largest = max(range(4), key=squares.__getitem__)
    rows = (
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    )
    scale = 2.0 * math.sqrt(max(squares[largest], 1e-12))
    return unit([value / scale for value in rows[largest]])


VERSION = "1.19"  # QTM of 2018; later ones speak it, too
CONNECT_LIMIT_s, ANSWER_LIMIT_s, LOOK_s = 2.0, 3.0, 0.01
_PART_bytes = 65536


class QtmStream:
    """Meets BodyStream."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        """Connect and start the stream. PortMissing, BoardSilent, WrongIdentity (QTM refuses) or LinkLost."""
        self.rejected = 0
        self.name = f"qtm://{host}:{port}"
        self._clock, self._packets = clock, Packets()
        self._said: list[str] = []
        self._names: list[tuple[str, bool]] | None = None
        self._frames: list[BodyFrame] = []
        try:
            self._socket = socket.create_connection((host, port), CONNECT_LIMIT_s)
        except OSError as problem:
            raise PortMissing(
                f"{self.name}: cannot connect: {problem}; check host and port, that QTM runs, and its computer's firewall"
            ) from None
        self._socket.setblocking(False)
        try:
            self._introduce()
        except BaseException:
            self.close()
            raise

    def _introduce(self) -> None:
        self._expect("connected", "greeting")
        self._send(f"Version {VERSION}")
        self._expect("version set", "answer to the version")
        self._send("GetParameters 6D")
        self._until(lambda: self._names is not None, "names of its 6D bodies")
        self._send("StreamFrames AllFrames 6DRes")

    def _expect(self, word: str, what: str) -> None:
        self._until(lambda: any(word in said.lower() for said in self._said), what)
        self._said.clear()

    def _until(self, is_so: Callable[[], bool], what: str) -> None:
        begun_s = self._clock.now_s()
        while not is_so():
            if self._clock.now_s() - begun_s >= ANSWER_LIMIT_s:
                raise BoardSilent(f"{self.name}: no {what} within {ANSWER_LIMIT_s:g} s: is it QTM's port?")
            self._clock.wait_until_s(self._clock.now_s() + LOOK_s)
            self._frames += self._received()

    def receive(self) -> list[BodyFrame]:
        """All frames received so far. LinkLost if QTM has closed the connection."""
        frames, self._frames = self._frames + self._received(), []
        return frames

    def close(self) -> None:
        """End the stream."""
        with contextlib.suppress(OSError, LinkLost):
            self._send("StreamFrames Stop")
        self._socket.close()

    def _send(self, text: str) -> None:
        try:
            self._socket.sendall(command(text))
        except OSError as problem:
            raise LinkLost(f"{self.name}: lost: {problem}") from None

    def _received(self) -> list[BodyFrame]:
        frames: list[BodyFrame] = []
        while (part := self._part()) is not None:
            try:
                packets = self._packets.feed(part)
            except Malformed:
                raise LinkLost(f"{self.name}: sends packets of impossible sizes: is it QTM's little-endian port?") from None
            frames += [frame for kind, content in packets if (frame := self._taken(kind, content)) is not None]
        return frames

    def _part(self) -> bytes | None:
        try:
            part = self._socket.recv(_PART_bytes)
        except BlockingIOError:
            return None
        except OSError as problem:
            raise LinkLost(f"{self.name}: lost: {problem}") from None
        if not part:
            raise LinkLost(f"{self.name}: QTM has closed the connection")
        return part

    def _taken(self, kind: int, content: bytes) -> BodyFrame | None:
        """Act on a packet; returns the frame if it is one."""
        if kind == DATA and self._names is not None:
            frame = unpack_data(content, self._names)
            self.rejected += frame is None
            return frame
        if kind == XML:
            names = unpack_names(content)
            self.rejected += names is None
            self._names = self._names if names is None else names
        elif kind == COMMAND:
            self._said.append(text_of(content))
        elif kind == ERROR:
            raise WrongIdentity(f"{self.name}: QTM refuses: {text_of(content)}")
        return None
