"""The encoder board against docs/encoder_board.md, read through the product's own decoder: the mock's firmware and that in C."""

from __future__ import annotations

import struct

import pytest

from firmware_iface.encoder.wire import Decoder, IndexLatch, Report
from hil_mocks.devices import encoder_board as eb
from hil_mocks.devices.encoder_board import (
    INDEX_LATCHED,
    INDEX_LEVEL,
    SIGNAL_LOST,
    ZERO_SET,
    EncoderBoardMock,
    EncoderBoardSetup,
    Gatherer,
    deframe,
    frame,
)
from hil_mocks.firmware import EncoderBoardFirmware
from tests.firmware import needs_compiler

SETUP = EncoderBoardSetup(serial_number=0xA1B2C3, counts_per_turn=(2048, 2048, 2048), firmware=0x0203)
NOT_HOME = [False] * 3


@pytest.fixture(autouse=True, params=[EncoderBoardMock, pytest.param(EncoderBoardFirmware, marks=needs_compiler)])
def firmware(request: pytest.FixtureRequest) -> None:
    Bench.kind = request.param


class Bench:
    """A board on a bench: turn its shafts, ask it, read what it says."""

    kind: type[EncoderBoardMock | EncoderBoardFirmware] = EncoderBoardMock

    def __init__(self, setup: EncoderBoardSetup = SETUP, index_raw: tuple[int, ...] = (100, 100, 100)) -> None:
        self.board = self.kind(setup, index_raw)
        self.now_s = 0.0
        self.raw = [0, 0, 0]
        self.decoder = Decoder()
        self.said()

    def ask(self, kind: int, sequence: int, body: bytes = b"") -> list[object]:
        self.board.receive(frame(bytes([kind, sequence]) + body), self.now_s)
        return self.said()

    def turn(self, channel: int, counts: int, ticks: int = 1) -> list[object]:
        said: list[object] = []
        for _ in range(ticks):
            self.raw[channel] += counts
            self.now_s += 1e-3
            self.board.tick(self.now_s, list(self.raw), NOT_HOME)
            said += self.said()
        return said

    def said(self) -> list[object]:
        sent = b"".join(coded for _, coded in self.board.outgoing)
        self.board.outgoing.clear()
        return list(self.decoder.feed(sent))

    def poll(self) -> Report:
        (report,) = self.ask(eb.POLL, 250)
        assert isinstance(report, Report)
        return report


GOLDEN = {
    "81 07 87 d6 12 00 08 0d 00 00 04 00 00 ff ff ff ff 00 00 00 80": (
        "06 81 07 87 d6 12 03 08 0d 01 02 04 01 05 ff ff ff ff 01 01 04 80 59 90 00"
    ),
    "83 08 02 00": "04 83 08 02 03 e7 0d 00",
    "84 09 02 44 d6 12 00 99 ed ff ff": "07 84 09 02 44 d6 12 07 99 ed ff ff 3e ad 00",
}


@pytest.mark.parametrize(("content", "wire"), GOLDEN.items())
def test_frames_are_the_golden_ones_of_the_document(content: str, wire: str) -> None:
    assert frame(bytes.fromhex(content)) == bytes.fromhex(wire)
    assert deframe(bytes.fromhex(wire)[:-1]) == bytes.fromhex(content)


def test_any_flipped_bit_is_dropped_and_costs_only_its_frame() -> None:
    coded, good = frame(b"\x02\x02\xd0\x07\x00\x00"), frame(b"\x01\x07")
    for at in range(8 * len(coded)):
        bad = bytearray(coded)
        bad[at // 8] ^= 1 << at % 8
        assert b"\x02\x02\xd0\x07\x00\x00" not in Gatherer().feed(bytes(bad) + b"\0" + good)
        assert Gatherer().feed(bytes(bad) + b"\0" + good)[-1:] == [b"\x01\x07"]


def test_endless_noise_is_forgotten_at_the_next_delimiter() -> None:
    gatherer = Gatherer()
    for _ in range(100):
        assert gatherer.feed(b"\x55" * 50) == []
    assert gatherer.feed(b"\0" + frame(b"\x01\x07")) == [b"\x01\x07"]


def test_power_up_announces_the_board_unasked() -> None:
    board = Bench.kind(SETUP, (0, 0, 0))
    sent = b"".join(coded for _, coded in board.outgoing)
    (identity,) = Decoder().feed(sent)
    assert sent.startswith(b"\0")
    assert (identity.protocol, identity.request_sequence, identity.serial_number) == (1, 0, 0xA1B2C3)


def test_the_stream_is_a_grid_without_drift_in_the_boards_own_time() -> None:
    bench = Bench()
    bench.turn(0, 0)
    bench.ask(eb.STREAM, 1, struct.pack("<I", 2500))
    reports = [said for said in bench.turn(0, 10, 20) if isinstance(said, Report)]
    assert [report.board_time_us for report in reports] == [1000 + 2500 * k for k in range(1, 9)]
    # Half-way between two ticks the count is half-way, too: 10 counts a millisecond since 1 ms.
    assert [report.counts[0] for report in reports] == [25 * k for k in range(1, 9)]


def test_a_fast_clock_gains_by_its_parts_per_million() -> None:
    bench = Bench(EncoderBoardSetup(serial_number=1, counts_per_turn=(8, 8, 8), clock_ppm=200.0))
    bench.turn(0, 0, 10_000)
    assert bench.poll().board_time_us == pytest.approx(10_000_000 * 1.0002, abs=1.5)


def test_bytes_leave_at_the_pace_of_the_line() -> None:
    slow = Bench.kind(EncoderBoardSetup(serial_number=1, counts_per_turn=(8,), baud=115_200), (0,))
    slow.outgoing.clear()
    for sequence in (1, 2):
        slow.receive(frame(bytes([eb.POLL, sequence])), 1.0)
    times = [when_s for when_s, _ in slow.outgoing]
    assert times == pytest.approx([1.0 + 250 / 115_200, 1.0 + 500 / 115_200])


def test_set_zero_sets_the_count_and_says_so_and_is_not_done_twice() -> None:
    bench = Bench()
    bench.turn(1, 500)
    request = struct.pack("<Bi", 1, -100_000)
    (first,) = bench.ask(eb.SET_ZERO, 3, request)
    bench.turn(1, 7)
    (again,) = bench.ask(eb.SET_ZERO, 3, request)
    report = bench.poll()
    assert (first.result, again.result) == (eb.DONE, eb.DONE)
    assert report.counts[1] == -100_000 + 7
    assert report.flags[1] & ZERO_SET
    assert not report.flags[0] & ZERO_SET


def test_another_request_takes_the_place_of_the_one_that_may_be_repeated() -> None:
    bench = Bench()
    request = struct.pack("<Bi", 1, 500)
    bench.ask(eb.SET_ZERO, 3, request)
    bench.turn(1, 40)
    bench.poll()
    bench.ask(eb.SET_ZERO, 3, request)
    assert bench.poll().counts[1] == 500


def test_a_zero_disarms_the_index_and_forgets_its_latch() -> None:
    bench = Bench()
    bench.ask(eb.ARM_INDEX, 1, b"\x00\x01")
    bench.ask(eb.SET_ZERO, 2, struct.pack("<Bi", 0, 0))
    assert not [one for one in bench.turn(0, 40, 10) if isinstance(one, IndexLatch)]
    bench.ask(eb.ARM_INDEX, 3, b"\x00\x01")
    assert [one for one in bench.turn(0, -40, 10) if isinstance(one, IndexLatch)]
    bench.ask(eb.SET_ZERO, 4, struct.pack("<Bi", 0, 0))
    (ack,) = bench.ask(eb.ARM_INDEX, 5, b"\x00\x02")
    assert ack.result == eb.NOT_NOW


@pytest.mark.parametrize(("step", "latched"), [(30, 100), (-30, -1948)])
def test_the_index_latches_its_own_count_in_both_directions(step: int, latched: int) -> None:
    bench = Bench()
    bench.ask(eb.ARM_INDEX, 1, b"\x00\x01")
    said = bench.turn(0, step, 80)
    (latch,) = [one for one in said if isinstance(one, IndexLatch)]
    assert latch.count == latched
    # At 30 counts a millisecond the shaft is on its index in between two ticks.
    assert latch.board_time_us == pytest.approx(abs(latched) / 30 * 1000, abs=2)
    assert bench.poll().flags[0] & INDEX_LATCHED
    again = bench.ask(eb.ARM_INDEX, 2, b"\x00\x02")
    assert [type(one).__name__ for one in again] == ["Ack", "IndexLatch"]


def test_a_shaft_on_its_index_when_armed_must_leave_it_first() -> None:
    bench = Bench()
    bench.turn(0, 100)
    assert bench.poll().flags[0] & INDEX_LEVEL
    bench.ask(eb.ARM_INDEX, 1, b"\x00\x01")
    assert not [one for one in bench.turn(0, 0, 5) if isinstance(one, IndexLatch)]
    assert not [one for one in bench.turn(0, 40, 5) if isinstance(one, IndexLatch)]
    (latch,) = [one for one in bench.turn(0, -40, 5) if isinstance(one, IndexLatch)]
    assert latch.count == 100


@pytest.mark.parametrize(
    ("kind", "body", "result"),
    [
        (0x7E, b"", eb.UNKNOWN_REQUEST),
        (eb.STREAM, b"\x00", eb.BAD_ARGUMENT),
        (eb.STREAM, struct.pack("<I", 249), eb.BAD_ARGUMENT),
        (eb.STREAM, struct.pack("<I", 250), eb.DONE),
        (eb.STREAM, struct.pack("<I", 1_000_000), eb.DONE),
        (eb.STREAM, struct.pack("<I", 1_000_001), eb.BAD_ARGUMENT),
        (eb.SET_ZERO, struct.pack("<Bi", 3, 0), eb.BAD_ARGUMENT),
        (eb.ARM_INDEX, b"\x00\x03", eb.BAD_ARGUMENT),
        (eb.ARM_INDEX, b"\x00\x02", eb.NOT_NOW),
    ],
)
def test_requests_get_the_result_that_the_document_says(kind: int, body: bytes, result: int) -> None:
    (ack,) = Bench().ask(kind, 9, body)
    assert (ack.request_sequence, ack.result) == (9, result)


def test_a_narrow_counter_wraps_at_its_own_width() -> None:
    bench = Bench(EncoderBoardSetup(serial_number=1, counts_per_turn=(2048,) * 3, encoder_bits=16))
    bench.turn(0, 32_767)
    assert bench.poll().counts[0] == 32_767
    bench.turn(0, 1)
    assert bench.poll().counts[0] == -32_768


def test_a_broken_wire_stops_the_count_for_good_and_refuses_a_zero() -> None:
    bench = Bench()
    bench.turn(0, 10)
    bench.board.lost.add(0)
    bench.turn(0, 10, 3)
    assert (bench.poll().counts[0], bench.poll().flags[0] & SIGNAL_LOST) == (10, SIGNAL_LOST)
    (ack,) = bench.ask(eb.SET_ZERO, 4, struct.pack("<Bi", 0, 0))
    assert ack.result == eb.NOT_NOW
    bench.board.lost.clear()
    bench.turn(0, 5)
    assert bench.poll().counts[0] == 15


def test_a_reset_forgets_zero_stream_and_time() -> None:
    bench = Bench()
    bench.ask(eb.SET_ZERO, 1, struct.pack("<Bi", 0, 77))
    bench.ask(eb.STREAM, 2, struct.pack("<I", 1000))
    bench.turn(0, 5, 10)
    bench.board.power_up(bench.now_s, bench.raw)
    (identity,) = bench.said()
    assert identity.request_sequence == 0
    assert bench.turn(0, 5, 3) == []
    report = bench.poll()
    assert (report.counts[0], report.flags[0], report.board_time_us) == (15, 0, 3000)
