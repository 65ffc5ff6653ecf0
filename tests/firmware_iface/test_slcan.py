"""slcan on a pty: our link and python-can's own, as a witness, on two adapters of one bus."""

from __future__ import annotations

import os
import pty
import select
import tty
from collections.abc import Iterator

import can
import pytest

from firmware_iface.can_link import open_can
from firmware_iface.errors import PortMissing
from firmware_iface.link import FrameLink
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import MotorBus
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.motor.wire import MotorParameter
from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.devices.motor_inputs import MotorBoardSetup

PATIENCE_S = 10.0
OPENING = 5  # lines: two empty ones, C, S8, O


class Adapters:
    """Adapters of one bus, as their makers describe them: CR after each command that was done, z for a frame that was sent."""

    def __init__(self, count: int) -> None:
        self.ends = [pty.openpty() for _ in range(count)]
        for master, slave in self.ends:
            tty.setraw(slave)
            os.set_blocking(master, False)
        self.heard: list[list[str]] = [[] for _ in self.ends]
        self._rests = [""] * count

    def path(self, at: int) -> str:
        return os.ttyname(self.ends[at][1])

    def carry(self, at: int, lines: int) -> None:
        """Put frames on the bus until this adapter has heard so many lines in all, however late the kernel is."""
        master = self.ends[at][0]
        while len(self.heard[at]) < lines:
            assert select.select([master], [], [], PATIENCE_S)[0], self.heard[at]
            *ended, self._rests[at] = (self._rests[at] + os.read(master, 65536).decode()).split("\r")
            for line in ended:
                self.heard[at].append(line)
                is_frame = line[:1] == "t"
                os.write(master, b"z\r" if is_frame else b"\r")
                for other, (end, _) in enumerate(self.ends):
                    if is_frame and other != at:
                        os.write(end, line.encode() + b"\r")

    def say(self, at: int, text: bytes) -> None:
        os.write(self.ends[at][0], text)

    def close(self) -> None:
        for ends in self.ends:
            for end in ends:
                os.close(end)


@pytest.fixture
def adapters() -> Iterator[Adapters]:
    opened = Adapters(2)
    yield opened
    opened.close()


@pytest.fixture
def link(adapters: Adapters) -> Iterator[FrameLink]:
    opened = open_can("slcan", adapters.path(0))
    adapters.carry(0, OPENING)
    yield opened
    opened.close()


def received(link: FrameLink, count: int) -> list[tuple[int, bytes]]:
    """`count` frames; the kernel may take a moment to hand over what a pty holds."""
    frames: list[tuple[int, bytes]] = []
    for _ in range(100_000):
        frames += link.receive()
        if len(frames) >= count:
            break
    return frames


def test_the_adapter_is_closed_set_and_opened(adapters: Adapters, link: FrameLink) -> None:
    assert [line for line in adapters.heard[0] if line] == ["C", "S8", "O"]
    link.close()
    adapters.carry(0, OPENING + 1)
    assert adapters.heard[0][-1] == "C"


def test_pythons_can_understands_what_we_send_and_we_what_it_sends(adapters: Adapters, link: FrameLink) -> None:
    witness = can.Bus(interface="slcan", channel=adapters.path(1), bitrate=1_000_000, sleep_after_open=0.0, ignore_config=True)
    adapters.carry(1, len(["C", "S8", "dbitrate", "O", "O"]))
    link.send(0x101, bytes.fromhex("0f2920d1ffff0000"))
    link.send(0x000, b"\x00")
    adapters.carry(0, OPENING + 2)
    messages = [message for _ in range(40) if (message := witness.recv(0.01)) is not None]
    assert [(m.arbitration_id, bytes(m.data)) for m in messages] == [(0x101, bytes.fromhex("0f2920d1ffff0000")), (0x000, b"\x00")]
    witness.send(can.Message(arbitration_id=0x181, data=b"\x37\x29", is_extended_id=False))
    adapters.carry(1, 6)
    assert received(link, 1) == [(0x181, b"\x37\x29")]
    witness.shutdown()


def test_acknowledgements_between_frames_hold_up_nothing(adapters: Adapters, link: FrameLink) -> None:
    adapters.say(0, b"z\rz\rt1812AABB\rz\r\at1822CCDD\rt18")
    assert received(link, 2) == [(0x181, b"\xaa\xbb"), (0x182, b"\xcc\xdd")]
    adapters.say(0, b"31EE\r")
    assert received(link, 1) == [(0x183, b"\xee")]


class _Behind:
    """Our link and a clock in one, with a motor board behind the adapter: waiting carries what was sent, and the replies."""

    name = "slcan"

    def __init__(self, adapters: Adapters, link: FrameLink, board: MotorBoardMock) -> None:
        self._adapters, self._link, self._board = adapters, link, board
        self._now_s, self._sent, self._done = 0.0, 0, 0

    def send(self, can_id: int, payload: bytes) -> None:
        self._sent += 1
        self._link.send(can_id, payload)

    def receive(self) -> list[tuple[int, bytes]]:
        return self._link.receive()

    def close(self) -> None:
        self._link.close()

    def now_s(self) -> float:
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        self._now_s = t
        self._adapters.carry(0, OPENING + self._sent)
        self._board.tick(t, 0.0, 24.0, False)
        for line in self._adapters.heard[0][OPENING + self._done :]:
            for can_id, payload in self._board.receive(int(line[1:4], 16), bytes.fromhex(line[5:]), t):
                self._adapters.say(0, b"t%03X%d%s\r" % (can_id, len(payload), payload.hex().upper().encode()))
        self._done = self._sent


def test_a_motor_board_behind_an_adapter_is_read_and_commanded(adapters: Adapters, link: FrameLink) -> None:
    mock = MotorBoardMock(MotorBoardSetup(node=2, serial_number=77, counts_per_turn=2048), lambda: 0)
    clock = _Behind(adapters, link, mock)
    clock.wait_until_s(0.001)
    bus = MotorBus(clock, clock)
    board = MotorBoard(bus, 2)
    assert board.read(MotorParameter.BOARD_SERIAL_NUMBER) == 77
    for cycle in range(20):
        board.command_off()
        clock.wait_until_s(1.0 + 0.002 * cycle)
        bus.update()
    assert board.state is DriveState.SWITCH_ON_DISABLED


def test_what_is_no_data_frame_is_dropped(adapters: Adapters, link: FrameLink) -> None:
    adapters.say(0, b"T000001811AA\rr1812\rt1819AA\rt1812AA\rnoise\xff\rt1811AA12\r" + b"x" * 5000)
    assert received(link, 1) == [(0x181, b"\xaa")]
    adapters.say(0, b"\rt1821BB\r")
    assert received(link, 1) == [(0x182, b"\xbb")]


def test_wrong_bit_rates_and_options_say_what_there_is(adapters: Adapters) -> None:
    with pytest.raises(PortMissing, match=r"slcan knows 10000, .* 1000000"):
        open_can("slcan", adapters.path(0), 123_456)
    with pytest.raises(PortMissing, match="unknown option rtscts; slcan takes tty_baudrate"):
        open_can("slcan", adapters.path(0), rtscts=True)
    with pytest.raises(PortMissing, match="cannot open it"):
        open_can("slcan", "/dev/ttyNONE9")
