"""The motor board's firmware in C beside the mock's own in Python: one document, the same frames, the same voltages."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.devices.motor_inputs import BRAKE, OPEN, MotorBoardHardware, MotorBoardSetup, Output
from hil_mocks.firmware.motor_board import MotorBoardFirmware
from tests.firmware import needs_compiler

pytestmark = needs_compiler
SETUP = MotorBoardSetup(node=2, serial_number=0xF0A1B2C3, counts_per_turn=2048, digital_pins=4)
WORDS = st.one_of(st.sampled_from((0x06, 0x07, 0x0F, 0x0F, 0x0F, 0x00, 0x02, 0x80)), st.integers(0, 255))
SMALL = st.integers(-3000, 3000)
INDICES = st.sampled_from((0, 1, 2, 3, 4, 5, *range(16, 24), *range(32, 37), *range(48, 53), 99))
VALUES = {
    16: 20_000, 17: 500_000, 18: 50_000, 19: 3000, 20: 9000, 21: 24_000, 22: 5000, 23: 20_000, 32: 60, 33: 3, 34: 2, 35: 30,
    36: 60, 48: 2, 49: 16, 50: 16, 51: 16,
}  # fmt: skip
ENABLE = [("command", (word, 0, 0, 0)) for word in (0x06, 0x07, 0x0F)]
Step = tuple[str, object]


@st.composite
def parameters(draw: st.DrawFn) -> tuple[int, int, int, int]:
    index = draw(INDICES)
    most = VALUES.get(index, 2**31 - 1)
    return (
        draw(st.sampled_from((1, 1, 1, 0, 2))),
        index,
        draw(st.integers(1, 255)),
        draw(st.integers(-1, most)),
    )


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("command"), st.tuples(WORDS, st.sampled_from((0, 1, 2, 3, 3, 4, 4, 6)), SMALL, SMALL)),
        st.tuples(st.just("enable"), st.none()),
        st.tuples(st.just("parameter"), parameters()),
        st.tuples(st.just("frame"), st.tuples(st.sampled_from((0, 0x101, 0x102, 0x202, 0x302)), st.binary(max_size=8))),
        st.tuples(st.just("digital"), st.tuples(st.integers(0, 255), st.integers(0, 255))),
        st.tuples(st.just("run"), st.tuples(st.integers(1, 40), st.integers(-30, 30))),
        st.tuples(st.just("current"), st.sampled_from((0.0, 1.5, -2.5, 8.0, 13.0, -14.0))),
        st.tuples(st.just("supply"), st.sampled_from((24.0, 12.0, 8.0, 55.0))),
        st.tuples(st.just("forced"), st.sampled_from((0, 0, 1, 2, 32))),
        st.tuples(st.just("outside"), st.integers(0, 255)),
        st.tuples(st.just("limited"), st.booleans()),
        st.tuples(st.just("reset"), st.none()),
    ),
    max_size=50,
)  # fmt: skip


class Played:
    """A board, and what happens to it."""

    def __init__(self, kind: type[MotorBoardHardware], setup: MotorBoardSetup = SETUP) -> None:
        self.shaft, self.now_s = 0, 0.0
        self.current_A, self.supply_V, self.is_limited = 0.0, 24.0, False
        self.board = kind(setup, lambda: self.shaft)
        self.run(1, 0)

    def run(self, ticks: int, step: int) -> list[tuple[int, bytes]]:
        said = []
        for _ in range(ticks):
            self.shaft += step
            self.now_s = round(self.now_s + 1e-3, 6)
            said += self.board.tick(self.now_s, self.current_A, self.supply_V, self.is_limited)
        return said

    def command(
        self, word: int, mode: int, setpoint: int = 0, feedforward_mV: int = 0
    ) -> list[tuple[int, bytes]]:
        return self.send(0x102, struct.pack("<BBih", word, mode | 5 << 3, setpoint, feedforward_mV))

    def send(self, can_id: int, payload: bytes) -> list[tuple[int, bytes]]:
        return self.board.receive(can_id, payload, self.now_s)

    def write(self, **values: int) -> None:
        for index, value in values.items():
            ((_, answer),) = self.send(0x202, struct.pack("<BBBBi", 1, int(index[1:]), 1, 0, value))
            assert answer[0] == 0

    def play(self, what: str, value: object) -> list[tuple[int, bytes]]:
        match what:
            case "command":
                return self.command(*value)
            case "enable":
                return [frame for _, words in ENABLE for frame in self.command(*words)]
            case "parameter":
                operation, index, sequence, number = value
                return self.send(0x202, struct.pack("<BBBBi", operation, index, sequence, 0, number))
            case "frame":
                return self.send(*value)
            case "digital":
                return self.send(0x302, bytes((7, *value)).ljust(8, b"\0"))
            case "run":
                return self.run(*value)
            case "reset":
                self.board.power_up()
            case "forced":
                self.board.forced_faults = value
            case "outside":
                self.board.pins.outside = value
            case "current":
                self.current_A = value
            case "supply":
                self.supply_V = value
            case _:
                self.is_limited = bool(value)
        return []


def without_warning(said: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Frames without the bit that says whether a limit acts: at the limit itself a rounding decides."""
    return [(i, bytes((p[0] & 0x7F,)) + p[1:] if i == 0x182 else p) for i, p in said]


@settings(max_examples=80, deadline=None)
@given(steps=STEPS)
def test_both_firmwares_say_the_same_frames_and_put_out_the_same_voltages(steps: list[Step]) -> None:
    python, c = Played(MotorBoardMock), Played(MotorBoardFirmware)
    for what, value in steps:
        theirs, ours = python.play(what, value), c.play(what, value)
        assert without_warning(ours) == without_warning(theirs), (what, value)
        assert c.board.output.kind == python.board.output.kind, (what, value)
        # A stop's set-point is a count, rounded: at most one off, with the largest gain 20 mV.
        assert c.board.output.value == pytest.approx(python.board.output.value, abs=0.03), (what, value)
        assert c.board.current_limit_A == pytest.approx(python.board.current_limit_A)
        assert c.board.pins.levels == python.board.pins.levels


GOLDEN = MotorBoardSetup(node=1, serial_number=1, counts_per_turn=8, ambient_degC=41.0)


def test_a_reply_is_the_golden_frame_of_the_document() -> None:
    played = Played(MotorBoardFirmware, GOLDEN)
    for word in (0x06, 0x07, 0x0F):
        played.send(0x101, struct.pack("<BBih", word, 0, 0, 0))
    played.current_A = -2.5
    played.run(2, 0)
    ((can_id, reply),) = played.send(0x101, bytes.fromhex("0f2920d1ffff0000"))
    assert (can_id, reply) == (0x181, bytes.fromhex("37293cf6c05d2900"))
    assert played.board.output == Output("voltage", -12.0)


def test_a_stop_ends_for_good_though_the_clock_wraps() -> None:
    """Held for 71.6 minutes: the board's microseconds are those of the stop again, and it must not begin anew."""
    played = Played(MotorBoardFirmware)
    played.write(p16=1000, p19=0, p32=0, p36=100, p22=9000)
    played.play("enable", None)
    played.command(0x0F, 1, 3000)
    played.run(5, 10)
    played.command(0x0F, 4)
    begun_s = played.now_s
    played.run(200, 0)
    rest = played.board.output
    played.now_s = begun_s + 2**32 * 1e-6 + 0.02
    for _ in range(100):
        played.run(1, 0)
        assert played.board.output == rest


def test_extreme_gains_and_counts_saturate() -> None:
    most = 2**31 - 1
    played = Played(MotorBoardFirmware)
    played.write(p16=most, p17=most, p18=most, p23=most, p22=60_000, p21=60_000, p19=0)
    played.play("enable", None)
    for setpoint in (-(2**31), most, 0):
        played.command(0x0F, 3, setpoint, -32768)
        for step in (most, -(2**31), 12345):
            played.run(2, step)
            assert abs(played.board.output.value) <= 24.0
    played.command(0x0F, 4)
    played.run(300, 70_000)
    assert abs(played.board.output.value) <= 24.0


def test_a_falsified_identity_is_said_by_a_sound_firmware() -> None:
    played = Played(MotorBoardFirmware)
    played.board.setup = replace(SETUP, serial_number=77, protocol=9)
    answers = [played.send(0x202, struct.pack("<BBBBi", 0, index, 3, 0, 0))[0][1] for index in (0, 1, 3)]
    assert [struct.unpack("<i", answer[4:])[0] for answer in answers] == [9, 77, 2048]


def test_a_disabled_board_that_was_holding_does_not_drive() -> None:
    for kind in (MotorBoardMock, MotorBoardFirmware):
        played = Played(kind)
        played.write(p16=1000, p36=100)
        played.play("enable", None)
        played.command(0x0F, 1, 3000)
        played.run(2, 5)
        played.command(0x0F, 4)
        played.command(0x00, 0)
        played.run(3, 5)
        assert played.board.output == BRAKE
        assert played.board.power_up() is None
        assert played.board.output == OPEN
