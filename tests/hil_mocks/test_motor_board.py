"""The motor board against docs/motor_board.md, with the document's own frames: the mock's firmware and that in C."""

from __future__ import annotations

import struct

import pytest

from hil_mocks.devices import motor_board as parameter
from hil_mocks.devices.motor_board import MotorBoardMock
from hil_mocks.devices.motor_inputs import BRAKE, NEXT, OPEN, MotorBoardSetup, MotorState, Output, Word, word_of
from hil_mocks.firmware import MotorBoardFirmware
from tests.firmware import needs_compiler

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80
WAY_IN = {
    MotorState.SWITCH_ON_DISABLED: [],
    MotorState.READY: [SHUTDOWN],
    MotorState.SWITCHED_ON: [SHUTDOWN, SWITCH_ON],
    MotorState.ENABLED: [SHUTDOWN, SWITCH_ON, ENABLE],
    MotorState.QUICK_STOP: [SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP],
}


@pytest.fixture(autouse=True, params=[MotorBoardMock, pytest.param(MotorBoardFirmware, marks=needs_compiler)])
def firmware(request: pytest.FixtureRequest) -> None:
    Bench.kind = request.param


class Bench:
    """A board with a motor whose shaft, current and supply the test sets."""

    kind: type[MotorBoardMock | MotorBoardFirmware] = MotorBoardMock

    def __init__(self, state: MotorState = MotorState.SWITCH_ON_DISABLED, pins: int = 0) -> None:
        self.shaft, self.current_A, self.supply_V, self.now_s = 0, 0.0, 24.0, 0.0
        setup = MotorBoardSetup(node=2, serial_number=0xF0A1B2C3, counts_per_turn=2048, digital_pins=pins)
        self.board = self.kind(setup, lambda: self.shaft)
        self.announced = self.tick()
        for word in WAY_IN[state]:
            self.command(word)
        assert self.board.state is state

    def tick(self, ticks: int = 1) -> list[tuple[int, bytes]]:
        sent = []
        for _ in range(ticks):
            self.now_s += 1e-3
            sent += self.board.tick(self.now_s, self.current_A, self.supply_V, False)
        return sent

    def command(self, word: int, mode: int = 0, setpoint: int = 0, feedforward_mV: int = 0) -> tuple[int, ...]:
        payload = struct.pack("<BBih", word, mode | 5 << 3, setpoint, feedforward_mV)
        ((can_id, reply),) = self.board.receive(0x102, payload, self.now_s)
        assert can_id == 0x182
        return struct.unpack("<BBhHbB", reply)

    def ask(self, operation: int, index: int, value: int = 0) -> tuple[int, int]:
        ((_, answer),) = self.board.receive(0x202, struct.pack("<BBBBi", operation, index, 9, 0, value), self.now_s)
        result, echoed, sequence, _, value = struct.unpack("<BBBBi", answer)
        assert (echoed, sequence) == (index, 9)
        return result, value

    def estop(self) -> None:
        self.board.receive(0, b"\0", self.now_s)


def test_power_up_is_announced_by_the_frame_of_the_document() -> None:
    assert Bench().announced == [(0x282, bytes.fromhex("0000000001000000"))]


def test_a_reply_is_the_golden_frame_of_the_document() -> None:
    bench = Bench(MotorState.ENABLED)
    bench.board = bench.kind(MotorBoardSetup(node=1, serial_number=1, counts_per_turn=8, ambient_degC=41.0), lambda: 0)
    bench.tick()
    for word in WAY_IN[MotorState.ENABLED]:
        bench.board.receive(0x101, struct.pack("<BBih", word, 0, 0, 0), bench.now_s)
    bench.current_A = -2.5
    bench.tick(2)
    ((_, reply),) = bench.board.receive(0x101, bytes.fromhex("0f2920d1ffff0000"), bench.now_s)
    assert reply == bytes.fromhex("37293cf6c05d2900")
    assert bench.board.output == Output("voltage", -12.0)


@pytest.mark.parametrize("state", list(WAY_IN))
def test_every_controlword_in_every_state_does_what_the_table_says(state: MotorState) -> None:
    for word in range(256):
        bench = Bench(state)
        before = WAY_IN[state][-1] if WAY_IN[state] else 0x80
        expected = NEXT.get((state, word_of(word, before)), state)
        status = bench.command(word)[0]
        assert bench.board.state is expected
        assert status & 0x6F == expected.value


def test_the_words_are_those_of_the_document() -> None:
    names = {SHUTDOWN: Word.SHUTDOWN, SWITCH_ON: Word.SWITCH_ON, ENABLE: Word.ENABLE_OPERATION}
    names |= {DISABLE: Word.DISABLE_VOLTAGE, QUICK_STOP: Word.QUICK_STOP, RESET: Word.FAULT_RESET}
    for word, name in names.items():
        assert word_of(word, 0) is name
    assert word_of(RESET, RESET) is Word.NOTHING


def test_outputs_by_state_and_mode() -> None:
    bench = Bench()
    assert bench.board.output == BRAKE
    bench = Bench(MotorState.ENABLED)
    assert bench.board.output == OPEN
    bench.command(ENABLE, 1, 5000)
    assert bench.board.output == Output("voltage", 5.0)
    bench.command(ENABLE, 2, -1500)
    assert bench.board.output == Output("current", -1.5)
    bench.command(QUICK_STOP)
    assert bench.board.output == BRAKE


def test_clamped_setpoints_raise_the_warning() -> None:
    bench = Bench(MotorState.ENABLED)
    assert bench.command(ENABLE, 1, 30_000)[0] & 0x80
    assert bench.board.output.value == 24.0
    assert bench.command(ENABLE, 2, 9_000)[0] & 0x80
    assert bench.board.output.value == 8.0
    assert not bench.command(ENABLE, 2, 7_000)[0] & 0x80


def positioning(**values: int) -> Bench:
    bench = Bench()
    for name, value in values.items():
        assert bench.ask(1, getattr(parameter, name), value) == (0, value)
    for word in WAY_IN[MotorState.ENABLED]:
        bench.command(word)
    return bench


def test_the_position_pid_computes_what_the_document_says() -> None:
    bench = positioning(KP=6135, KD=153_400, DERIVATIVE_FILTER_US=0, VOLTAGE_LIMIT_MV=24_000)
    bench.command(ENABLE, 3, 100, 250)
    bench.tick()
    assert bench.board.output.value == pytest.approx(0.6135 + 0.25)
    bench.shaft += 4
    bench.tick()
    assert bench.board.output.value == pytest.approx(96 * 6135e-6 + 0.25 - 153_400e-9 * 4000)


def test_the_integral_stops_at_its_limit_and_while_the_output_is_clamped() -> None:
    bench = positioning(KI=1_000_000, INTEGRAL_LIMIT_MV=500, WATCHDOG_MS=10_000)
    bench.command(ENABLE, 3, 1000)
    bench.tick(300)
    assert bench.board.output.value == pytest.approx(0.5)
    clamped = positioning(KI=1_000_000, KP=50_000, INTEGRAL_LIMIT_MV=60_000, VOLTAGE_LIMIT_MV=10_000, WATCHDOG_MS=10_000)
    clamped.command(ENABLE, 3, 1000)
    clamped.tick(2000)
    clamped.shaft = 999
    clamped.tick()
    assert clamped.board.output.value == pytest.approx(0.05, abs=2e-3)


def test_a_wrap_of_the_count_inside_the_travel_is_harmless() -> None:
    bench = positioning(POSITION_COUNT=2_147_483_640, KP=1000)
    bench.command(ENABLE, 3, -2_147_483_640)
    bench.tick()
    assert bench.board.output.value == pytest.approx(16e-3)


@pytest.mark.parametrize(("action", "output"), [(0, OPEN), (1, BRAKE)])
def test_the_watchdog_acts_in_time_and_keeps_its_output_until_acknowledged(action: int, output: Output) -> None:
    bench = positioning(WATCHDOG_MS=20, WATCHDOG_ACTION=action)
    bench.command(ENABLE, 1, 3000)
    bench.tick(19)
    assert bench.board.state is MotorState.ENABLED
    bench.tick(2)
    assert (bench.board.state, bench.board.faults, bench.board.output) == (MotorState.FAULT, 16, output)
    bench.command(ENABLE, 1, 3000)
    assert bench.board.output == output
    bench.command(RESET)
    assert (bench.board.state, bench.board.faults, bench.board.output) == (MotorState.SWITCH_ON_DISABLED, 0, BRAKE)


def test_a_watchdog_that_holds_runs_the_pid_at_the_count_of_that_moment() -> None:
    bench = positioning(WATCHDOG_MS=20, WATCHDOG_ACTION=2, KP=1000, DERIVATIVE_FILTER_US=0)
    bench.shaft = 700
    bench.tick(30)
    bench.shaft = 690
    bench.tick()
    assert bench.board.state is MotorState.FAULT
    assert bench.board.output.value == pytest.approx(0.01)


def test_an_emergency_stop_brakes_in_every_state_and_again_after_an_acknowledgement() -> None:
    for state in WAY_IN:
        bench = Bench(state)
        bench.estop()
        assert bench.board.output == BRAKE
        bench.tick()
        assert (bench.board.state, bench.board.faults) == (MotorState.FAULT, 128)
        bench.command(DISABLE)
        bench.command(RESET)
        assert bench.board.state is MotorState.SWITCH_ON_DISABLED
        bench.estop()
        assert bench.board.faults == 128


def test_over_current_needs_a_millisecond_and_opens_the_circuit_whatever_else_there_is() -> None:
    bench = positioning(CURRENT_LIMIT_MA=2000)
    bench.command(ENABLE, 1, 3000)
    bench.current_A = -2.9
    bench.tick(5)
    assert bench.board.faults == 0
    bench.current_A = 3.1
    bench.tick()
    assert bench.board.faults == 0
    bench.tick()
    assert (bench.board.faults, bench.board.output) == (1, OPEN)
    bench.estop()
    assert (bench.board.faults, bench.board.output) == (129, OPEN)


def test_a_fault_whose_cause_lasts_is_not_reset() -> None:
    bench = Bench(MotorState.ENABLED)
    bench.supply_V = 60.0
    bench.tick(2)
    assert bench.board.faults == 8
    bench.command(RESET)
    assert bench.board.state is MotorState.FAULT
    bench.supply_V = 24.0
    bench.tick()
    bench.command(DISABLE)
    bench.command(RESET)
    assert (bench.board.state, bench.board.faults) == (MotorState.SWITCH_ON_DISABLED, 0)


@pytest.mark.parametrize("mode", [5, 6, 7])
def test_an_undefined_mode_is_a_bad_command(mode: int) -> None:
    bench = Bench(MotorState.ENABLED)
    assert bench.command(ENABLE, mode)[5] == 64
    assert bench.board.output == BRAKE


@pytest.mark.parametrize(
    ("state", "operation", "index", "value", "answer"),
    [
        (MotorState.SWITCH_ON_DISABLED, 0, 0, 0, (0, 1)),
        (MotorState.SWITCH_ON_DISABLED, 0, 1, 0, (0, -257_838_397)),
        (MotorState.SWITCH_ON_DISABLED, 0, 3, 0, (0, 2048)),
        (MotorState.SWITCH_ON_DISABLED, 0, 99, 0, (1, 0)),
        (MotorState.SWITCH_ON_DISABLED, 1, 99, 1, (1, 0)),
        (MotorState.SWITCH_ON_DISABLED, 1, 0, 1, (2, 1)),
        (MotorState.SWITCH_ON_DISABLED, 1, 33, 3, (3, 1)),
        (MotorState.SWITCH_ON_DISABLED, 1, 32, 4, (3, 200)),
        (MotorState.SWITCH_ON_DISABLED, 1, 32, 5, (0, 5)),
        (MotorState.SWITCH_ON_DISABLED, 1, 32, 0, (0, 0)),
        (MotorState.READY, 1, 32, 0, (4, 200)),
        (MotorState.READY, 1, 16, 6135, (0, 6135)),
        (MotorState.ENABLED, 1, 16, 6135, (4, 0)),
        (MotorState.SWITCH_ON_DISABLED, 2, 16, 6135, (3, 0)),
    ],
)
def test_parameters_answer_as_the_document_says(
    state: MotorState, operation: int, index: int, value: int, answer: tuple[int, int]
) -> None:
    assert Bench(state).ask(operation, index, value) == answer


def test_foreign_frames_are_ignored_and_do_not_feed_the_watchdog() -> None:
    bench = Bench(MotorState.ENABLED)
    for _ in range(210):
        assert bench.board.receive(0x101, bytes(8), bench.now_s) == []
        assert bench.board.receive(0x102, bytes(7), bench.now_s) == []
        bench.tick()
    assert bench.board.faults == 16


def test_the_power_stage_warms_up_by_its_first_order_path() -> None:
    bench = Bench()
    bench.current_A = 10.0
    bench.tick(60_000)
    reply = bench.command(DISABLE)
    # 2 K/W of 0.02 ohm at 10 A: 4 K in the end, 63 % of it after one time constant.
    assert reply[4] == round(25.0 + 4.0 * 0.632)


STOPPING = {"KP": 1000, "DERIVATIVE_FILTER_US": 0, "STOP_AFTER_MS": 20, "STOP_TIME_MS": 100, "INTEGRAL_LIMIT_MV": 9000}


def turning(bench: Bench, counts_per_ms: int, ticks: int) -> None:
    """Turn the shaft while time passes."""
    for _ in range(ticks):
        bench.shaft += counts_per_ms
        bench.tick()


def test_without_the_host_the_board_brings_its_motor_to_rest_and_the_next_command_goes_on() -> None:
    bench = positioning(**STOPPING, SPEED_FEEDFORWARD=10_000)
    bench.command(ENABLE, 1, 3000)
    turning(bench, 10, 20)
    assert bench.board.output == ("voltage", 3.0)
    turning(bench, 10, 1)
    begun = bench.shaft
    assert bench.board.output.value == pytest.approx(3.0, abs=0.02)  # without a jump
    for late_ms in range(1, 101):  # the shaft follows the law
        bench.shaft = begun + round(10 * (late_ms - late_ms**2 / 200))
        bench.tick()
    assert bench.shaft == begun + 500
    assert bench.board.state is MotorState.ENABLED
    assert bench.board.output.value == pytest.approx(3.0 - 0.1, abs=0.05)  # what the speed took is not needed any more
    bench.shaft -= 7
    bench.tick()
    assert bench.board.output.value == pytest.approx(2.9 + 0.007, abs=0.05)
    bench.command(ENABLE, 1, -1000)
    assert bench.board.output == ("voltage", -1.0)


def test_the_watchdog_goes_on_holding_where_the_stop_ended() -> None:
    bench = positioning(**STOPPING, WATCHDOG_MS=60, WATCHDOG_ACTION=2)
    bench.command(ENABLE, 1, 1500)
    bench.tick(100)
    assert bench.board.state is MotorState.FAULT
    assert bench.board.output == ("voltage", 1.5)
    bench.shaft += 5
    bench.tick()
    assert bench.board.output.value == pytest.approx(1.495)


def test_a_board_without_gains_brakes_and_a_free_one_stays_free() -> None:
    bench = positioning(STOP_AFTER_MS=20)
    bench.command(ENABLE, 1, 1500)
    bench.tick(25)
    assert (bench.board.state, bench.board.output) == (MotorState.ENABLED, BRAKE)
    bench = positioning(**STOPPING)
    bench.command(ENABLE, 0)
    bench.tick(50)
    assert bench.board.output == OPEN


def test_mode_4_stops_at_once_and_holds_for_as_long_as_it_is_commanded() -> None:
    bench = positioning(**STOPPING)
    bench.command(ENABLE, 1, 2000)
    bench.tick(5)
    for _ in range(100):
        bench.command(ENABLE, 4)
        bench.tick(2)
    assert (bench.board.state, bench.board.output) == (MotorState.ENABLED, ("voltage", 2.0))
    bench.shaft -= 3
    bench.tick()
    assert bench.board.output.value == pytest.approx(2.003)
    bench.command(ENABLE, 1, 0)
    assert bench.board.output == BRAKE


class PinBench(Bench):
    """A board of four pins, 0 and 1 outputs: 0 safe high, 1 keeps its level."""

    def __init__(self) -> None:
        super().__init__(pins=4)
        for index, value in ((parameter.DIGITAL_OUTPUTS, 3), (50, 1), (51, 2)):
            assert self.ask(1, index, value) == (0, value)

    def digital(self, mask: int = 0, levels: int = 0) -> tuple[int, int, int]:
        """Levels, outputs, is_safe."""
        ((can_id, payload),) = self.board.receive(0x302, bytes((9, mask, levels, 0, 0, 0, 0, 0)), self.now_s)
        assert (can_id, payload[0], payload[4:]) == (0x382, 9, bytes(4))
        return payload[1], payload[2], payload[3]

    def enable(self) -> None:
        for word in WAY_IN[MotorState.ENABLED]:
            self.command(word)


def test_pins_of_a_board_that_has_none_are_unknown_and_unanswered() -> None:
    bench = Bench(MotorState.ENABLED)
    assert [bench.ask(0, index) for index in (48, 49, 50, 51)] == [(1, 0)] * 4
    assert bench.board.receive(0x302, bytes(8), bench.now_s) == []


def test_outputs_are_set_while_the_drive_is_enabled_and_inputs_follow_the_world() -> None:
    bench = PinBench()
    assert bench.ask(0, 48) == (0, 4)
    assert bench.ask(1, 48, 3)[0] == 2
    assert bench.ask(1, 49, 16)[0] == 3
    assert bench.digital(3, 2) == (1, 1, 1)  # safe: nothing was set
    bench.enable()
    bench.board.pins.outside = 0b1101
    assert bench.digital() == (0b1101, 1, 0)
    assert bench.digital(0b1111, 0b0010) == (0b1110, 0b0010, 0)


def test_a_pin_that_keeps_its_level_ignores_its_safe_level() -> None:
    bench = PinBench()
    assert bench.ask(1, 50, 3)[0] == 0
    bench.enable()
    bench.digital(3, 0)
    bench.command(DISABLE)
    assert bench.digital() == (1, 1, 1)


@pytest.mark.parametrize("end", ["off", "quick stop", "watchdog", "emergency stop", "reset"])
def test_outputs_go_to_their_safe_levels_whatever_ends_the_enabled_drive(end: str) -> None:
    bench = PinBench()
    bench.enable()
    bench.digital(3, 2)
    if end == "watchdog":
        bench.tick(201)
    elif end == "emergency stop":
        bench.estop()
        bench.tick()
    elif end == "reset":
        bench.board.power_up()
    else:
        bench.command(DISABLE if end == "off" else QUICK_STOP)
    expected = (0, 0, 1) if end == "reset" else (3, 3, 1)
    assert bench.digital(3, 0) == expected


def test_outputs_stay_while_the_board_stops_without_its_host() -> None:
    bench = PinBench()
    assert bench.ask(1, parameter.STOP_AFTER_MS, 10)[0] == 0
    bench.enable()
    bench.digital(3, 2)
    bench.command(ENABLE, mode=1)
    bench.tick(50)
    assert bench.digital() == (2, 2, 0)
