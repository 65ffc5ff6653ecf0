"""The encoder board's driver in scripted dialogues: every answer, and every way of getting none."""

import math

import pytest

from firmware_iface.encoder import wire
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.encoder.wire import Ack, AckResult, ChannelFlag, Frame, IndexLatch, Report
from firmware_iface.errors import BoardRefused, BoardReset, BoardSilent, LinkLost, MisuseError, ProtocolViolation, WrongIdentity
from tests.firmware_iface.scripted import RX, TX, FakeClock, Script, ScriptedBytes

Flags = tuple[int, int, int]
ZERO_SET = int(ChannelFlag.ZERO_SET)
ZEROED = (ZERO_SET,) * 3
LATCHED = (ZERO_SET, ZERO_SET | int(ChannelFlag.INDEX_LATCHED), ZERO_SET)


def send(*frames: Frame) -> bytes:
    return b"".join(map(wire.encode, frames))


def first(*frames: Frame) -> bytes:
    return b"\x00" + send(*frames)


def report(sequence: int, time_us: int = 0, counts: tuple[int, int, int] = (0, 0, 0), flags: Flags = ZEROED) -> Report:
    return Report(sequence & 0xFF, time_us & 0xFFFFFFFF, flags, counts)


def identity(request: int = 1, protocol: int = 1, serial_number: int = 77, sequence: int = 0) -> wire.Identity:
    return wire.Identity(sequence, protocol, request, 0x0100, serial_number, 3, (2048,) * 3, 32)


def make(script: Script | None = None, baud: int = 1_000_000) -> tuple[EncoderBoard, ScriptedBytes, FakeClock]:
    link, clock = ScriptedBytes(script or [], baud), FakeClock()
    return EncoderBoard(link, clock, "enc0"), link, clock


def test_making_a_board_sends_nothing() -> None:
    make([])


def test_identify_starts_with_a_delimiter_and_returns_who_it_is() -> None:
    board, _, _ = make([(TX, first(wire.Identify(1))), (RX, send(identity()))])
    assert board.identify(serial_number=77) == identity()
    assert board.identity == identity()


def test_an_ack_is_no_identity() -> None:
    board, _, _ = make([(TX, first(wire.Identify(1))), (RX, send(Ack(0, 1, AckResult.DONE)))])
    with pytest.raises(ProtocolViolation, match="answered IDENTIFY by"):
        board.identify()


def test_a_wrong_serial_number_is_one_message_with_both_numbers() -> None:
    board, _, _ = make([(TX, first(wire.Identify(1))), (RX, send(identity()))])
    with pytest.raises(WrongIdentity, match=r'encoder board "enc0" on /dev/ttyTEST: .* 78, found 77'):
        board.identify(serial_number=78)
    assert board.identity is None


def test_another_protocol_version_is_a_wrong_identity() -> None:
    board, _, _ = make([(TX, first(wire.Identify(1))), (RX, send(identity(protocol=2)))])
    with pytest.raises(WrongIdentity, match="protocol version 2, expected 1; update"):
        board.identify()


def test_another_protocol_version_is_told_even_if_its_identity_has_another_length() -> None:
    raw = b"\x82\x00\x02" + bytes(40)
    coded = wire.cobs_encode(raw + wire.crc16(raw).to_bytes(2, "little")) + b"\x00"
    board, _, _ = make([(TX, first(wire.Identify(1))), (RX, coded)])
    with pytest.raises(WrongIdentity, match="protocol version 2"):
        board.identify()


def test_a_silent_board_is_asked_three_times() -> None:
    asked = send(wire.Identify(1))
    board, link, clock = make([(TX, b"\x00" + asked), (TX, asked), (TX, asked)])
    with pytest.raises(BoardSilent, match=r"no answer to Identify within 0.050 s, asked 3 times$"):
        board.identify()
    assert clock.now_s() == pytest.approx(100.15, abs=0.01)
    assert link.script == []


def test_silence_with_noise_asks_for_the_baud_rate() -> None:
    asked = send(wire.Identify(1))
    noise: Script = [(RX, b"\x05\x81\x13\x00")]
    board, _, _ = make([(TX, b"\x00" + asked), *noise, (TX, asked), *noise, (TX, asked), *noise])
    with pytest.raises(BoardSilent, match="3 bad frames received: check the baud rate"):
        board.identify()


def test_an_answer_lost_once_is_asked_for_again_with_the_same_bytes() -> None:
    asked = send(wire.Stream(1, 2000))
    board, _, _ = make([(TX, b"\x00" + asked), (TX, asked), (RX, send(Ack(0, 1, AckResult.DONE)))])
    board.stream(0.002)


def test_an_answer_to_an_older_request_is_not_taken() -> None:
    asked = send(wire.Stream(1, 2000))
    stale = send(Ack(9, 200, AckResult.DONE))
    board, _, _ = make([(TX, b"\x00" + asked), (RX, stale), (TX, asked), (TX, asked)])
    with pytest.raises(BoardSilent):
        board.stream(0.002)


@pytest.mark.parametrize("result", [AckResult.UNKNOWN_REQUEST, AckResult.BAD_ARGUMENT, AckResult.NOT_POSSIBLE_NOW])
def test_a_refusal_names_its_reason(result: AckResult) -> None:
    board, _, _ = make([(TX, first(wire.SetZero(1, 2, 5))), (RX, send(Ack(0, 1, result)))])
    with pytest.raises(BoardRefused, match=result.name.replace("_", " ").lower()):
        board.set_zero(2, 5)


def test_request_sequences_run_from_1_to_255_and_leave_out_0() -> None:
    frames = [wire.Poll(number % 255 + 1) for number in range(300)]
    board, link, _ = make([(TX, (b"\x00" if not at else b"") + send(frame)) for at, frame in enumerate(frames)])
    for _ in frames:
        board.poll()
    assert link.script == []


@pytest.mark.parametrize(
    ("baud", "period_s", "is_possible"),
    [
        (1_000_000, 0.001, True),
        (115_200, 0.002, False),
        (115_200, 0.0024, False),
        (115_200, 0.00242, True),
        (0, 0.000_1, True),
        (1_000_000, 1.0, True),
        (1_000_000, 1.001, False),
        (1_000_000, -0.001, False),
        (1_000_000, float("nan"), False),
    ],
)
def test_a_stream_that_the_line_cannot_carry_is_refused_before_anything_is_sent(
    baud: int, period_s: float, is_possible: bool
) -> None:
    if is_possible:
        request = wire.Stream(1, round(period_s * 1e6))
        board, _, _ = make([(TX, first(request)), (RX, send(Ack(0, 1, AckResult.DONE)))], baud)
        board.stream(period_s)
    else:
        board, _, _ = make([], baud)
        with pytest.raises(MisuseError, match="cannot stream every"):
            board.stream(period_s)


@pytest.mark.parametrize("channel", [-1, 3])
def test_a_channel_that_is_not_there_is_our_misuse(channel: int) -> None:
    board, _, _ = make([])
    with pytest.raises(MisuseError, match=f"no channel {channel}: expected 0 to 2"):
        board.set_zero(channel)
    with pytest.raises(MisuseError, match="no channel"):
        board.arm_index(channel)


def test_a_count_that_does_not_fit_changes_nothing() -> None:
    board, link, _ = make([])
    link.push(send(IndexLatch(0, 1, 0, 42)))
    board.update()
    with pytest.raises(MisuseError, match="does not fit"):
        board.set_zero(1, 2**31)
    assert board.index_latch(1) == 42


def test_update_keeps_the_latest_report_and_when_it_came() -> None:
    board, link, clock = make([])
    link.push(send(report(0, 1000, (1, 2, 3)), report(1, 3000, (4, 5, 6))))
    clock.time_s = 200.0
    board.update()
    assert board.latest == report(1, 3000, (4, 5, 6))
    assert board.latest_at_s == 200.0
    assert board.board_time_s == pytest.approx(0.003)
    assert (board.reports, board.lost) == (2, 0)


def test_stale_data_are_named_with_their_age_and_limit() -> None:
    board, link, clock = make([])
    with pytest.raises(BoardSilent, match=r"no report yet \(limit 0.020 s\)"):
        board.require_fresh(clock.now_s(), 0.02)
    link.push(send(report(0)))
    board.update()
    board.require_fresh(clock.now_s() + 0.019, 0.02)
    with pytest.raises(BoardSilent, match=r"no report for 0.050 s \(limit 0.020 s\)"):
        board.require_fresh(clock.now_s() + 0.05, 0.02)


def test_gaps_are_counted_across_the_wrap_and_all_kinds_of_frames() -> None:
    board, link, _ = make([])
    link.push(send(report(253, 0), report(255, 1), IndexLatch(0, 0, 5, 5), Ack(2, 9, 0), report(3, 2)))
    board.update()
    assert board.lost == 2  # 254 and 1


def test_a_bad_frame_is_counted_and_costs_one_report() -> None:
    board, link, _ = make([])
    bad = bytearray(send(report(1, 2)))
    bad[5] ^= 0x10
    link.push(send(report(0, 1)) + bytes(bad) + send(report(2, 3)))
    board.update()
    assert board.crc_errors + board.framing_errors == 1
    assert (board.lost, board.reports) == (1, 2)


def test_a_count_that_wraps_comes_through_as_it_is() -> None:
    board, link, _ = make([])
    link.push(send(report(0, 0, (2**31 - 1, 0, 0)), report(1, 1, (-(2**31), 0, 0))))
    board.update()
    assert board.latest is not None
    assert board.latest.counts[0] == -(2**31)
    assert board.resets == 0


class TestLateReports:
    """Frames that come in another order than they were sent: the newest counts, and nobody restarted."""

    def test_an_older_report_is_dropped(self) -> None:
        board, link, _ = make([])
        newest = report(203, 50_006_000, (4, 0, 0))
        link.push(send(report(200, 50_000_000), newest, report(202, 50_004_000), report(201, 50_002_000)))
        board.update()
        assert board.latest == newest
        assert (board.resets, board.late) == (0, 2)
        link.push(send(report(204, 50_008_000)))
        board.update()
        assert board.latest == report(204, 50_008_000)

    def test_across_the_wraps_of_sequence_and_time(self) -> None:
        board, link, clock = make([])
        link.push(send(report(254, -3000)))
        board.update()
        clock.time_s += 0.004
        link.push(send(report(1, 1000), report(255, -2000)))
        board.update()
        assert (board.resets, board.late) == (0, 1)

    def test_a_restart_with_a_sequence_a_little_behind_is_still_seen(self) -> None:
        board, link, clock = make([])
        link.push(send(report(5, 50_000_000)))
        board.update()
        clock.time_s += 0.6
        link.push(send(report(0, 100_000)))
        with pytest.raises(BoardReset):
            board.update()


class TestReset:
    """A board that restarts is told from lost frames, once, whichever sign of it arrives."""

    def running(self) -> tuple[EncoderBoard, ScriptedBytes, FakeClock]:
        board, link, clock = make([])
        link.push(send(report(200, 50_000_000), report(201, 50_002_000)))
        board.update()
        return board, link, clock

    def expect_reset(self, board: EncoderBoard) -> None:
        with pytest.raises(BoardReset, match=r"restarted by itself.*home again"):
            board.update()
        assert (board.resets, board.lost) == (1, 0)
        board.update()  # once

    def test_by_its_hello(self) -> None:
        board, link, _ = self.running()
        link.push(send(identity(request=0)))
        self.expect_reset(board)
        assert board.latest is None

    def test_by_its_hello_and_the_signs_that_follow_once(self) -> None:
        board, link, _ = self.running()
        link.push(send(identity(request=0), report(1, 2000, flags=(0, 0, 0))))
        self.expect_reset(board)
        assert board.latest is not None

    def test_by_its_time_alone(self) -> None:
        board, link, clock = self.running()
        clock.time_s += 0.6
        link.push(send(report(0, 100_000)))
        self.expect_reset(board)
        link.push(send(report(1, 102_000)))
        board.update()
        assert board.board_time_s == pytest.approx(0.102)

    def test_by_a_zero_flag_that_fell(self) -> None:
        board, link, clock = self.running()
        clock.time_s += 0.002
        link.push(send(report(202, 50_004_000, flags=(ZERO_SET, 0, ZERO_SET))))
        self.expect_reset(board)

    def test_a_hello_before_the_first_contact_is_none(self) -> None:
        board, link, _ = make([])
        link.push(send(identity(request=0), report(1, 5)))
        board.update()
        assert board.resets == 0

    def test_latches_and_arming_are_forgotten(self) -> None:
        board, link, _ = self.running()
        link.push(send(IndexLatch(202, 0, 0, 9), identity(request=0)))
        self.expect_reset(board)
        assert board.index_latch(0) is None


class TestIndex:
    """The index latch, and the races around it."""

    def armed(self, script: Script | None = None) -> tuple[EncoderBoard, ScriptedBytes, FakeClock]:
        arm: Script = [(TX, first(wire.ArmIndex(1, 1, 1))), (RX, send(Ack(0, 1, 0)))]
        board, link, clock = make(arm + (script or []))
        board.arm_index(1)
        return board, link, clock

    def test_a_latched_count_is_kept(self) -> None:
        board, link, _ = self.armed()
        assert board.index_latch(1) is None
        link.push(send(IndexLatch(1, 1, 5, -70)))
        board.update()
        assert board.index_latch(1) == -70
        assert board.index_latch(0) is None

    def test_an_index_of_an_older_arming_is_dropped(self) -> None:
        older = IndexLatch(0, 1, 5, 999)
        board, _, _ = make([(TX, first(wire.ArmIndex(1, 1, 1))), (RX, send(older, Ack(1, 1, 0)))])
        board.arm_index(1)
        assert board.index_latch(1) is None

    def test_an_index_right_behind_the_ack_is_kept(self) -> None:
        script: Script = [(TX, first(wire.ArmIndex(1, 1, 1))), (RX, send(Ack(0, 1, 0), IndexLatch(1, 1, 5, 33)))]
        board, _, _ = make(script)
        board.arm_index(1)
        assert board.index_latch(1) == 33

    def test_a_lost_index_frame_is_asked_for_again(self) -> None:
        again = wire.ArmIndex(2, 1, 2)
        board, link, clock = self.armed([(TX, send(again)), (RX, send(Ack(4, 2, 0), IndexLatch(5, 1, 5, 88)))])
        for step in range(3):
            clock.time_s += 0.011
            link.push(send(report(step + 1, step * 11_000, flags=LATCHED)))
            board.update()
        board.update()
        assert board.index_latch(1) == 88
        assert link.script == []

    def test_a_new_zero_forgets_the_latch_of_the_old_counting(self) -> None:
        board, link, _ = self.armed([(TX, send(wire.SetZero(2, 1, 0))), (RX, send(Ack(2, 2, 0)))])
        link.push(send(IndexLatch(1, 1, 5, 33)))
        board.update()
        board.set_zero(1)
        assert board.index_latch(1) is None

    def test_an_index_of_no_channel_is_a_violation(self) -> None:
        board, link, _ = make([])
        link.push(send(IndexLatch(0, 7, 5, 33)))
        with pytest.raises(ProtocolViolation, match="index of channel 7") as caught:
            board.update()
        assert caught.value.received


def test_an_unknown_frame_is_a_violation_with_its_bytes_and_costs_no_report() -> None:
    raw = b"\xf0\x07"
    coded = wire.cobs_encode(raw + wire.crc16(raw).to_bytes(2, "little")) + b"\x00"
    board, link, _ = make([])
    link.push(coded + send(report(8)))
    with pytest.raises(ProtocolViolation, match=r"received: f0 07\)"):
        board.update()
    assert board.latest == report(8)


def test_hearing_our_own_requests_says_that_the_line_is_bridged() -> None:
    board, link, _ = make([])
    link.push(send(wire.Poll(1)))
    with pytest.raises(ProtocolViolation, match="bridge between TX and RX"):
        board.update()


def test_a_lost_link_comes_through() -> None:
    board, link, _ = make([])
    link.is_lost = True
    with pytest.raises(LinkLost):
        board.update()


# ---- a report that is waited for


class Trickle(ScriptedBytes):
    """A line on which pieces come one after the other, a tenth of a millisecond apart."""

    def __init__(self, clock: FakeClock, pieces: list[bytes]) -> None:
        super().__init__([])
        self.clock, self.pieces = clock, pieces

    def wait(self, limit_s: float) -> bool:
        if not self.incoming and limit_s > 0.0:
            self.clock.time_s += min(limit_s, 1e-4)
            if limit_s >= 1e-4 and self.pieces:
                self.incoming += self.pieces.pop(0)
        return super().wait(limit_s)


def test_a_report_is_awaited_until_it_is_whole_and_no_longer_than_asked() -> None:
    clock, coded = FakeClock(), send(report(0, time_us=7000))
    board = EncoderBoard(Trickle(clock, [coded[:8], coded[8:16], coded[16:]]), clock)
    assert math.isnan(board.await_report(0.007, 100.00025)), "two pieces"
    assert clock.time_s == pytest.approx(100.00025)
    assert board.await_report(0.007, 100.001) == pytest.approx(0.007)
    assert clock.time_s == pytest.approx(100.00035)
    assert board.await_report(0.008, 100.001) == pytest.approx(0.007), "older than wanted"


def test_what_goes_wrong_while_a_report_is_awaited_is_raised_by_the_next_update() -> None:
    clock = FakeClock()
    line = Trickle(clock, [send(wire.Poll(1)), send(report(0, time_us=7000))])
    board = EncoderBoard(line, clock)
    board.await_report(0.007, 100.001)
    assert clock.time_s == pytest.approx(100.0001), "it is told without delay"
    with pytest.raises(ProtocolViolation, match="bridge between TX and RX"):
        board.update()
    line.is_lost = True
    board.await_report(1.0, 100.001)
    with pytest.raises(LinkLost):
        board.update()


# ---- old counts, and indices in operation


def test_reports_whose_time_stands_are_as_old_as_their_counts() -> None:
    board, link, clock = make()
    for number in range(5):
        clock.time_s += 0.002
        link.push(send(report(number, time_us=1000 + 2000 * min(number, 2))))
        board.update()
    assert board.latest_at_s == pytest.approx(100.010)
    assert board.fresh_at_s == pytest.approx(100.006, abs=1e-3)


def test_a_report_that_was_under_way_for_long_is_old_and_a_drifting_crystal_is_not() -> None:
    board, link, clock = make()
    for number in range(4000):
        clock.time_s += 0.5
        link.push(send(report(number, time_us=round(number * 500_000 * (1.0 - 1e-4)))))
        board.update()
    assert board.fresh_at_s == pytest.approx(clock.time_s, abs=1e-3)
    clock.time_s += 0.08
    link.push(send(report(4000, time_us=round(3999 * 500_000 * (1.0 - 1e-4)) + 30_000)))
    board.update()
    assert board.fresh_at_s == pytest.approx(clock.time_s - 0.05, abs=1e-3)


def test_a_report_that_comes_after_a_newer_one_is_dropped_and_is_no_restart() -> None:
    board, link, _ = make()
    for number in (1, 3, 2, 4):
        link.push(send(report(number, time_us=1_000_000 + 1000 * number, counts=(number, 0, 0))))
        board.update()
        assert board.latest is not None
    assert board.latest.counts[0] == 4
    assert (board.late, board.resets) == (1, 0)


def test_an_old_answer_that_comes_again_makes_no_restart_of_the_old_report_after_it() -> None:
    """The order is that of the reports' own time stamps: other frames have none."""
    board, link, _ = make()
    index = wire.encode(wire.IndexLatch(3, 0, 1_003_000, 5))
    for number in (1, 2):
        link.push(send(report(number, time_us=1_000_000 + 1000 * number)))
    link.push(index)
    for number in range(4, 90):
        link.push(send(report(number, time_us=1_000_000 + 1000 * number)))
    board.update()
    link.push(index + send(report(80, time_us=1_080_000), report(90, time_us=1_090_000)))
    board.update()
    assert board.latest == report(90, time_us=1_090_000)
    assert (board.late, board.resets, board.lost) == (1, 0, 0)


def test_a_watched_index_is_armed_again_after_each_pulse_without_waiting() -> None:
    arm = [wire.ArmIndex(number, 1, wire.IndexAction.ARM) for number in (1, 2)]
    board, link, clock = make(
        [
            (TX, first(arm[0])),
            (RX, send(Ack(1, 1, AckResult.DONE), IndexLatch(2, 1, 5, 777))),
            (TX, send(arm[1])),
            (RX, send(Ack(5, 2, AckResult.DONE))),
        ]
    )
    board.watch_indices([1])
    for number in (0, 3, 4, 6):
        clock.time_s += 0.011
        link.push(send(report(number, time_us=1000 * number)))
        board.update()
    assert board.passed_indices() == [(1, 777)]
    assert board.passed_indices() == []
    assert link.script == []
