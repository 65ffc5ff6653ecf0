"""moteus on CAN FD: golden frames, a controller that is silent, restarted, faulted or left alone, and damaged replies."""

import math
from typing import Any

import pytest

from firmware_iface import moteus
from firmware_iface.errors import BoardReset, BoardSilent, MisuseError, ProtocolViolation
from firmware_iface.moteus import Moteus, MoteusBus, MoteusMode, Position, Register
from hil_mocks.devices.moteus import OVER_HEATED, MoteusMock, MoteusSetup
from tests.firmware_iface.mock_wire import BusRig, golden

ID, CPR = 5, 4096
HOLD = Position(0.0, 0.0, 0.0, 1.0, math.nan, 0.1)


class Cell(BusRig[MoteusBus]):
    def __init__(self, **setup: Any) -> None:
        self.turns = 0.25
        self.mock = MoteusMock(MoteusSetup(ID, 0.05, 8.0, **setup), lambda: self.turns)
        super().__init__(self.mock, MoteusBus)
        self.board = Moteus(self.bus, ID, "elbow", CPR)


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("identity query", (moteus.ask(ID, moteus.IDENTITY_QUERY))),
        (
            "position 1.5 turns, -0.25 turns/s, 0.1 Nm, at most 0.6 Nm, 0.1 s",
            moteus.position(ID, Position(1.5, -0.25, 0.1, 1.0, 0.6, 0.1)),
        ),
        ("brake", moteus.brake(ID)),
    ],
)
def test_what_is_sent_is_what_the_reference_says(name: str, made: moteus.Frame) -> None:
    assert made == golden("moteus.txt", name)


def test_the_references_own_reply_is_read() -> None:
    found = moteus.values(golden("moteus.txt", "reply of the reference's example")[1])
    assert found == {0: 10, 1: 80, 2: 256, 3: -144, 13: 24, 14: 20, 15: 0}


def test_all_values_come_with_the_reply_to_a_command() -> None:
    cell = Cell()
    assert cell.board.identify() == "firmware 0x010304, serial number 000000030000000200000001"
    cell.mock.is_home = True
    cell.board.wanted = moteus.brake(cell.board.number)
    cell.run(0.008)
    board = cell.board
    assert (board.count, board.supply_V, board.current_A) == (CPR // 4, pytest.approx(24.0), 0.5)
    assert (board.temperature_degC, board.is_switch_on, board.mode) == (35.0, True, MoteusMode.BRAKE)


def test_a_count_that_waited_for_a_host_that_paused_is_of_before_the_pause() -> None:
    cell = Cell()
    cell.board.identify()
    cell.bus.flush()
    asked_s = cell.wired.now_s()
    cell.wired.run(0.031)
    cell.bus.update()
    assert (cell.board.counted.at_s, cell.board.at_s) == (asked_s, cell.wired.now_s())


@pytest.mark.parametrize("others", [moteus.stop(ID), moteus.brake(ID)])
def test_one_that_others_stop_or_brake_does_not_run(others: moteus.Frame) -> None:
    cell = Cell()
    cell.board.identify()
    cell.board.wanted = moteus.brake(ID)
    cell.run(0.02)
    cell.board.wanted = moteus.position(ID, HOLD)
    seen = []
    for _ in range(10):
        cell.run(0.004)
        seen.append(cell.board.is_running)
    assert all(seen[1:])  # its own brake a cycle before is nobody else's
    cell.mock.receive(*others, cell.wired.now_s())
    cell.mock.outgoing.clear()
    seen = []
    for _ in range(2):
        cell.run(0.004)
        seen.append(cell.board.is_running)
    assert False in seen


def test_the_first_question_commands_nothing() -> None:
    cell = Cell()
    cell.board.identify()
    assert cell.mock.mode == MoteusMode.STOPPED


def test_a_torque_is_position_mode_without_its_gains() -> None:
    cell = Cell()
    cell.board.wanted = moteus.position(ID, moteus.torque(0.1, 0.3, 0.1))
    cell.run(0.008)
    assert cell.mock.output == ("current", pytest.approx(2.0))
    cell.board.wanted = moteus.position(ID, moteus.torque(0.5, 0.3, 0.1))
    cell.run(0.008)
    assert cell.mock.output == ("current", pytest.approx(6.0)), "limited by the torque that the command allows"


def test_a_silent_controller_and_a_position_that_is_not_the_outputs_say_what_to_do() -> None:
    cell = Cell()
    with pytest.raises(MisuseError, match=r"not referenced to the output \(home state 1, not 2\)"):
        cell.board.identify(2)
    assert Cell(home_state=2).board.identify(2)
    cell.wired.is_cut = True
    with pytest.raises(BoardSilent, match=r'"elbow" \(id 5\) on memory: no reply, asked 3 times: .* CAN FD with 1 Mbit/s'):
        cell.board.identify()
    with pytest.raises(MisuseError, match="1 to 127, got 128"):
        Moteus(cell.bus, 128, "elbow", CPR)


def test_registers_that_older_firmware_does_not_have_are_told_and_stop_nothing() -> None:
    cell = Cell(unknown=(0x00C, 0x05E, 0x070, 0x101, 0x121))
    said = cell.board.identify()
    assert said.startswith("firmware 0x000000, ")
    assert said.endswith(", without registers 0x05E, 0x070")
    cell.board.wanted = moteus.position(ID, HOLD)
    cell.run(0.1)
    assert (cell.board.is_running, cell.board.resets, cell.board.is_switch_on) == (True, 0, False)
    with pytest.raises(MisuseError, match=r"home state nan, not 2"):
        cell.board.identify(2)


def test_a_reply_to_another_programs_question_is_neither_a_violation_nor_who_it_is() -> None:
    cell = Cell(home_state=2)
    cell.wired.put(ID << 8, b"\x21\x02\x05")  # its speed alone
    cell.bus.update()
    cell.wired.is_cut = True
    cell.wired.put(ID << 8, b"\x21\x02\x05")
    with pytest.raises(BoardSilent):
        cell.board.identify(2)


@pytest.mark.parametrize("up_s", [0.1, 5.0])
def test_a_restart_is_noticed_however_long_it_was_up_and_does_not_lead_back_into_operation(up_s: float) -> None:
    cell = Cell()
    cell.board.wanted = moteus.position(ID, HOLD)
    cell.run(0.02)
    cell.wired.run(up_s)
    cell.run(0.02)
    cell.mock.power_up(cell.wired.now_s())
    with pytest.raises(BoardReset, match="restarted by itself"):
        cell.run(0.3)
    cell.run(0.05)
    assert (cell.board.resets, cell.mock.mode) == (1, MoteusMode.BRAKE)


def test_a_pause_of_the_host_is_no_restart() -> None:
    cell = Cell()
    cell.run(0.02)
    cell.bus.flush()  # answered at once, and read after the pause
    cell.wired.run(2.0)
    cell.run(0.05)
    assert cell.board.resets == 0


def test_the_end_of_the_counters_range_is_no_restart() -> None:
    cell = Cell()
    cell.mock.advance_counter(2**31 - 20)
    cell.run(0.1)
    assert cell.mock.milliseconds < 0
    assert cell.board.resets == 0


def test_a_fault_and_a_time_out_end_by_a_stop_alone_and_a_persistent_cause_comes_back() -> None:
    cell = Cell()
    cell.board.wanted = moteus.position(ID, HOLD)
    cell.run(0.008)
    cell.wired.run(0.2)
    cell.run(0.008)
    assert cell.board.mode == MoteusMode.TIMEOUT
    assert cell.board.reset_fault()
    assert cell.board.mode == MoteusMode.BRAKE
    cell.mock.forced_error = OVER_HEATED
    cell.run(0.02)
    assert (cell.board.mode, cell.board.fault) == (MoteusMode.FAULT, OVER_HEATED)
    assert not cell.board.reset_fault()
    cell.mock.forced_error = 0
    assert cell.board.reset_fault()


@pytest.mark.parametrize(
    ("payload", "said"),
    [
        (b"\x30\xab\x02\x01", "register 0x12b cannot be written"),
        (b"\x2c\x04\x01\x00\x00", "cannot be read"),
        (b"\x21\x00\x0a", "of 3 bytes cannot be read"),
        (b"\x77", "subframe 0x77"),
        (b"\x24", "cut short"),
    ],
)
def test_a_reply_that_cannot_be_read_is_a_violation_and_changes_nothing(payload: bytes, said: str) -> None:
    cell = Cell()
    cell.run(0.008)
    before = cell.board.count, cell.board.at_s
    cell.wired.put(ID << 8, payload)
    with pytest.raises(ProtocolViolation, match=said):
        cell.bus.update()
    assert (cell.board.count, cell.board.at_s) == before


def test_a_frame_of_another_board_or_to_another_host_is_left_alone() -> None:
    cell = Cell()
    cell.wired.put(6 << 8, b"\x77")
    cell.wired.put(ID << 8 | 3, b"\x77")
    cell.bus.update()
    assert not cell.board.is_known
    assert Register.MODE == 0
