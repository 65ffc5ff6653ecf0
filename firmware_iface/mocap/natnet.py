"""OptiTrack's Motive by NatNet: asks the server what it is and what its bodies are called, then receives frames.

Unicast frames come to the port from which the server was asked, as long as it hears from us; multicast ones to a group's
port, which the server names. Motive's y axis points up unless its streaming settings say z.

Packets, of protocol 3.0 to 4.x (NatNet SDK: NatNetTypes.h and its depacketization samples); little endian. Each: message id
u16, bytes that follow u16, payload. Text is zero-terminated.

    server info   name 256 bytes, version of the program 4 x u8, of NatNet 4 x u8, ticks per second u64, data port u16,
                  is multicast u8, group 4 x u8
    model def     count i32, each: kind i32 (from 4.1: its size i32), description. Kind 1, a rigid body: name, id i32,
                  parent i32, offset 3 f32 (from 4.2: quaternion 4 f32), markers i32, each 3 f32, each label i32 (from 4.0:
                  each its name)
    frame         number i32; marker sets, other markers, rigid bodies, skeletons, (from 4.1: assets,) labelled markers, force
                  plates, devices, each a count i32 (from 4.1: and a size i32); timecode 2 x u32, time f64 [s]; more, not used
    rigid body    id i32, x y z f32 [m], qx qy qz qw f32, mean error of its markers f32 [m], flags u16 (bit 0: tracked)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from struct import Struct

from firmware_iface.camera import UdpListener
from firmware_iface.clock import Clock
from firmware_iface.errors import BoardSilent, WrongIdentity
from firmware_iface.mocap.bodies import NOWHERE, BodyFrame, FARTHEST_m, Fields, Malformed, RigidPose, SeenBody, unit

CONNECT, SERVER_INFO, REQUEST_MODELS, MODELS, FRAME, KEEP_ALIVE = 0, 1, 4, 5, 7, 10
Version = tuple[int, int]
OLDEST, NEWEST_MAJOR = (3, 0), 4
_HEADER, _COUNT, _POINT, _QUATERNION = Struct("<HH"), Struct("<i"), Struct("<3f"), Struct("<4f")
_SERVER = Struct("<256s4B4BQHB4B")
_BODY = Struct("<i3f4ffH")
_LABELLED_bytes = 26
_IDS, _TIME = Struct("<ii"), Struct("<IId")
_RIGID_BODY = 1
_TRACKED = 1


@dataclass(frozen=True, slots=True)
class NatNetServer:
    """What a server says of itself; group is empty for unicast."""

    program: str
    version: Version
    data_port: int
    group: str


def request(message: int, text: str = "") -> bytes:
    """A client's packet."""
    payload = text.encode() + b"\0" if text else b""
    return _HEADER.pack(message, len(payload)) + payload


def message_of(packet: bytes) -> tuple[int, bytes] | None:
    """Message id and payload; None if the lengths disagree."""
    if len(packet) < _HEADER.size:
        return None
    message, size = _HEADER.unpack_from(packet)
    return (message, packet[_HEADER.size :]) if size == len(packet) - _HEADER.size else None


def unpack_server(payload: bytes) -> NatNetServer | None:
    """A server info, or None."""
    if len(payload) < _SERVER.size:
        return None
    name, *numbers = _SERVER.unpack_from(payload)
    data_port, is_multicast = numbers[9], numbers[10]
    group = ".".join(map(str, numbers[11:])) if is_multicast else ""
    program = name.split(b"\0", 1)[0].decode(errors="replace")
    return NatNetServer(program, (numbers[4], numbers[5]), data_port, group)


def unpack_models(payload: bytes, version: Version) -> dict[int, str] | None:
    """Names of the rigid bodies by their ids, or None. Before 4.1 rigid bodies come before all that has no size."""
    fields, names = Fields(payload), dict[int, str]()
    try:
        for _ in range(fields.count()):
            (kind,) = fields.read(_COUNT)
            size = _size(fields) if version >= (4, 1) else None
            begin = fields.at
            if kind == _RIGID_BODY:
                number, name = _description(fields, version)
                names[number] = name
            elif size is None and kind == 0:
                _skip_marker_set(fields)
            elif size is None:
                return names
            if size is not None:
                fields.skip(begin + size - fields.at)
    except Malformed:
        return None
    return names


def _description(fields: Fields, version: Version) -> tuple[int, str]:
    name = fields.name()
    number, _ = fields.read(_IDS)
    fields.read(_POINT)
    if version >= (4, 2):
        fields.read(_QUATERNION)
    markers = fields.count()
    fields.skip(markers * (_POINT.size + _COUNT.size))
    for _ in range(markers if version >= (4, 0) else 0):
        fields.name()
    return int(number), name


def _skip_marker_set(fields: Fields) -> None:
    fields.name()
    for _ in range(fields.count()):
        fields.name()


def unpack_frame(payload: bytes, version: Version, names: Mapping[int, str]) -> BodyFrame | None:
    """The rigid bodies of a frame, or None; one without a name is called by its id."""
    fields = Fields(payload)
    try:
        (number,) = fields.read(_COUNT)
        _skip_set(fields, version, _skip_marker_set_of_frame)
        _skip_set(fields, version, lambda one: one.skip(_POINT.size))
        bodies = _bodies(fields, version, names)
        _skip_rest(fields, version)
        *_, time_s = fields.read(_TIME)
    except Malformed:
        return None
    if len({body.name for body in bodies}) < len(bodies):
        return None
    return BodyFrame(int(number) & 0xFFFFFFFF, bodies, time_s)


def _bodies(fields: Fields, version: Version, names: Mapping[int, str]) -> tuple[SeenBody, ...]:
    count = fields.count()
    if version >= (4, 1) and _size(fields) != count * _BODY.size:
        raise Malformed
    return tuple(_body(fields, names) for _ in range(count))


def _body(fields: Fields, names: Mapping[int, str]) -> SeenBody:
    number, x, y, z, qx, qy, qz, qw, error_m, flags = fields.read(_BODY, is_finite=False)
    name = names.get(int(number), str(int(number)))
    if not int(flags) & _TRACKED:
        return SeenBody(name, NOWHERE, is_visible=False)
    quaternion = unit((qw, qx, qy, qz))
    if quaternion is None or not max(abs(x), abs(y), abs(z)) <= FARTHEST_m:
        raise Malformed
    return SeenBody(name, RigidPose((x, y, z), quaternion), True, error_m)


def _skip_marker_set_of_frame(fields: Fields) -> None:
    fields.name()
    fields.skip(_POINT.size * fields.count())


def _skip_skeleton(fields: Fields) -> None:
    fields.skip(_COUNT.size)
    fields.skip(_BODY.size * fields.count())


def _skip_channels(fields: Fields) -> None:
    fields.skip(_COUNT.size)
    for _ in range(fields.count()):
        fields.skip(4 * fields.count())


def _skip_rest(fields: Fields, version: Version) -> None:
    """Skeletons, assets (which only later versions have, with a size), labelled markers, force plates, devices."""
    _skip_set(fields, version, _skip_skeleton)
    if version >= (4, 1):
        _skip_set(fields, version, Fields.name)
    _skip_set(fields, version, lambda one: one.skip(_LABELLED_bytes))
    _skip_set(fields, version, _skip_channels)
    _skip_set(fields, version, _skip_channels)


def _skip_set(fields: Fields, version: Version, skip_one: Callable[[Fields], object]) -> None:
    """Pass over items of a kind: by their size where the version says it, else one by one."""
    count = fields.count()
    if version >= (4, 1):
        fields.skip(_size(fields))
        return
    for _ in range(count):
        skip_one(fields)


def _size(fields: Fields) -> int:
    (size,) = fields.read(_COUNT)
    return int(size)


ANSWER_LIMIT_s, LOOK_s = 2.0, 0.01
KEEP_ALIVE_s = 1.0  # Motive forgets a silent client after some seconds


class NatNetStream:
    """Meets BodyStream."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        """Ask the server. PortMissing, BoardSilent if nothing answers, WrongIdentity for a protocol that is not 3 or 4."""
        self.rejected = 0
        self._clock, self._server_port = clock, port
        self._commands = UdpListener("NatNet", 0, host)
        self._data: UdpListener | None = None
        self.name = f"natnet://{host}:{port}"
        self._server: NatNetServer | None = None
        self._names: dict[int, str] | None = None
        self._frames: list[BodyFrame] = []
        self._spoke_s = clock.now_s()
        try:
            self._introduce()
        except BaseException:
            self.close()
            raise

    def _introduce(self) -> None:
        self._ask(request(CONNECT, "Ping"))
        if not self._wait(lambda: self._server is not None) or self._server is None:
            raise BoardSilent(
                f"{self.name}: no answer within {ANSWER_LIMIT_s:g} s; check host and port, that Motive streams"
                " (Streaming > NatNet), and its computer's firewall"
            )
        server = self._server
        if server.version < OLDEST or server.version[0] > NEWEST_MAJOR:
            version = ".".join(map(str, server.version))
            raise WrongIdentity(f"{self.name}: {server.program} speaks NatNet {version}, expected 3.0 to {NEWEST_MAJOR}.x")
        if server.group:
            self._data = UdpListener("NatNet", server.data_port, self._commands.sender, group=server.group)
        self._ask(request(REQUEST_MODELS))
        if not self._wait(lambda: self._names is not None):
            raise BoardSilent(f"{self.name}: does not say what its rigid bodies are called")

    def _wait(self, is_so: Callable[[], bool]) -> bool:
        begun_s = self._clock.now_s()
        while not is_so() and self._clock.now_s() - begun_s < ANSWER_LIMIT_s:
            self._clock.wait_until_s(self._clock.now_s() + LOOK_s)
            self._frames += self._received()
        return is_so()

    def receive(self) -> list[BodyFrame]:
        """All frames received so far; keeps the server sending, and asks for names that are not known."""
        frames, self._frames = self._frames + self._received(), []
        now_s = self._clock.now_s()
        if now_s - self._spoke_s >= KEEP_ALIVE_s:
            self._ask(request(KEEP_ALIVE))
            if frames and any(body.name.isdigit() for body in frames[-1].bodies):
                self._ask(request(REQUEST_MODELS))  # bodies that were made meanwhile
        return frames

    def _ask(self, packet: bytes) -> None:
        self._spoke_s = self._clock.now_s()
        self._commands.send(packet, self._server_port)

    def _received(self) -> list[BodyFrame]:
        frames = [self._taken(packet) for packet in self._commands.datagrams()]
        if self._data is not None:
            frames += [self._taken(packet) for packet in self._data.datagrams()]
        return [frame for frame in frames if frame is not None]

    def _taken(self, packet: bytes) -> BodyFrame | None:
        """Act on a packet; returns the frame if it is one. What cannot be read is counted."""
        message, payload = message_of(packet) or (None, b"")
        if message == SERVER_INFO and (server := unpack_server(payload)) is not None:
            self._server = server
        elif message == MODELS and self._server is not None:
            names = unpack_models(payload, self._server.version)
            self.rejected += names is None
            self._names = self._names if names is None else names
        elif message == FRAME and self._server is not None and self._names is not None:
            frame = unpack_frame(payload, self._server.version, self._names)
            self.rejected += frame is None
            return frame
        elif message is None:
            self.rejected += 1
        return None

    def close(self) -> None:
        """End the stream."""
        self._commands.close()
        if self._data is not None:
            self._data.close()
