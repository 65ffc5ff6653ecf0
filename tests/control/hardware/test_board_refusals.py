"""What boards themselves refuse before anything moves, and how a VESC turns to an angle."""

import math
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import pytest

from control.model.drive import JointMap
from control.safety.modes import Mode
from firmware_iface import vesc
from firmware_iface.canopen import MAKERS
from firmware_iface.errors import ConnectionFailed
from firmware_iface.roboclaw import RoboclawCommand
from hil_mocks.devices import roboclaw
from hil_mocks.devices.cia402_drive import MAXON, Cia402Mock, Cia402Setup
from hil_mocks.devices.moteus import MoteusMock, MoteusSetup
from hil_mocks.devices.vesc import VescMock, VescSetup
from procedures.on_boards import on_boards
from tests.cell import RIGHT, holding_cell, open_cell, scenario, with_drives

ON_VESCS = on_boards(RIGHT, "vesc")


def test_a_vesc_that_would_turn_the_shorter_way_is_refused_when_it_is_connected() -> None:
    arm = with_drives(ON_VESCS, pid=replace(ON_VESCS.drives[0].pid, mode="position"))
    with pytest.raises(ConnectionFailed, match="a range below half a turn"), open_cell(scenario(), arm, period_s=0.005):
        pass


def test_a_vesc_at_its_joint_and_within_half_a_turn_takes_angles() -> None:
    arm = with_drives(
        ON_VESCS, pid=replace(ON_VESCS.drives[0].pid, mode="position"), gear_ratio=1.0, joint_lower_rad=-1.2, joint_upper_rad=1.2
    )
    with open_cell(scenario(), arm, period_s=0.005) as cell:
        assert cell.mode is Mode.OFF


def test_a_roboclaw_whose_pins_tell_of_no_switch_is_refused_where_the_joint_has_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(roboclaw.DELIVERED, RoboclawCommand.READ_PIN_MODES, bytes(5))
    with (
        pytest.raises(ConnectionFailed, match='expected S4 as "Home'),
        open_cell(scenario(), on_boards(RIGHT, "roboclaw"), period_s=0.01),
    ):
        pass


def test_a_roboclaw_that_lets_its_motor_go_at_duty_0_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(roboclaw.DELIVERED, RoboclawCommand.READ_PWM_IDLE, b"\0\x8f")
    with (
        pytest.raises(ConnectionFailed, match=r"PWM idle of motor 2 off, it is on after 1.5 s at"),
        open_cell(scenario(), on_boards(RIGHT, "roboclaw"), period_s=0.01),
    ):
        pass


def test_a_roboclaw_is_not_told_a_current_beyond_its_peak() -> None:
    arm = with_drives(on_boards(RIGHT, "roboclaw"), current_limit_A=40.0)
    with (
        pytest.raises(ConnectionFailed, match=r"current_limit_A = 40 is above the 30 A .*2x15A"),
        open_cell(scenario(), arm, period_s=0.01),
    ):
        pass


def test_a_drive_whose_rated_torque_and_current_contradict_the_arm_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rated torque in another unit would make a thousandth, or a thousandfold, of every torque."""
    monkeypatch.setitem(MAKERS, MAXON, replace(MAKERS[MAXON], rated_torque_unit_Nm=1e-3))
    with (
        pytest.raises(ConnectionFailed, match=r"rated torque \(0x6076\) is 500 N m, but .* makes 0.5 N m"),
        open_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004),
    ):
        pass


def test_a_drive_that_trips_before_the_loop_stops_the_arm_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = on_boards(RIGHT, "cia402")
    rad_per_count = min(abs(JointMap(drive).radians_per_count) for drive in arm.drives)
    needed = math.ceil(arm.limits.following_error_rad / rad_per_count)
    made = "hil_mocks.bought.Cia402Setup"
    monkeypatch.setattr(made, partial(Cia402Setup, following_error_window=needed))
    with open_cell(scenario(), arm, period_s=0.004) as cell:
        assert cell.mode is Mode.OFF
    monkeypatch.setattr(made, partial(Cia402Setup, following_error_window=needed - 1))
    with (
        pytest.raises(ConnectionFailed, match=rf"window \(0x6065\) of {needed} increments or more"),
        open_cell(scenario(), arm, period_s=0.004),
    ):
        pass


@pytest.mark.parametrize(("code", "said"), [(0, "frees its motor at once"), (2, "quick stop ramp"), (-1, "0x605E = -1")])
def test_what_a_drive_does_at_a_fault_is_told(code: int, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil_mocks.bought.Cia402Setup", partial(Cia402Setup, fault_reaction=code))
    with open_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004) as cell:
        told = [identity for where, identity in cell.connection.others if "CiA 402" in where]
        assert len(told) == 3
        assert all(said in identity for identity in told)


@pytest.mark.parametrize("has_current", [True, False])
def test_a_drive_without_a_rated_torque_has_that_of_its_rated_current(has_current: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    power_up = Cia402Mock.power_up

    def unset(mock: Cia402Mock, now_s: float | None = None) -> None:
        power_up(mock, now_s)
        mock.objects[0x6076, 0] = ("u32", 0)
        if not has_current:
            mock.objects.pop((0x6075, 0), None)
            mock.objects[0x3001, 1] = ("u32", 0)

    monkeypatch.setattr(Cia402Mock, "power_up", unset)
    refused = pytest.raises(ConnectionFailed, match=r"expected a motor rated torque \(0x6076\), or a rated current")
    with nullcontext() if has_current else refused, open_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004) as cell:
        told = [identity for where, identity in cell.connection.others if "CiA 402" in where]
        assert all("; no rated torque (0x6076): taken for 0.5 N m, by its rated current" in text for text in told)


def test_a_drive_that_does_not_have_the_mode_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil_mocks.bought.Cia402Setup", partial(Cia402Setup, modes=0x0300))
    with (
        pytest.raises(ConnectionFailed, match=r"expected cyclic synchronous position \(bit 7 of 0x6502\), it has 0x00000300"),
        open_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004),
    ):
        pass


def test_what_a_drive_says_of_units_and_interpolation_is_told_and_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    doubtful = partial(Cia402Setup, modes=0, position_unit=0x0041_0000, has_cycle_time=False)
    monkeypatch.setattr("hil_mocks.bought.Cia402Setup", doubtful)
    with holding_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004) as cell:
        told = [identity for where, identity in cell.connection.others if "CiA 402" in where]
        assert all(text.endswith("; its positions are in units of 0x60A8 = 0x00410000; it has no 0x60C2") for text in told)
        cell.run(0.2)
        assert cell.mode is Mode.HOLDING


def test_a_drive_that_leaves_its_following_error_window_trips_and_the_loop_says_so() -> None:
    """Windows made too narrow while `serve` runs: the EPOS4 of joint 2 trips, a plain drive says it by bit 13 and goes on."""
    with holding_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004) as cell:
        (drives,) = cell.rig.robot.bought.on_can
        first, second, _ = drives.mocks
        assert isinstance(first, Cia402Mock)
        assert isinstance(second, Cia402Mock)
        behind: list[bool] = []
        cell.watchers.append(lambda: behind.append(bool(first.value(0x6041) & 0x2000)))
        cell.run(1.0)
        for drive in (first, second):
            drive.objects[0x6065, 0], drive.objects[0x6066, 0] = ("u32", 20), ("u16", 10)
        cell.run(0.1)
        assert (cell.mode, any(behind)) == (Mode.HOLDING, False)
        cell.client.ask("jog", joint=1, by_rad=0.3, speed_rad_s=0.3)
        cell.run(1.0)
        assert (cell.mode, any(behind), first.error) == (Mode.HOLDING, True, 0)
        cell.client.ask("jog", joint=2, by_rad=0.3, speed_rad_s=0.3)
        cell.until_fault(2.0)
        assert (second.error, cell.faults) == (0x8611, [("drive_fault", "joint 2")])


@pytest.mark.parametrize("joint", [1, 2])
def test_a_drive_whose_supply_is_told_no_more_is_silent(joint: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plain drive's PDO, and the EPOS4's answers to SDO, end; all other values go on."""
    take, lost = Cia402Mock.receive, False

    def receive(mock: Cia402Mock, can_id: int, payload: bytes, now_s: float) -> None:
        answered = len(mock.outgoing)
        take(mock, can_id, payload, now_s)
        if lost and mock.setup.node == joint:
            gone = 0x280 if joint == 1 else 0x580
            mock.outgoing[answered:] = [f for f in mock.outgoing[answered:] if f[0] != gone + joint]

    monkeypatch.setattr(Cia402Mock, "receive", receive)
    with holding_cell(scenario(), on_boards(RIGHT, "cia402"), period_s=0.004) as cell:
        cell.run(2.0)
        assert cell.mode is Mode.HOLDING
        lost = True
        cell.until_fault(1.0)
        assert cell.faults == [("drive_silent", f"joint {joint}")]


@pytest.mark.parametrize(
    ("name", "stored", "said"),
    [
        ("servo.timeout_mode", "12", r"expected servo.timeout_mode 10 \(holds without the host\) or 15 \(brakes\), it is 12"),
        ("servo.bemf_feedforward", "1.0", r"expected servo.bemf_feedforward 0 \(.*\), it is 1"),
        ("servo.voltage_mode_control", "1", "expected servo.voltage_mode_control 0, it is 1"),
        ("servo.max_current_A", "0.5", "expected servo.max_current_A current_limit_A or more, it is 0.5"),
        ("aux1.pins.0.mode", "0", r"expected aux1.pins.0.mode 14 \(the home switch\), it is 0"),
        ("motor.Kv", "200.0", r"its motor.Kv 200 makes 0.0413 N m/A, torque_constant_Nm_A is 0.0302"),
    ],
)
def test_what_is_stored_in_a_moteus_is_compared_when_it_is_connected(
    name: str, stored: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_set_up = MoteusSetup.stored
    monkeypatch.setattr(MoteusSetup, "stored", lambda setup: {**as_set_up(setup), name: stored})
    with pytest.raises(ConnectionFailed, match=said), open_cell(scenario(), on_boards(RIGHT, "moteus"), period_s=0.004):
        pass


def test_a_moteus_whose_console_never_ends_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MoteusMock, "_says", property(lambda _: b"telemetry ", lambda *_: None), raising=False)
    with (
        pytest.raises(ConnectionFailed, match="expected a console that answers, it goes on talking"),
        open_cell(scenario(), on_boards(RIGHT, "moteus"), period_s=0.004),
    ):
        pass


@pytest.mark.parametrize("kv", ["inf", "-inf", "0", "nan", ""])
def test_a_kv_that_is_none_is_not_compared(kv: str, monkeypatch: pytest.MonkeyPatch) -> None:
    as_set_up = MoteusSetup.stored
    monkeypatch.setattr(MoteusSetup, "stored", lambda setup: {**as_set_up(setup), "motor.Kv": kv})
    with open_cell(scenario(), on_boards(RIGHT, "moteus"), period_s=0.004) as cell:
        assert cell.mode is Mode.OFF


def test_a_moteus_without_a_console_is_taken_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil_mocks.bought.MoteusSetup", partial(MoteusSetup, has_console=False, timeout_mode=10))
    with open_cell(scenario(), on_boards(RIGHT, "moteus"), period_s=0.004) as cell:
        told = [identity for where, identity in cell.connection.others if "moteus" in where]
        assert all("its console is silent: look at servo.timeout_mode, " in text for text in told)


def test_a_moteus_of_older_firmware_which_says_no_kv_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    as_set_up = MoteusSetup.stored

    def without_kv(setup: MoteusSetup) -> dict[str, str]:
        return {name: value for name, value in as_set_up(setup).items() if name != "motor.Kv"}

    monkeypatch.setattr(MoteusSetup, "stored", without_kv)
    with open_cell(scenario(), on_boards(RIGHT, "moteus"), period_s=0.004) as cell:
        assert cell.mode is Mode.OFF


@pytest.mark.parametrize(
    ("stored", "said"),
    [
        ({"timeout_s": 1.0}, "expected a time-out up to 0.2 s, it is 1 s: set it in VESC Tool"),
        ({"timeout_s": 0.0}, "expected a time-out up to 0.2 s, it is 0 s"),
        ({"timeout_brake_A": 0.0}, "expected a brake current after it, it is 0 A: the motor is free then"),
        ({"application": 2}, "expected no application, or UART, it is number 2, which commands it, too"),
    ],
)
def test_a_vesc_whose_time_out_or_application_is_not_as_needed_is_refused(
    stored: dict[str, float], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil_mocks.bought.VescSetup", partial(VescSetup, **stored))
    with pytest.raises(ConnectionFailed, match=said), open_cell(scenario(), ON_VESCS, period_s=0.005):
        pass


def test_a_vesc_turns_to_an_angle_the_shorter_way() -> None:
    mock = VescMock(VescSetup(5, 0.2, 8.0), lambda: 0.9)
    for moment, (count, sign) in enumerate(((vesc.COUNTS_PER_TURN // 10, 1.0), (vesc.COUNTS_PER_TURN // 2, -1.0))):
        mock.receive(*vesc.position(5, count), now_s=0.001 * moment)
        mock.tick(0.001 * (1 + moment), 0.0, 24.0)
        kind, volts = mock.output
        assert kind == "voltage"
        assert volts * sign > 0.0
