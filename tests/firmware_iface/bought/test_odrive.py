"""ODrive on CAN: golden frames, an axis that is silent, restarted or not calibrated, and what the host asks for when."""

from typing import Any

import pytest

from firmware_iface import odrive
from firmware_iface.errors import (
    BoardFaulted,
    BoardRefused,
    BoardReset,
    BoardSilent,
    MisuseError,
    ProtocolViolation,
    WrongIdentity,
)
from firmware_iface.odrive import AxisState, Error, OdriveAxis, OdriveBus, OdriveCommand, OdriveControlMode
from hil_mocks.devices.odrive import CLOSED_LOOP, ESTOP, IDLE, OdriveMock, OdriveSetup
from tests.firmware_iface.mock_wire import BusRig, golden

NODE, CPR = 5, 8192


class Cell(BusRig[OdriveBus]):
    def __init__(self, **setup: Any) -> None:
        self.turns = 0.0
        self.mock = OdriveMock(OdriveSetup(NODE, 0.05, 8.0, **setup), lambda: self.turns)
        super().__init__(self.mock, OdriveBus)
        self.axis = OdriveAxis(self.bus, NODE, "elbow", CPR)


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("SET_AXIS_STATE closed loop", odrive.axis_state(NODE, AxisState.CLOSED_LOOP_CONTROL)),
        ("SET_CONTROLLER_MODE torque", odrive.controller_mode(NODE, OdriveControlMode.TORQUE)),
        ("SET_INPUT_POS -1.5 turns, 2.5 turns/s", odrive.position(NODE, -1.5, 2.5)),
        ("SET_INPUT_TORQUE 0.25 Nm", odrive.torque(NODE, 0.25)),
        ("SET_LIMITS 20 turns/s, 8 A", odrive.limits(NODE, 20.0, 8.0)),
        ("CLEAR_ERRORS", odrive.clear_errors(NODE)),
    ],
)
def test_what_is_sent_is_what_the_document_says(name: str, made: odrive.Frame) -> None:
    assert made == golden("odrive.txt", name)


def test_what_the_document_says_is_read() -> None:
    assert odrive.heartbeat(golden("odrive.txt", "HEARTBEAT watchdog, closed loop, disarmed")[1]) == (
        Error.WATCHDOG_TIMER_EXPIRED,
        AxisState.CLOSED_LOOP_CONTROL,
        3,
    )
    assert odrive.pair(golden("odrive.txt", "ENCODER 2.5 turns, -0.5 turns/s")[1]) == (2.5, -0.5)
    assert odrive.pair(golden("odrive.txt", "BUS 24 V, 1 A")[1]) == (24.0, 1.0)


@pytest.mark.parametrize("periods_s", [OdriveSetup(0, 0.05, 8.0).periods_s, ()])
def test_firmware_0_5_is_told_by_its_answer_and_refused(periods_s: tuple[tuple[int, float], ...]) -> None:
    cell = Cell(is_firmware_5=True, periods_s=periods_s)
    with pytest.raises(WrongIdentity, match=r"expected firmware 0.6, it is 0.5"):
        cell.axis.identify()
    assert [can_id & 0x1F for can_id, payload in cell.wired.sent] == [OdriveCommand.SENSORLESS_ERROR]


def test_answers_about_settings_that_another_program_asks_for_are_no_firmware_0_5() -> None:
    """0.6.10's DBC: TxSdo is u8, u16 which setting, u8, and the value."""
    cell = Cell()
    cell.wired.put(odrive.frame_id(NODE, 0x05), bytes((0, 0x85, 0x01, 0)) + bytes(4))
    cell.axis.identify()


def test_a_torque_begins_with_its_own_value_and_the_state_is_asked_for_once() -> None:
    cell = Cell()
    cell.axis.identify()
    cell.wired.sent.clear()
    cell.axis.want_torque(0.1)
    cell.run(0.08)
    asked = [can_id & 0x1F for can_id, _ in cell.wired.sent]
    assert asked[:3] == [OdriveCommand.SET_INPUT_TORQUE, OdriveCommand.SET_CONTROLLER_MODE, OdriveCommand.SET_AXIS_STATE]
    assert asked.count(OdriveCommand.SET_AXIS_STATE) == 1
    assert (cell.axis.is_driving, cell.mock.output) == (True, ("current", pytest.approx(2.0)))


def test_from_torque_to_position_the_new_input_comes_before_the_new_mode() -> None:
    cell = Cell()
    cell.axis.identify()
    cell.axis.want_torque(0.0)
    cell.run(0.08)
    cell.turns = 3.0
    cell.run(0.2)
    cell.wired.sent.clear()
    cell.axis.want_count(3 * CPR)
    cell.run(0.02)
    assert [can_id & 0x1F for can_id, _ in cell.wired.sent[:2]] == [
        OdriveCommand.SET_INPUT_POS,
        OdriveCommand.SET_CONTROLLER_MODE,
    ]
    assert cell.mock.output == ("voltage", pytest.approx(0.0, abs=1e-6))
    assert cell.axis.count == 3 * CPR


def test_a_silent_axis_and_one_without_messages_say_what_to_do() -> None:
    cell = Cell()
    cell.wired.is_cut = True
    with pytest.raises(BoardSilent, match=r'"elbow" \(node 5\) on memory: .* check its supply, node id 5 and bit rate'):
        cell.axis.identify()
    without_iq = tuple(
        (command, period_s) for command, period_s in OdriveSetup(0, 1.0, 1.0).periods_s if command != OdriveCommand.IQ
    )
    with pytest.raises(BoardSilent, match=r"no IQ within .* set iq_msg_rate_ms = 4 in axis0\.config\.can"):
        Cell(periods_s=without_iq).axis.identify()
    with pytest.raises(MisuseError, match="0 to 62, got 63"):
        OdriveAxis(cell.bus, 63, "elbow", CPR)


def test_a_watchdog_that_expired_for_want_of_a_host_is_no_fault_but_another_error_is() -> None:
    cell = Cell()
    cell.wired.run(0.3)
    assert cell.mock.errors == Error.WATCHDOG_TIMER_EXPIRED
    cell.axis.identify()
    assert not cell.axis.errors
    cell.mock.receive(odrive.frame_id(NODE, ESTOP), b"", cell.wired.now_s())
    cell.wired.run(0.3)
    cell.axis.identify()
    assert cell.axis.errors == Error.ESTOP_REQUESTED | Error.WATCHDOG_TIMER_EXPIRED


@pytest.mark.parametrize("is_wanted", [True, False], ids=["in operation", "while it is told to stop"])
def test_a_restart_in_operation_is_noticed_and_does_not_lead_back_into_it(is_wanted: bool) -> None:
    cell = Cell()
    cell.axis.identify()
    cell.axis.want_torque(0.0)
    cell.run(0.08)
    cell.mock.power_up(cell.wired.now_s())
    if not is_wanted:
        cell.axis.want_idle()
    with pytest.raises(BoardReset, match="restarted by itself"):
        cell.run(0.3)
    cell.run(0.3)
    assert (cell.axis.resets, cell.mock.state) == (1, IDLE)


def test_an_operation_that_the_host_ends_is_no_restart() -> None:
    cell = Cell()
    cell.axis.identify()
    for _ in range(2):
        cell.axis.want_torque(0.0)
        cell.run(0.12)
        assert cell.mock.state == CLOSED_LOOP
        cell.axis.want_idle()
        cell.run(0.12)
        assert cell.mock.state == IDLE
    assert cell.axis.resets == 0


def test_an_axis_that_is_not_calibrated_says_so() -> None:
    cell = Cell(is_calibrated=False)
    cell.axis.identify()
    cell.axis.want_torque(0.0)
    with pytest.raises(BoardRefused, match=r"procedure result 14\): calibrate it"):
        cell.run(0.1)


def test_a_position_that_is_no_number_is_refused() -> None:
    cell = Cell()
    cell.axis.identify()
    cell.turns = float("nan")
    with pytest.raises(BoardFaulted, match="no position"):
        cell.run(0.05)


def test_a_frame_of_another_length_is_a_violation_and_changes_nothing() -> None:
    cell = Cell()
    cell.axis.identify()
    cell.wired.put(odrive.frame_id(NODE, OdriveCommand.BUS), b"\x00\x01")
    with pytest.raises(ProtocolViolation, match="command 0x17 with 2 bytes"):
        cell.bus.update()
    assert cell.axis.supply_V == 24.0


def test_a_heartbeat_without_what_follows_the_result_is_read() -> None:
    assert odrive.heartbeat(bytes((0, 0, 0, 1, 8, 3))) == odrive.heartbeat(bytes((0, 0, 0, 1, 8, 3, 1, 0)))


def test_without_commands_the_watchdog_frees_the_motor_until_the_errors_are_cleared() -> None:
    cell = Cell()
    cell.axis.identify()
    cell.axis.want_torque(0.1)
    cell.run(0.08)
    cell.wired.run(0.2)
    cell.bus.update()
    assert (cell.axis.errors, cell.mock.output.kind) == (Error.WATCHDOG_TIMER_EXPIRED, "open")
    assert cell.axis.clear_errors()
