"""What fuzzers throw bytes at: every decoder and file reader. Each takes any bytes and returns, or raises one of our errors.

Anything else that leaves a target is a finding: a crash, or a broken promise that the target checks itself.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.loop.memory_link import MemoryBus
from control.recording.frame_decoder import FrameDecoder
from control.recording.frames import stored_columns
from control.recording.record import Layout
from control.server import messages
from firmware_iface import camera
from firmware_iface.can_link import SlcanLink
from firmware_iface.encoder import wire
from firmware_iface.errors import ArmwrightError, LinkError
from firmware_iface.mocap import natnet, qtm, vicon
from firmware_iface.mocap.bodies import BodyFrame, Malformed
from firmware_iface.motor import wire as motor_wire
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import MotorBus
from tests.firmware_iface.motor_command import MotorCommand
from tests.firmware_iface.test_camera import datagram_of
from tests.fuzz.bought import BOUGHT
from tests.fuzz.readers import FILES, LINES

SENTENCE_MOST = 4000  # characters
Target = Callable[[bytes], None]


def encoder_stream(content: bytes) -> None:
    """The encoder's decoder never raises, whatever the pieces are in which bytes arrive, and finds a frame behind them."""
    whole, pieces = wire.Decoder(), wire.Decoder()
    at_once = whole.feed(content)
    assert [frame for k in range(len(content)) for frame in pieces.feed(content[k : k + 1])] == at_once
    behind = wire.Poll(7)
    assert pieces.feed(b"\x00" + wire.encode(behind))[-1:] == [behind]


def cobs_block(content: bytes) -> None:
    """COBS returns None for what is no block."""
    decoded = wire.cobs_decode(content)
    assert decoded is None or len(decoded) <= len(content)


def motor_frames(content: bytes) -> None:
    """A motor board's payloads, and any frames on its bus: a board that is not there is never believed."""
    if len(content) == 8:
        for kind in (MotorCommand, motor_wire.ParameterRequest, motor_wire.ParameterAnswer):
            with contextlib.suppress(ValueError):  # a mode or an operation that there is not
                assert kind.unpack(content).pack()
    memory, clock = MemoryBus(), _Still()
    ours, theirs = memory.join(), memory.join()
    bus = MotorBus(ours, clock)
    board = MotorBoard(bus, 1)
    for can_id, payload in _frames(content):
        theirs.send(can_id, payload)
    for _ in range(len(content) + 1):
        with contextlib.suppress(LinkError):
            board.command_voltage(0.1)
            bus.update()
    assert board.state is None or board.state.name


def _frames(content: bytes) -> Iterator[tuple[int, bytes]]:
    """An id, a length and a payload, again and again; ids are often those of the board."""
    at = 0
    while at + 2 <= len(content):
        base = (motor_wire.REPLY_ID, motor_wire.PARAMETER_ANSWER_ID, motor_wire.EMERGENCY_STOP_ID, 0x7E0)
        yield base[content[at] & 3] + (content[at] >> 2) % 3, content[at + 2 : at + 2 + content[at + 1] % 9]
        at += 2 + content[at + 1] % 9


class _Still:
    def now_s(self) -> float:
        return 0.0

    def wait_until_s(self, t: float) -> None:
        pass


class _Line:
    """A serial line with some bytes on it."""

    name = "line"

    def __init__(self, content: bytes) -> None:
        self.content = content

    def read(self) -> bytes:
        taken, self.content = self.content, b""
        return taken

    def write(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        pass


def slcan_line(content: bytes) -> None:
    """What an slcan adapter says is frames of at most 8 bytes, whatever the pieces are; a good one behind it is found."""
    line = _Line(content)
    link = SlcanLink(line, "slcan", 1_000_000)
    whole = link.receive()
    assert all(can_id < 0x800 and len(payload) <= 8 for can_id, payload in whole)
    line.content = b"\rt1812AABB\r"
    assert link.receive()[-1:] == [(0x181, b"\xaa\xbb")]


def camera_datagram(content: bytes) -> None:
    """A datagram is a frame that packs to itself, or nothing."""
    frame = camera.unpack(content)
    assert frame is None or datagram_of(frame) == content


def vicon_datagram(content: bytes) -> None:
    """A packet of the object stream has finite poses, or is refused."""
    _is_sound(vicon.unpack(content))


def natnet_packet(content: bytes) -> None:
    """What a NatNet server says, as any of its messages and in any version, is read or refused."""
    payload = (natnet.message_of(content) or (0, content))[1]
    natnet.unpack_server(payload)
    for version in ((3, 0), (4, 0), (4, 1), (4, 2)):
        names = natnet.unpack_models(payload, version)
        _is_sound(natnet.unpack_frame(payload, version, names or {}))


def qtm_stream(content: bytes) -> None:
    """What QTM sends is cut into packets that are read or refused; a size that no packet has ends it."""
    _is_sound(qtm.unpack_data(content, [("a", True)]))
    qtm.unpack_names(content)
    with contextlib.suppress(Malformed):
        whole = qtm.Packets().feed(content)
        pieces = qtm.Packets()
        assert [packet for k in range(len(content)) for packet in pieces.feed(content[k : k + 1])] == whole


def _is_sound(frame: BodyFrame | None) -> None:
    """Positions within a kilometre, unit quaternions, one body a name."""
    for body in frame.bodies if frame is not None else ():
        if body.is_visible:
            assert max(map(abs, body.pose.position_m)) <= 1000.0
            assert abs(math.hypot(*body.pose.quaternion) - 1.0) < 1e-6


def socket_line(content: bytes) -> None:
    """A line of the socket is a request of a known type, or an ArmError."""
    messages.is_at_once(content)
    messages.decoded(messages.asked(content))


def recording_frames(content: bytes) -> None:
    """Frames of a recording, read without their file."""
    layout = Layout.of(1)
    decoder = FrameDecoder(stored_columns(layout.names, layout.codes, (1e-4,)), layout.names, layout.packing)
    rows, used = decoder.rows(content)
    assert len(rows) % layout.packing.size == 0
    assert used <= len(content)


def _of_file(name: str) -> Target:
    def read(content: bytes) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            path.write_bytes(content)
            FILES[name](path)

    return read


DECODERS: dict[str, Target] = {
    "encoder": encoder_stream,
    "cobs": cobs_block,
    "motor": motor_frames,
    "slcan": slcan_line,
    "camera": camera_datagram,
    "vicon": vicon_datagram,
    "natnet": natnet_packet,
    "qtm": qtm_stream,
    "socket": socket_line,
    "recording frames": recording_frames,
    **BOUGHT,
    **LINES,
}
TARGETS: dict[str, Target] = {**DECODERS, **{name: _of_file(name) for name in FILES}}


def is_survived(name: str, content: bytes) -> bool:
    """Run a target: True if it took the bytes, False if it refused them in one sentence. What else it raises is passed on."""
    try:
        TARGETS[name](content)
    except ArmwrightError as error:
        text = str(error)
    else:
        return True
    if not 0 < len(text) < SENTENCE_MOST:
        raise ValueError(f"{name}: an error of {len(text)} characters")
    return False
