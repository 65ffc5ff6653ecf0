"""Every kind of link keeps the same promises, the in-memory one that other tests use included."""

import itertools
import os
import pty
import socket
import time
import tty
from collections.abc import Callable, Iterator

import pytest
from can import bus as bus_of_python_can

from benchmarks.loop.memory_link import MemoryBus, byte_pair
from firmware_iface.can_link import open_can
from firmware_iface.errors import LinkError, LinkLost, PortMissing
from firmware_iface.link import ByteLink, FrameLink
from firmware_iface.serial_link import open_serial

JoinBus = Callable[[], FrameLink]
MULTICAST_GROUP = "239.74.163.77"


def has_multicast() -> bool:
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            member = socket.inet_aton(MULTICAST_GROUP) + socket.inet_aton("0.0.0.0")
            probe.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
            probe.sendto(b"", (MULTICAST_GROUP, 9))
    except OSError:
        return False
    return True


def bus_opener(kind: str) -> JoinBus:
    if kind == "memory":
        return MemoryBus().join
    if kind == "virtual":
        return lambda: open_can("virtual", f"contract-{os.getpid()}")
    if not has_multicast():
        pytest.skip("no multicast on this machine")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:  # a port of our own: tests run side by side
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    return lambda: open_can("udp_multicast", MULTICAST_GROUP, port=port)


@pytest.fixture(params=["memory", "virtual", "udp_multicast"])
def join(request: pytest.FixtureRequest) -> Iterator[JoinBus]:
    opener = bus_opener(request.param)
    opened: list[FrameLink] = []

    def join_and_note() -> FrameLink:
        opened.append(opener())
        return opened[-1]

    yield join_and_note
    for link in opened:
        link.close()


def receive(link: FrameLink, count: int) -> list[tuple[int, bytes]]:
    """`count` frames; between processes they take a moment, never a wait of ours."""
    frames: list[tuple[int, bytes]] = []
    for _ in range(100_000):
        frames += link.receive()
        if len(frames) >= count:
            break
    return frames


class TestFrameLink:
    def test_a_frame_reaches_all_others_and_not_its_sender(self, join: JoinBus) -> None:
        sender, first, second = join(), join(), join()
        sender.send(0x101, b"\x01\x02\x00")
        assert receive(first, 1) == [(0x101, b"\x01\x02\x00")]
        assert receive(second, 1) == [(0x101, b"\x01\x02\x00")]
        assert sender.receive() == []

    def test_frames_keep_their_order(self, join: JoinBus) -> None:
        sender, receiver = join(), join()
        sent = [(0x100 + number, bytes((number,))) for number in range(20)]
        for frame in sent:
            sender.send(*frame)
        assert receive(receiver, 20) == sent

    @pytest.mark.parametrize(("can_id", "payload"), [(0, b""), (0x7FF, bytes(8)), (1, b"\xff" * 8)])
    def test_every_id_and_length_arrives_as_it_was(self, join: JoinBus, can_id: int, payload: bytes) -> None:
        sender, receiver = join(), join()
        sender.send(can_id, payload)
        assert receive(receiver, 1) == [(can_id, payload)]

    def test_the_same_frame_twice_arrives_twice(self, join: JoinBus) -> None:
        sender, receiver = join(), join()
        sender.send(5, b"a")
        sender.send(5, b"a")
        assert receive(receiver, 2) == [(5, b"a")] * 2

    def test_a_frame_of_somebody_else_that_equals_ours_is_heard(self, join: JoinBus) -> None:
        ours, other = join(), join()
        ours.send(5, b"a")
        other.send(5, b"a")
        assert receive(ours, 1) == [(5, b"a")]
        assert receive(other, 1) == [(5, b"a")]

    def test_nothing_there_is_an_empty_list_at_once(self, join: JoinBus) -> None:
        assert join().receive() == []

    def test_a_closed_link_raises_LinkLost_and_closes_twice(self, join: JoinBus) -> None:
        link = join()
        link.close()
        link.close()
        with pytest.raises(LinkLost, match="CAN bus"):
            link.send(1, b"")
        with pytest.raises(LinkLost, match="CAN bus"):
            link.receive()


class PtyFarEnd:
    """The board's side of a pty."""

    def __init__(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(self.master)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(slave)
        self.slave = slave

    def read(self) -> bytes:
        try:
            return os.read(self.master, 4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def close(self) -> None:
        if self.master >= 0:
            os.close(self.master)
            os.close(self.slave)
            self.master = -1


class LoopFarEnd:
    """The far end of loop:// is the near end."""

    def __init__(self, link: ByteLink) -> None:
        self.read, self.write = link.read, link.write

    def close(self) -> None:
        pass


class SocketFarEnd:
    """The board's side of socket://."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        connection.setblocking(False)

    def read(self) -> bytes:
        try:
            return self.connection.recv(4096)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        self.connection.sendall(data)

    def close(self) -> None:
        self.connection.close()


FarEnd = PtyFarEnd | LoopFarEnd | SocketFarEnd | ByteLink


def open_pair(kind: str) -> tuple[ByteLink, FarEnd]:
    if kind == "memory":
        return byte_pair()
    if kind == "loop":
        near = open_serial("loop://", 1_000_000)
        return near, LoopFarEnd(near)
    if kind == "socket":
        with socket.create_server(("127.0.0.1", 0)) as server:
            near = open_serial(f"socket://127.0.0.1:{server.getsockname()[1]}", 1_000_000)
            return near, SocketFarEnd(server.accept()[0])
    far = PtyFarEnd()
    return open_serial(far.path, 1_000_000), far


@pytest.fixture(params=["memory", "pty", "loop", "socket"])
def ends(request: pytest.FixtureRequest) -> Iterator[tuple[ByteLink, FarEnd]]:
    near, far = open_pair(request.param)
    yield near, far
    near.close()
    far.close()


def read(end: FarEnd, count: int) -> bytes:
    received = b""
    for _ in range(100_000):
        received += end.read()
        if len(received) >= count:
            break
    return received


class TestByteLink:
    def test_all_byte_values_arrive_both_ways(self, ends: tuple[ByteLink, FarEnd]) -> None:
        near, far = ends
        near.write(bytes(range(256)))
        assert read(far, 256) == bytes(range(256))
        far.write(bytes(range(255, -1, -1)))
        assert read(near, 256) == bytes(range(255, -1, -1))

    def test_pieces_arrive_in_order(self, ends: tuple[ByteLink, FarEnd]) -> None:
        near, far = ends
        for piece in (b"a", b"bc", b"\x00", b"d"):
            far.write(piece)
        assert read(near, 5) == b"abc\x00d"

    def test_nothing_there_is_no_bytes_at_once(self, ends: tuple[ByteLink, FarEnd]) -> None:
        assert ends[0].read() == b""

    def test_a_closed_link_raises_LinkLost_and_closes_twice(self, ends: tuple[ByteLink, FarEnd]) -> None:
        near, _ = ends
        near.close()
        near.close()
        with pytest.raises(LinkLost, match="serial port"):
            near.read()
        with pytest.raises(LinkLost, match="serial port"):
            near.write(b"x")

    def test_waiting_tells_whether_there_is_something_to_read(self, ends: tuple[ByteLink, FarEnd]) -> None:
        near, far = ends
        for _ in range(2):  # what has been read wakes nobody up again
            assert not near.wait(1e-4)
            far.write(b"ab")
            assert any(near.wait(1e-3) for _ in range(100_000))
            assert near.wait(-1.0), "it is still there"
            assert read(near, 2) == b"ab"

    @pytest.mark.parametrize("ends", ["memory", "pty", "socket"], indirect=True)
    def test_a_peer_that_is_gone_is_noticed_by_reading_alone(self, ends: tuple[ByteLink, FarEnd]) -> None:
        near, far = ends
        far.close()
        with pytest.raises(LinkLost, match="lost"):
            read(near, 1)


def test_a_port_is_opened_by_one_program_only() -> None:
    far = PtyFarEnd()
    first = open_serial(far.path, 1_000_000)
    with pytest.raises(PortMissing, match="lock"):
        open_serial(far.path, 1_000_000)
    first.close()
    far.close()


@pytest.mark.parametrize("url", ["/dev/there-is-no-such-port", "nonsense://x", "socket://127.0.0.1:1"])
def test_a_port_that_is_not_there_is_one_message_with_the_ports_that_are(url: str) -> None:
    with pytest.raises(PortMissing, match=r"cannot open it.*ports? (here|are)") as caught:
        open_serial(url, 115_200)
    assert url in str(caught.value)


@pytest.mark.parametrize(
    ("interface", "channel", "remedy"),
    [
        ("nonsense", "x", "interfaces: .*socketcan"),
        ("socketcan", "can77", "ip link set can77 up type can bitrate 1000000"),
        ("slcan", "/dev/there-is-no-such-port", "ports? (here|are)"),
        ("kvaser", "0", "driver installed"),
        ("udp_multicast", "1.2.3.4", "multicast address"),
    ],
)
def test_a_bus_that_is_not_there_is_one_message_with_a_remedy(
    interface: str, channel: str, remedy: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(PortMissing, match=remedy):
        open_can(interface, channel)
    assert capfd.readouterr() == ("", "")


def test_every_baud_is_positive() -> None:
    with pytest.raises(LinkError, match="baud must be positive"):
        open_serial("loop://", 0)


def test_noise_on_the_multicast_group_is_counted_and_never_raised() -> None:
    if not has_multicast():
        pytest.skip("no multicast on this machine")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    link, friend = (open_can("udp_multicast", MULTICAST_GROUP, port=port) for _ in range(2))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"\xc1 not ours", (MULTICAST_GROUP, port))
    friend.send(3, b"ok")
    assert receive(link, 1) == [(3, b"ok")]
    link.close()
    friend.close()


def test_receiving_never_waits_when_the_time_of_day_steps_back(join: JoinBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can's recv(timeout=0) reads it twice, and waited for as long as the step."""
    here = join()
    begun_s, reads = time.monotonic(), itertools.count()
    stepped = lambda: time.monotonic() - (5.0 if next(reads) else 0.0)  # noqa: E731
    monkeypatch.setattr(bus_of_python_can, "time", stepped)
    assert here.receive() == []
    assert time.monotonic() - begun_s < 4.0
