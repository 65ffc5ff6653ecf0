"""The host pauses or dies: the boards bring the arm to rest and hold it, and a host that comes back goes on from there."""

from __future__ import annotations

import pytest

from control.hardware.board_stop import BoardStop, board_stop, stop_after_s
from control.safety.modes import Mode
from procedures.on_boards import on_boards
from tests.cell import RIGHT, Cell, holding_cell, scenario, with_drives

START = (-1.2, -0.6, 0.2)
FULL_SPEED_rad_s = 2.0


def away(cell: Cell, pause_s: float) -> None:
    """The loop stands still; the boards and the arm do not."""
    cell.rig.clock.wait_until_s(cell.rig.clock.now_s() + pause_s)


def moving_cell(mode: str = "voltage") -> object:
    return holding_cell(scenario(START), with_drives(RIGHT, pid=type(RIGHT.drives[0].pid)(mode=mode)))  # type: ignore[arg-type]


def test_the_law_of_a_stop_is_continuous_and_ends_at_rest() -> None:
    stop = BoardStop(0.024, 0.1)
    assert stop.bridge(0.024) is None
    assert stop.bridge(0.0240001) == pytest.approx((0.024, 1.0), abs=1e-5)
    assert stop.bridge(0.074) == pytest.approx((0.024 + 0.0375, 0.5))
    assert stop.bridge(0.124) == pytest.approx((0.074, 0.0))
    assert stop.bridge(9.0) == pytest.approx((0.074, 0.0))
    staying = BoardStop(0.01, 0.1, follows=False)
    assert staying.bridge(0.01001) == pytest.approx((0.0, 1.0), abs=1e-3)
    assert staying.bridge(0.035) == pytest.approx((0.0, 0.5))
    assert staying.bridge(0.2) == (0.0, 0.0)


def test_the_boards_wait_some_cycles_and_brake_harder_than_a_motion() -> None:
    assert [stop_after_s(period_s) for period_s in (0.0005, 0.002, 0.01)] == [0.01, 0.024, 0.05]
    assert board_stop(RIGHT, 0.002) == (0.024, 0.1, True)


def test_boards_that_stay_at_a_position_stop_the_motion_and_those_that_move_on_let_it_go_on() -> None:
    watchdog_s = RIGHT.limits.watchdog_s
    assert board_stop(on_boards(RIGHT, "dynamixel"), 0.01) == (0.01, 0.1, False)
    assert board_stop(on_boards(RIGHT, "cia402"), 0.004) == (0.01, 0.1, False)
    assert board_stop(on_boards(RIGHT, "moteus"), 0.004) == (watchdog_s, 0.1, True)
    assert board_stop(on_boards(RIGHT, "roboclaw"), 0.01).after_s == watchdog_s


@pytest.mark.parametrize("pause_s", [0.03, 0.06, 0.1, 0.15])
def test_a_pause_at_full_speed_trips_nothing_and_the_arm_goes_on_along_its_path(pause_s: float) -> None:
    with moving_cell() as cell:
        cell.start_move((1.4, -0.6, 0.2))
        cell.run(0.6)
        begun = cell.rig.joint_rad()[0]
        away(cell, pause_s)
        moved = cell.rig.joint_rad()[0] - begun
        assert moved < FULL_SPEED_rad_s * 0.074 + 0.005
        speeds = cell.true_speeds()
        cell.run(0.01)
        assert cell.runtime.set_point.q_rad[0] == pytest.approx(cell.rig.joint_rad()[0], abs=0.02)
        cell.until(lambda: cell.mode is Mode.HOLDING, 2.5)
        assert not cell.faults
        assert cell.rig.joint_rad() == pytest.approx((1.4, -0.6, 0.2), abs=2e-3)
        assert max(speeds) < 1.05 * FULL_SPEED_rad_s


@pytest.mark.parametrize("pause_s", [0.05, 0.12, 0.17])
def test_a_jog_takes_a_pause_without_a_leap_or_a_snap(pause_s: float) -> None:
    with moving_cell() as cell:
        cell.channel.request({"do": "jog", "joint_speed_rad_s": [0.3, 0.0, 0.0]})
        cell.run(0.15)
        away(cell, pause_s)
        before = cell.rig.joint_rad()[0]
        speeds = cell.true_speeds()
        cell.run(0.3)
        assert max(speeds) < 0.35
        assert cell.rig.joint_rad()[0] > before - 1e-3
        assert not cell.faults


def test_homing_goes_on_after_a_pause() -> None:
    with holding_cell(scenario((0.3, -0.2, 0.9), homed=False)) as cell:
        cell.client.ask("home")
        for _ in range(6):
            cell.run(0.25)
            away(cell, 0.1)
        cell.until(lambda: cell.mode is Mode.HOLDING, 30.0)
        assert not cell.faults
        assert cell.runtime.parts.measurement.q_rad == pytest.approx(cell.rig.joint_rad(), abs=1e-4)


@pytest.mark.parametrize("mode", ["voltage", "current", "position"])
def test_when_the_loop_dies_the_boards_stop_the_arm_and_hold_it(mode: str) -> None:
    with moving_cell(mode) as cell:
        cell.start_move((1.4, -0.6, 0.2))
        cell.run(0.6)
        begun = cell.rig.joint_rad()
        away(cell, 0.15)
        stood = cell.rig.joint_rad()
        assert stood[0] - begun[0] < FULL_SPEED_rad_s * 0.074 + 0.01  # 0.37 rad with the watchdog alone
        away(cell, 1.0)
        assert cell.rig.joint_rad() == pytest.approx(stood, abs=6e-3)  # a position mode's PID swings a little


def test_a_board_that_cannot_hold_brakes_and_a_pause_still_trips_nothing() -> None:
    with holding_cell(scenario(START), with_drives(RIGHT, board_holds=False)) as cell:
        cell.start_move((1.4, -0.6, 0.2))
        cell.run(0.6)
        begun = cell.rig.joint_rad()[0]
        away(cell, 0.1)
        assert cell.rig.joint_rad()[0] - begun < 0.12
        assert [board.output for board in cell.rig.robot.motor_boards] == [("voltage", 0.0)] * 3
        cell.until(lambda: cell.mode is Mode.HOLDING, 2.5)
        assert not cell.faults


def test_a_pause_beyond_the_watchdog_is_a_fault_and_the_arm_has_not_sunk() -> None:
    with moving_cell() as cell:
        cell.run(0.3)
        held = cell.rig.joint_rad()
        away(cell, 0.4)
        cell.until_fault(0.05)
        assert {code for code, _ in cell.faults} >= {"drive_fault"}
        assert cell.rig.joint_rad() == pytest.approx(held, abs=1e-4)


@pytest.mark.parametrize("pause_s", [0.008, 0.02, 0.04])
def test_a_host_that_stumbles_again_and_again_trips_nothing(pause_s: float) -> None:
    with moving_cell() as cell:
        cell.start_move((0.6, -0.2, 0.7))
        for _ in range(400):  # it is away for three quarters of the time
            cell.run(0.014)
            away(cell, pause_s)
            if cell.mode is Mode.HOLDING:
                break
        assert (cell.mode, cell.faults) == (Mode.HOLDING, [])
        assert cell.rig.joint_rad() == pytest.approx((0.6, -0.2, 0.7), abs=5e-3)
