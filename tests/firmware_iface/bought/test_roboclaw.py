"""RoboClaw's packet serial: bytes, answers that are wrong, late or missing, and a board that is not what it should be."""

import struct
from pathlib import Path

import pytest

from benchmarks.loop.memory_link import MemoryByteLink, byte_pair
from firmware_iface import roboclaw
from firmware_iface.errors import BoardReset, BoardSilent, MisuseError, WrongIdentity
from firmware_iface.roboclaw import ANSWER_TIMEOUT_s, PacketLine, RoboClaw, RoboclawCommand, RoboclawStatus
from hil_mocks.devices.roboclaw import RATES, TIMEOUT, RoboClawLineMock, RoboClawMock

GOLDEN = Path(__file__).parents[2] / "golden" / "roboclaw.txt"
ROWS = [[cell.strip() for cell in line.split("|")] for line in GOLDEN.read_text().splitlines() if not line.startswith("#")]


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_packets_are_those_of_the_manual(row: list[str]) -> None:
    _, address, command, data, packet = row
    made = roboclaw.command_packet(int(address, 16), int(command), bytes.fromhex(data))
    assert made == bytes.fromhex(packet)


def test_any_single_flipped_bit_of_an_answer_is_rejected() -> None:
    mock = RoboClawMock(0x80, lambda channel: (12345, -67)[channel])
    mock.obey(roboclaw.command_packet(0x80, RoboclawCommand.SET_ENCODER_1, bytes(4)), 0.0)
    answer = mock.obey(roboclaw.read_packet(0x80, RoboclawCommand.READ_ENCODERS), 0.0)
    assert roboclaw.reply_data(0x80, RoboclawCommand.READ_ENCODERS, answer) is not None
    for bit in range(8 * len(answer)):
        flipped = bytearray(answer)
        flipped[bit // 8] ^= 1 << bit % 8
        assert roboclaw.reply_data(0x80, RoboclawCommand.READ_ENCODERS, bytes(flipped)) is None


def test_an_answer_of_another_board_or_to_another_command_is_rejected() -> None:
    answer = RoboClawMock(0x80, lambda channel: 0).obey(roboclaw.read_packet(0x80, RoboclawCommand.READ_CURRENTS), 0.0)
    assert roboclaw.reply_data(0x81, RoboclawCommand.READ_CURRENTS, answer) is None
    assert roboclaw.reply_data(0x80, RoboclawCommand.READ_STATUS, answer) is None


class Cable:
    """A line with mock boards; its clock is that of the boards. `is_cut`: nothing comes back."""

    def __init__(self, *addresses: int) -> None:
        self.link, self._far = byte_pair("/dev/ttyCLAW", 115_200)
        self.shafts = [1000, -5]
        self.mocks = [RoboClawMock(address, lambda channel: self.shafts[channel]) for address in addresses]
        self.mock = RoboClawLineMock(self.mocks, 115_200)
        self.is_cut = False
        self.flips = 0  # how many answers to spoil
        self._now_s = 0.0

    def now_s(self) -> float:
        return self._now_s

    def wait_until_s(self, t: float) -> None:
        while self._now_s < t:
            self._now_s += 0.0005
            received = self._far.read()
            if received:
                self.mock.receive(received, self._now_s)
            for board in self.mocks:
                board.tick(self._now_s, [0.0, 0.0], 24.0, [False, False])
            self._deliver(self._far)

    def _deliver(self, far: MemoryByteLink) -> None:
        there = [sent for sent in self.mock.outgoing if sent[0] <= self._now_s]
        self.mock.outgoing = [sent for sent in self.mock.outgoing if sent[0] > self._now_s]
        for _, answer in there:
            if self.flips:
                self.flips -= 1
                answer = bytes((answer[0] ^ 1, *answer[1:]))
            if not self.is_cut:
                far.write(answer)


@pytest.fixture
def cable() -> Cable:
    return Cable(0x80, 0x81)


def board_on(cable: Cable, address: int = 0x80) -> RoboClaw:
    return RoboClaw(PacketLine(cable.link, cable), address, "base")


def test_two_boards_on_a_line_answer_for_themselves(cable: Cable) -> None:
    line = PacketLine(cable.link, cable)
    first, second = RoboClaw(line, 0x80, "first"), RoboClaw(line, 0x81, "second")
    second.set_count(1, 777)
    assert first.read_counts() == (0, 0)
    assert second.read_counts() == (777, 0)
    assert "RoboClaw" in second.identify().version


def test_an_answer_that_is_wrong_once_is_asked_for_again(cable: Cable) -> None:
    board = board_on(cable)
    cable.flips = 1
    assert board.read_counts() == (0, 0)


def test_a_silent_board_is_given_up_after_three_time_outs_and_the_error_says_what_to_check(cable: Cable) -> None:
    board = board_on(cable)
    cable.is_cut = True
    with pytest.raises(BoardSilent, match=r'RoboClaw "base" \(address 0x80\) on /dev/ttyCLAW.*asked 3 times.*115200'):
        board.read_counts()
    assert cable.now_s() < 3 * (ANSWER_TIMEOUT_s + 0.005)


@pytest.mark.parametrize("has_ctrl_pins", [False, True])
def test_the_firmware_of_the_manual_and_todays_are_told_apart_by_their_pin_modes(has_ctrl_pins: bool) -> None:
    cable = Cable()
    mock = RoboClawMock(0x80, lambda channel: 0, has_ctrl_pins)
    cable.mock.boards[0x80] = mock
    mock.settings[RATES] = bytes(16)
    board = board_on(cable)
    board.set_up(0.2, (10.0, 10.0))
    assert board.identity is not None
    assert board.identity.pin_modes == (0, 0x62, 0x62, 0, 0)[: 5 if has_ctrl_pins else 3]
    assert struct.unpack(">4I", mock.settings[RATES]) == (roboclaw.FASTEST_DUTY_CHANGE,) * 4


@pytest.mark.parametrize("has_short_status", [False, True])
@pytest.mark.parametrize("error", [0x1, 0x2, 0x8, 0x40, 0x80])
def test_errors_of_the_16_bits_of_older_firmware_are_those_of_the_32(error: int, has_short_status: bool) -> None:
    cable = Cable()
    mock = RoboClawMock(0x80, lambda channel: 0, has_ctrl_pins=False, has_short_status=has_short_status)
    cable.mock.boards[0x80] = mock
    board = board_on(cable)
    mock.forced_errors, mock.are_switches_on = error, [True, False]
    assert board.read_status() == RoboclawStatus(error) | RoboclawStatus.S4_TRIGGERED


@pytest.mark.parametrize(("timeout", "lasting"), [(2, 0), (0, 3000), (250, 3000)])
def test_a_duty_that_another_host_left_is_not_kept_alive_by_questions(timeout: int, lasting: int) -> None:
    cable = Cable(0x80)
    mock = cable.mocks[0]
    mock.settings[TIMEOUT] = bytes((timeout,))
    mock.obey(roboclaw.command_packet(0x80, RoboclawCommand.DUTY_M1_M2, roboclaw.duty_data(3000, 0)), 0.0)
    cable.wait_until_s(0.05)
    board = board_on(cable)
    board.identify()
    assert (board.found_duty, round(mock.duty[0])) == ((lasting, 0), lasting)


def test_the_board_forgets_half_a_packet_after_a_gap(cable: Cable) -> None:
    cable.link.write(b"\x80")  # of a host that died here
    board = board_on(cable)
    cable.wait_until_s(0.02)
    assert board.read_counts() == (0, 0)


def test_a_board_restart_is_told_by_its_saved_time_out(cable: Cable) -> None:
    line = PacketLine(cable.link, cable)
    board = RoboClaw(line, 0x80, "base")
    board.set_up(0.25, (10.0, 10.0))
    assert cable.mocks[0].settings[TIMEOUT] == b"\x02"  # rounded down: the arm may not wait longer than it was told
    cable.mocks[0].power_up()
    for _ in range(200):
        board.post_cycle()
        line.update()
        cable.wait_until_s(cable.now_s() + 0.003)
        if board.problems:
            break
    assert isinstance(board.problems[0], BoardReset)


@pytest.mark.parametrize(("has_switch", "asked"), [(False, 6), (True, 12)])
def test_the_status_of_a_board_with_a_limit_switch_is_asked_for_in_each_cycle(has_switch: bool, asked: int, cable: Cable) -> None:
    """At its switch the board overrides the duty: what a cycle makes of that duty would be wrong."""
    line = PacketLine(cable.link, cable)
    board = RoboClaw(line, 0x80, "base")
    if has_switch:
        board.require_limit_switch(1, is_forward=True)
    answers = 0
    for _ in range(12):
        board.status = None
        board.post_cycle()
        for _ in range(5):
            cable.wait_until_s(cable.now_s() + 0.002)
            line.update()
        answers += board.status is not None
    assert answers == asked


def test_a_line_too_slow_for_the_cycle_still_brings_the_counts(cable: Cable) -> None:
    line = PacketLine(cable.link, cable)
    board = RoboClaw(line, 0x80, "base")
    line.keep_asking(board.counts_question)
    for _ in range(60):  # an answer a cycle: no idle time
        board.post_duties()
        line.post_starved()
        board.post_cycle()
        line.update()
        cable.wait_until_s(cable.now_s() + 0.004)
        line.update()
    assert cable.now_s() - board.counted_at_s < 0.05
    assert cable.now_s() - board.obeyed_at_s < 0.05


def test_a_time_out_that_the_board_has_already_is_set_to_another(cable: Cable) -> None:
    cable.mocks[0].settings[TIMEOUT] = b"\x02"
    board_on(cable).set_up(0.2, (10.0, 10.0))
    assert cable.mocks[0].settings[TIMEOUT] == b"\x01"


def test_a_pin_that_tells_of_no_home_switch_is_refused(cable: Cable) -> None:
    board = board_on(cable)
    cable.mocks[0].settings[RoboclawCommand.READ_PIN_MODES] = b"\0\4\1\0\0"  # home of an earlier manual; emergency stop
    board.identify()
    board.require_home_switch(1)
    with pytest.raises(WrongIdentity, match=r'S5 as "Home \(User\)" \(0x62\) .* of channel 2, its mode is 0x01'):
        board.require_home_switch(2)


def test_what_is_not_a_roboclaw_or_counts_no_edges_is_refused(cable: Cable) -> None:
    board = board_on(cable)
    cable.mocks[0].settings[RoboclawCommand.READ_ENCODER_MODES] = b"\0\1"
    board.identify()
    board.require_quadrature(1)
    with pytest.raises(WrongIdentity, match="quadrature encoder at channel 2"):
        board.require_quadrature(2)
    cable.mocks[0].version = "Sabertooth"
    with pytest.raises(WrongIdentity, match="Sabertooth"):
        board.identify()
    with pytest.raises(MisuseError, match="128 to 135"):
        board_on(cable, 0x20)
