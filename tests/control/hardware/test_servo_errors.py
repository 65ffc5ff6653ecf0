"""An error of a smart servo lets its joint go only where the servo's own settings say so; and what delayed answers cost."""

from __future__ import annotations

import pytest

from control.hardware.bought.smart_servo import DYNAMIXEL, FEETECH
from control.hardware.connect import connect
from control.safety.modes import Mode, Reaction
from firmware_iface.errors import ConnectionFailed
from hil_mocks.devices import dynamixel as dynamixel_mock
from hil_mocks.devices import feetech as feetech_mock
from hil_mocks.rig import SteppedRig
from tests.cell import Cell, holding_cell, scenario, wired_to
from tests.kinds import ON_BOARDS

SECOND = {"dynamixel": "servo2", "feetech": "feetech2"}
LOWEST_dV = 237  # the servo allows no less than 23.7 V, of 24
SAGGED_V = 23.5
VOLTAGE = 0x01
MOCKS = {"dynamixel": dynamixel_mock, "feetech": feetech_mock}
VOLTAGES = {"dynamixel": slice(32, 36), "feetech": slice(14, 16)}  # highest and lowest, as stored
LOWEST_VOLTAGE = {"dynamixel": 34, "feetech": 15}  # registers
UNLOADS_AT = {"dynamixel": 63, "feetech": 19}
AT_DELIVERY = {"dynamixel": 52, "feetech": 44}
RETURN_DELAY = {"dynamixel": 9, "feetech": 7}


@pytest.fixture(params=["dynamixel", "feetech"])
def kind(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def store(monkeypatch: pytest.MonkeyPatch, kind: str, unloads_at: int) -> None:
    """Mock servos of the kind with this lowest voltage, and these errors at which they let go."""
    mock = MOCKS[kind]
    monkeypatch.setitem(mock.STORED, LOWEST_VOLTAGE[kind], LOWEST_dV)
    monkeypatch.setitem(mock.STORED, UNLOADS_AT[kind], unloads_at)


def moved_rad(cell: Cell, before_rad: tuple[float, ...]) -> float:
    return max(abs(q - p) for q, p in zip(cell.rig.joint_rad(), before_rad, strict=True))


def test_a_supply_that_sags_is_a_fault_of_an_arm_that_is_held(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    store(monkeypatch, kind, AT_DELIVERY[kind])
    on = ON_BOARDS[kind]
    with holding_cell(scenario(), on.arm, period_s=on.period_s) as cell:
        before_rad = tuple(cell.rig.joint_rad())
        cell.inject("supply", SECOND[kind], value=SAGGED_V)
        cell.until_fault(0.5)
        assert cell.faults == [("drive_fault", "joint 2")]
        assert cell.runtime.monitor.reaction is Reaction.HOLD
        assert "cannot be acknowledged" in cell.refusal(do="acknowledge")
        cell.run(1.0)
        cell.rig.clear_faults()
        cell.run(0.2)
        cell.client.ask("acknowledge")
        cell.run(0.2)
        cell.client.enable()
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])
        assert moved_rad(cell, before_rad) < 5e-3


def test_a_servo_that_is_set_up_to_let_go_at_low_voltage_is_not_taken_again_when_that_ends(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store(monkeypatch, kind, AT_DELIVERY[kind] | VOLTAGE)
    on = ON_BOARDS[kind]
    with holding_cell(scenario(), on.arm, period_s=on.period_s) as cell:
        cell.inject("supply", SECOND[kind], value=SAGGED_V)
        cell.until_fault(0.5)
        cell.rig.clear_faults()
        for _ in range(30):
            cell.run(0.01)
            assert cell.torques()[1] is False


def test_the_connection_says_at_which_errors_a_joint_is_let_go(kind: str) -> None:
    on = ON_BOARDS[kind]
    with SteppedRig(on.arm, scenario()) as rig:
        connection = connect(wired_to(on.arm, rig), rig.clock, on.period_s)
        assert all("free at heat" in said and "holds on at voltage" in said for _, said in connection.others)
        connection.close()


def test_answers_that_servos_delay_cost_a_rate_that_is_told_or_refused(kind: str) -> None:
    """0.5 ms, as from the factory."""
    arm = ON_BOARDS[kind].arm
    cycle_s = {"dynamixel": DYNAMIXEL, "feetech": FEETECH}[kind].cycle_s
    slow_Hz, fast_Hz = int(1.0 / cycle_s(3, 1_000_000, [5e-4] * 3)), int(1.0 / cycle_s(3, 1_000_000))
    remedy = rf"set return delay time (register {RETURN_DELAY[kind]}) of id 1, 2, 3 to 0: up to {fast_Hz} Hz"
    with SteppedRig(arm, scenario()) as rig:
        for servo in rig.robot.bought.lines[0].servos.values():
            servo.table[RETURN_DELAY[kind]] = 250
        wired = wired_to(arm, rig)
        connection = connect(wired, rig.clock, 0.01)
        assert connection.others[-1][1] == f"carries {slow_Hz} Hz; {remedy}"
        connection.close()
        with pytest.raises(ConnectionFailed) as refused:
            connect(wired, rig.clock, 1.0 / (slow_Hz + 10))
        assert f"serve with --rate {slow_Hz} or less, or {remedy}" in str(refused.value)


def test_a_servo_that_stores_no_voltage_limits_is_taken_at_any_supply(kind: str) -> None:
    """Zeros say nothing of its version, so they are no reason to refuse it."""
    on = ON_BOARDS[kind]
    with SteppedRig(on.arm, scenario()) as rig:
        for servo in rig.robot.bought.lines[0].servos.values():
            at = VOLTAGES[kind]
            servo.table[at] = bytes(at.stop - at.start)
        connect(wired_to(on.arm, rig), rig.clock, on.period_s).close()
