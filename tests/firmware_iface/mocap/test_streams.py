"""NatNet and QTM: golden packets, versions, what is refused, and conversations with servers that are silent, old or gone."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from dataclasses import replace

import pytest

from firmware_iface.errors import BoardSilent, LinkLost, PortMissing, WrongIdentity
from firmware_iface.mocap import natnet, qtm
from firmware_iface.mocap.bodies import Malformed, angle_rad
from firmware_iface.mocap.natnet import KEEP_ALIVE_s, NatNetStream
from firmware_iface.mocap.qtm import QtmStream
from hil_mocks.devices.cameras import CameraSetup, MocapMock, NatNetMock, QtmMock, SceneSetup
from hil_mocks.wires import CameraWire, Commands, OneClientServer, free_udp_port
from tests.firmware_iface.mocap.standing import Standing

ARM = Standing((0.5, 0.1, 0.3), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
SETUP = CameraSetup(noise_m=0.0)
SCENE = SceneSetup("tool", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)
NAMES = {11: "tool"}
# Frame 7: one body, id 11, at (0.5, -0.25, 0.125) m, quaternion (0, 0, 0, 1), mean error 0.25 m, tracked; 1.5 s.
_BODY = "0b000000 0000003f 000080be 0000003e 00000000 00000000 00000000 0000803f 0000803e 0100"
_NONE, _END = "00000000", "00000000 00000000 000000000000f83f"
NATNET_3 = bytes.fromhex(f"07000000 {_NONE * 2} 01000000 {_BODY} {_NONE * 4} {_END} 0000")
NATNET_41 = bytes.fromhex(f"07000000 {_NONE * 4} 01000000 26000000 {_BODY} {_NONE * 10} {_END} 00000000 00000000")
# Time 1.5 s, frame 7, one component of 68 bytes: one body at (500, -250, 125) mm, turned by +90 deg about z, residual 0.25 mm.
QTM = bytes.fromhex(
    "60e3160000000000 07000000 01000000 44000000 0b000000 01000000 0000 0000"
    "0000fa43 00007ac3 0000fa42 00000000 0000803f 00000000 000080bf 00000000 00000000 00000000 00000000 0000803f 0000803e"
)


@pytest.mark.parametrize(("payload", "version"), [(NATNET_3, (3, 0)), (NATNET_3, (4, 0)), (NATNET_41, (4, 1))])
def test_the_golden_frame_of_natnet_is_read(payload: bytes, version: tuple[int, int]) -> None:
    frame = natnet.unpack_frame(payload, version, NAMES)
    assert frame is not None
    (body,) = frame.bodies
    assert (frame.number, frame.time_s, body.name, body.error_m) == (7, 1.5, "tool", 0.25)
    assert (body.pose.position_m, body.pose.quaternion) == ((0.5, -0.25, 0.125), (1.0, 0.0, 0.0, 0.0))
    hidden = natnet.unpack_frame(payload.replace(b"\x80\x3e\x01\x00", b"\x80\x3e\x00\x00"), version, {})
    assert hidden is not None
    assert (hidden.bodies[0].name, hidden.bodies[0].is_visible) == ("11", False)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        NATNET_41[:-12],
        NATNET_41.replace(struct.pack("<i", 38), struct.pack("<i", 39)),
        NATNET_41.replace(b"\x00\x00\x80\x3f", b"\x00\x00\x00\x40"),
        NATNET_41.replace(struct.pack("<f", 0.5), struct.pack("<f", 1e6)),
        struct.pack("<ii", 7, -1) + NATNET_41[8:],
    ],
    ids=["empty", "short", "size", "no quaternion", "far", "negative count"],
)
def test_what_is_no_frame_of_natnet_is_refused(payload: bytes) -> None:
    assert natnet.unpack_frame(payload, (4, 1), NAMES) is None


def test_other_things_in_a_frame_are_passed_over_in_both_layouts() -> None:
    skeleton = struct.pack("<iii", 1, 5, 1) + bytes(38)
    plate = struct.pack("<iii", 1, 5, 1) + struct.pack("<if", 1, 2.0)
    marker = struct.pack("<i", 1) + bytes(26)
    old = NATNET_3[: -18 - 16] + skeleton + marker + plate + plate + NATNET_3[-18:]
    assert natnet.unpack_frame(old, (3, 1), NAMES) == natnet.unpack_frame(NATNET_3, (3, 1), NAMES)


def test_the_golden_data_packet_of_qtm_is_read() -> None:
    frame = qtm.unpack_data(QTM, [("tool", True)])
    assert frame is not None
    (body,) = frame.bodies
    assert (frame.number, frame.time_s, body.name, body.error_m) == (7, 1.5, "tool", 0.00025)
    assert body.pose.position_m == (0.5, -0.25, 0.125)
    assert angle_rad(body.pose.quaternion, (0.5**0.5, 0.0, 0.0, 0.5**0.5)) < 1e-6
    assert qtm.unpack_data(QTM, [("other", False), ("tool", True)]) == frame  # not enabled: not sent
    lost = qtm.unpack_data(QTM[:32] + b"\x00\x00\xc0\x7f" + QTM[36:], [("tool", True)])
    assert lost is not None
    assert not lost.bodies[0].is_visible


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (b"", ["tool"]),
        (QTM[:-1], ["tool"]),
        (QTM + b"\0", ["tool"]),
        (QTM, ["tool", "base"]),
        (QTM.replace(struct.pack("<I", 68), struct.pack("<I", 69)), ["tool"]),
        (QTM[:20] + b"\x05" + QTM[21:], ["tool"]),
        (QTM.replace(b"\x00\x00\x80\xbf", b"\x00\x00\x80\x3f"), ["tool"]),
        (QTM.replace(b"\x00\x00\xfa\x43", struct.pack("<f", 1e9)), ["tool"]),
    ],
    ids=["empty", "short", "long", "names", "size", "no bodies", "no rotation", "far"],
)
def test_what_is_no_data_packet_of_qtm_is_refused(content: bytes, names: list[str]) -> None:
    assert qtm.unpack_data(content, [(name, True) for name in names]) is None


def test_names_come_from_xml_without_document_types() -> None:
    body = "<Body><Name>{}</Name><Enabled>{}</Enabled><Mesh><Name/></Mesh></Body>"
    xml = f"<Q><The_6D><Bodies>2</Bodies>{body.format('a', 'True')}{body.format('b', 'false')}</The_6D></Q>"
    assert qtm.unpack_names(xml.encode() + b"\0") == [("a", True), ("b", False)]
    for wrong in ("", "<Q>", "<!DOCTYPE Q>" + xml, xml.replace("<Name>a</Name>", "<Name/>")):
        assert qtm.unpack_names(wrong.encode()) is None


def test_packets_of_qtm_are_cut_however_they_arrive() -> None:
    stream = qtm.command("a") + qtm.command("bc")
    packets = qtm.Packets()
    found = [packet for k in range(len(stream)) for packet in packets.feed(stream[k : k + 1])]
    assert found == [(1, b"a\0"), (1, b"bc\0")] == qtm.Packets().feed(stream)
    with pytest.raises(Malformed):
        qtm.Packets().feed(struct.pack("<II", 7, 1))


class Served:
    """A clock whose waiting lets a server answer; `change` may rewrite its packets."""

    def __init__(self, wire: CameraWire, mock: MocapMock, change: Callable[[bytes], bytes] = lambda p: p) -> None:
        self.wire, self.mock, self.change, self.time_s, self.requests = wire, mock, change, 0.0, [b""]

    def now_s(self) -> float:
        return self.time_s

    def wait_until_s(self, t: float) -> None:
        self.time_s = t
        for request in self.wire.received():
            self.requests.append(request)
            for answer in self.mock.answer(request):
                self.wire.send(self.change(answer))
        for packet in self.mock.tick(t, ARM):
            self.wire.send(packet)


def test_natnet_is_asked_for_names_and_hears_of_us_once_a_second() -> None:
    wire = Commands()
    clock = Served(wire, NatNetMock(SETUP, SCENE))
    stream = NatNetStream("127.0.0.1", wire.port, clock)
    clock.wait_until_s(clock.time_s + 2 * KEEP_ALIVE_s)
    assert {body.name for body in stream.receive()[-1].bodies} == {"tool", "wand", "base"}
    clock.wait_until_s(clock.time_s + 0.1)
    assert clock.requests[-1] == struct.pack("<HH", 10, 0)
    assert stream.rejected == 0
    stream.close()
    wire.close()


def test_a_body_that_was_made_meanwhile_gets_its_name() -> None:
    wire, mock = Commands(), NatNetMock(SETUP, SCENE)
    clock = Served(wire, mock)
    stream = NatNetStream("127.0.0.1", wire.port, clock)
    mock.scene = replace(mock.scene, body="gripper")
    stream._names = {}
    for _ in range(3):
        clock.wait_until_s(clock.time_s + KEEP_ALIVE_s)
        frames = stream.receive()
    assert "gripper" in {body.name for body in frames[-1].bodies}
    stream.close()
    wire.close()


def test_a_multicast_server_is_listened_to_on_its_group() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        sender.bind(("127.0.0.1", 0))
        group = "239.255.42.98"
        wire = Commands()
        port = free_udp_port()

        def multicast(packet: bytes) -> bytes:
            is_info = packet[:2] == b"\x01\x00"
            tail = struct.pack("<HB4B", port, 1, *map(int, group.split(".")))
            return packet[:-7] + tail if is_info else packet

        clock = Served(wire, NatNetMock(SETUP, SCENE), multicast)
        stream = NatNetStream("127.0.0.1", wire.port, clock)
        stream.receive()
        payload = struct.pack("<HH", 7, len(NATNET_41)) + NATNET_41
        sender.sendto(payload, (group, port))
        assert [frame.number for frame in stream.receive()] == [7]
        stream.close()
        wire.close()


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda p: b"", BoardSilent, "no answer within 2 s; check host and port"),
        (lambda p: p.replace(bytes((4, 1, 0, 0)), bytes((2, 9, 0, 0))), WrongIdentity, "speaks NatNet 2.9, expected 3.0"),
        (lambda p: p if p[0] == 1 else p[:-1], BoardSilent, "rigid bodies are called"),
    ],
)
def test_a_natnet_server_that_does_not_fit_is_one_message(
    change: Callable[[bytes], bytes], error: type[Exception], said: str
) -> None:
    wire = Commands()
    with pytest.raises(error, match=said):
        NatNetStream("127.0.0.1", wire.port, Served(wire, NatNetMock(SETUP, SCENE), change))
    wire.close()


def test_qtm_streams_after_its_names_are_known_and_is_said_to_be_gone() -> None:
    wire = OneClientServer()
    clock = Served(wire, QtmMock(SETUP, SCENE))
    stream = QtmStream("127.0.0.1", wire.port, clock)
    clock.wait_until_s(clock.time_s + 0.1)
    clock.wait_until_s(clock.time_s + 0.1)
    assert {body.name for body in stream.receive()[-1].bodies} == {"tool", "wand", "base"}
    assert stream.rejected == 0
    wire.close()
    with pytest.raises(LinkLost, match="closed the connection"):
        stream.receive()
    stream.close()
    with pytest.raises(PortMissing, match="check host and port, that QTM runs"):
        QtmStream("127.0.0.1", wire.port, clock)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda p: b"", BoardSilent, "no greeting within 3 s: is it QTM's port"),
        (lambda p: p.replace(b"\x01\0\0\0Version", b"\0\0\0\0Version"), WrongIdentity, "QTM refuses: Version set"),
        (lambda p: p.replace(b"<The_6D>", b"<The_9D>"), BoardSilent, "names of its 6D bodies"),
        (lambda p: b"HTTP/1.1 400 Bad Request", LinkLost, "impossible sizes"),
    ],
)
def test_a_qtm_server_that_does_not_fit_is_one_message(
    change: Callable[[bytes], bytes], error: type[Exception], said: str
) -> None:
    wire = OneClientServer()
    with pytest.raises(error, match=said):
        QtmStream("127.0.0.1", wire.port, Served(wire, QtmMock(SETUP, SCENE), change))
    wire.close()
