"""Every fault that the mock can have, in a moving or holding arm: found in time, answered rightly, and no joint runs away."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import pytest

from control.loop import drives
from control.model.arm import Limits
from control.safety.modes import Event, Mode
from control.server.client import ArmFaulted, RequestRefused
from firmware_iface.errors import LinkLost
from tests.cell import FRICTION, RIGHT, STRETCHED, Cell, holding_cell, open_cell, scenario

STALE_s = Limits().stale_s
CYCLE_s = 0.002
FALL_rad_s = 0.6  # shorted windings let the stretched arm down more slowly than this
TARGET = (0.5, -0.3, 0.5)


@pytest.fixture
def moving(cell: Cell) -> Cell:
    """The arm in the middle of a joint move."""
    cell.start_move(TARGET)
    cell.run(0.2)
    assert cell.mode is Mode.MOVING
    return cell


def sinks_gently(cell: Cell, duration_s: float = 0.3) -> None:
    """The arm brakes, or its boards stop it: it slows down at once and never falls faster than shorted windings allow."""
    speeds = cell.true_speeds()
    cell.run(duration_s)
    assert speeds[30] < speeds[10] + 0.1
    assert max(speeds[60:]) < FALL_rad_s  # a board's stop takes 0.1 s
    assert cell.mode is Mode.FAULT
    assert set(cell.runtime.parts.servo.volts) == {0.0}


@pytest.mark.parametrize(
    ("kind", "board", "keys", "code", "where", "limit_s"),
    [
        ("silent", "encoder", {}, "encoder_stale", "encoder board", STALE_s + 5 * CYCLE_s),
        ("lost_wire", "encoder", {"channel": 2}, "encoder_signal", "joint 3", 4 * CYCLE_s),
        ("quadrature_error", "encoder", {"channel": 1}, "encoder_miscount", "joint 2", 4 * CYCLE_s),
        ("over_temperature", "motor3", {}, "drive_fault", "joint 3", 4 * CYCLE_s),
        ("encoder_fault", "motor2", {}, "drive_fault", "joint 2", 4 * CYCLE_s),
        ("supply", "motor2", {"value": 5.0}, "drive_fault", "joint 2", 4 * CYCLE_s),
    ],
)
def test_a_board_that_fails_while_moving_brakes_the_arm_in_time_and_is_named(
    moving: Cell, kind: str, board: str, keys: dict[str, float], code: str, where: str, limit_s: float
) -> None:
    moving.inject(kind, board, **keys)
    moving.until_fault(limit_s)
    assert (code, where) in moving.faults
    sinks_gently(moving)


@pytest.mark.parametrize("board", ["encoder", "motor1"])
def test_a_board_that_is_reset_while_moving_brakes_the_arm_and_says_so(moving: Cell, board: str) -> None:
    moving.inject("board_reset", board)
    moving.until_fault(0.1)
    assert moving.runtime.monitor.reaction is not None
    sinks_gently(moving)
    assert moving.refusal(do="move_joints", q_rad=list(STRETCHED))


def test_an_encoder_board_that_was_reset_is_homed_again_before_the_arm_moves(moving: Cell) -> None:
    moving.inject("board_reset", "encoder")
    moving.until_fault(0.1)
    moving.run(0.2)
    moving.client.acknowledge()
    moving.client.hold()
    assert not moving.client.status()["is_homed"]
    assert "home" in moving.refusal(do="move_joints", q_rad=list(STRETCHED))


def test_a_watchdog_that_expires_is_a_fault_of_its_drive() -> None:
    with holding_cell() as cell:
        cell.run(0.3)
        begun_s, held = cell.rig.clock.now_s(), cell.rig.joint_rad()
        cell.rig.clock.wait_until_s(begun_s + 1.2 * Limits().watchdog_s)  # the loop itself stands still
        cell.until_fault(0.05)
        assert cell.rig.joint_rad() == pytest.approx(held, abs=1e-3)  # the boards have held the arm
        assert {where for code, where in cell.faults if code == "drive_fault"} == {"joint 1", "joint 2", "joint 3"}
        assert any("watchdog" in fault.message for fault in cell.runtime.monitor.faults)


def test_a_narrow_counter_that_was_not_seen_for_long_takes_the_zero_away() -> None:
    """Half of 17 bits are 1.7 rad and more here: at 3 rad/s a joint may be as far away after 0.56 s."""
    narrow = replace(RIGHT, drives=tuple(replace(drive, encoder_bits=17) for drive in RIGHT.drives))
    with open_cell(arm=narrow) as cell:
        cell.client.enable()
        cell.runtime.on(Event.HOMED)
        for silent_s, found in ((0.5, set()), (0.8, {"joint 1", "joint 2"})):
            cell.inject("silent", "encoder")
            cell.run(silent_s)
            cell.rig.clear_faults()
            cell.run(0.02)
            assert {where for code, where in cell.faults if code == "zero_lost"} == found
            assert cell.runtime.monitor.is_homed is not bool(found)
            cell.client.acknowledge()


def test_another_program_that_goes_on_commanding_is_stopped_by_all_boards(cell: Cell) -> None:
    """What it commands and what the loop commands would take turns at the motor."""
    forward = b"\x0f\x29" + (6000).to_bytes(4, "little") + bytes(2)
    begun_rad = cell.rig.joint_rad()
    with contextlib.closing(cell.rig.wires.guest()) as guest:
        cell.watchers.append(lambda: guest.send(0x102, forward))
        cell.run(0.3)
        cell.watchers.clear()
    assert cell.rig.joint_rad() == pytest.approx(begun_rad, abs=0.03)
    assert [code for code, _ in cell.faults] == ["link"]
    cell.run(0.1)
    cell.client.acknowledge()
    assert cell.runtime.monitor.is_homed


def test_a_board_that_restarts_while_it_is_unplugged_is_found_out_by_the_acknowledgement(cell: Cell) -> None:
    cell.inject("silent", "encoder")
    cell.until_fault(0.1)
    cell.inject("board_reset", "encoder")
    cell.run(0.6)  # its start-up message, too
    cell.rig.clear_faults()
    cell.run(0.2)
    assert "restarted by itself" in cell.refusal(do="acknowledge")
    cell.client.acknowledge()
    cell.client.hold()
    assert not cell.runtime.monitor.is_homed


def test_a_board_that_restarted_before_the_arm_was_off_reports_again_when_it_is_enabled() -> None:
    with holding_cell(scenario(effect=FRICTION)) as cell:
        cell.inject("board_reset", "encoder")
        cell.until_fault(0.1)
        cell.client.off()
        cell.client.ask("acknowledge")  # in OFF it only clears the list
        cell.client.enable()
        assert (cell.mode, cell.runtime.monitor.is_homed) == (Mode.HOLDING, False)


@pytest.mark.parametrize(("counts", "code"), [(3000.0, "encoder_leap"), (400.0, "encoders_differ")])
def test_a_zero_that_is_lost_while_the_boards_hold_the_arm_is_found(cell: Cell, counts: float, code: str) -> None:
    cell.run(0.2)  # each motor board is asked for its own count in turn
    cell.inject("silent", "motor2")
    cell.until_fault(0.1)
    cell.inject("jumping_encoder", "encoder", channel=0, value=counts)
    cell.run(0.2)
    assert cell.faults == [("drive_silent", "joint 2"), (code, "joint 1")]
    assert not cell.runtime.monitor.is_homed


def test_a_motor_board_that_hears_nothing_is_named_and_its_own_watchdog_brakes_its_joint(moving: Cell) -> None:
    moving.inject("silent", "motor2")
    moving.until_fault(STALE_s + 5 * CYCLE_s)
    assert moving.faults == [("drive_silent", "joint 2")]
    moving.run(Limits().watchdog_s)
    sinks_gently(moving)


def test_over_current_opens_its_own_bridge_and_the_other_boards_hold_their_joints(moving: Cell) -> None:
    moving.inject("over_current", "motor3")
    moving.until_fault(4 * CYCLE_s)
    assert moving.faults == [("drive_fault", "joint 3")]
    moving.run(0.1)
    assert moving.rig.robot.motor_boards[2].output == ("open", 0.0)
    held = moving.rig.joint_rad()
    moving.run(0.2)
    assert moving.rig.joint_rad()[:2] == pytest.approx(held[:2], abs=3e-3)


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_swapped_polarity_faults_before_the_joint_has_run_away(joint: int) -> None:
    with open_cell() as cell:
        cell.inject("swapped_polarity", f"motor{joint}")
        before = cell.rig.joint_rad()
        cell.client.ask("enable")
        cell.run(0.05)
        cell.channel.request({"do": "move_joints", "q_rad": list(TARGET)})  # refused where gravity was quicker
        cell.until_fault(0.5)
        cell.run(0.1)
        after = cell.rig.joint_rad()
        # Following error is limited to 0.05 rad at rest; another 0.07 rad is what the joint coasts on shorted windings.
        assert abs(after[joint - 1] - before[joint - 1]) < 0.12
        sinks_gently(cell)


def test_an_emergency_stop_from_anywhere_on_the_bus_is_a_fault_of_every_drive(moving: Cell) -> None:
    moving.rig.robot.from_host_can(0x000, b"\x00")
    moving.until_fault(4 * CYCLE_s)
    moving.run(0.01)
    stopped = [fault.where for fault in moving.runtime.monitor.faults if "emergency stop" in fault.message]
    assert stopped == ["joint 1", "joint 2", "joint 3"]
    sinks_gently(moving)


def test_two_faults_at_once_are_both_listed_and_the_severe_one_wins(moving: Cell) -> None:
    moving.inject("lost_wire", "encoder", channel=0)
    moving.inject("over_temperature", "motor3")
    moving.until_fault(4 * CYCLE_s)
    moving.run(0.02)
    assert {("encoder_signal", "joint 1"), ("drive_fault", "joint 3")} <= set(moving.faults)
    sinks_gently(moving)


def test_a_fault_while_stopping_turns_the_stop_into_braking(moving: Cell) -> None:
    moving.client.ask("stop")
    moving.run(0.02)
    assert moving.mode is Mode.STOPPING
    moving.inject("lost_wire", "encoder", channel=1)
    moving.until_fault(4 * CYCLE_s)
    assert moving.runtime.motion is None
    sinks_gently(moving)


def test_a_joint_that_is_held_back_stops_the_arm_and_the_others_are_held(moving: Cell) -> None:
    moving.rig.robot.plant.push(0, -30.0)  # N m, more than its motor has
    moving.until_fault(1.0)
    ((code, where),) = moving.faults
    assert (code in ("following_error", "unexplained_torque"), where) == (True, "joint 1")
    moving.rig.robot.plant.push(0, 0.0)
    moving.run(0.5)
    assert moving.runtime.monitor.is_held_fault
    held = moving.rig.joint_rad()
    moving.run(0.3)
    assert moving.rig.joint_rad()[1:] == pytest.approx(held[1:], abs=1e-3)


@pytest.mark.parametrize("raised", [RuntimeError("a bug"), ZeroDivisionError(), MemoryError(), KeyError("x")])
def test_an_exception_inside_the_cycle_brakes_the_arm_and_does_not_drop_it(
    moving: Cell, monkeypatch: pytest.MonkeyPatch, raised: Exception
) -> None:
    def broken(*arguments: object, **keys: object) -> None:
        raise raised

    monkeypatch.setattr(moving.runtime.parts.servo, "update", broken)
    moving.until_fault(2 * CYCLE_s)
    assert moving.faults == [("internal", "control loop")]
    assert type(raised).__name__ in moving.runtime.monitor.faults[0].message
    sinks_gently(moving)


def test_a_link_that_is_lost_is_a_fault_that_names_it_and_stops_all_joints(moving: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost() -> None:
        raise LinkLost("serial port /dev/ttyACM0: gone")

    monkeypatch.setattr(moving.connection.encoders[0], "update", lost)
    moving.until_fault(2 * CYCLE_s)
    assert ("link", "links") in moving.faults
    assert "serial port /dev/ttyACM0: gone" in moving.runtime.monitor.faults[0].message
    sinks_gently(moving)


def test_with_a_link_gone_for_good_the_runtime_can_still_be_ended(moving: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost() -> None:
        raise LinkLost("serial port /dev/ttyACM0: gone")

    monkeypatch.setattr(moving.connection.encoders[0], "update", lost)
    monkeypatch.setattr(drives, "SINK_LIMIT_S", 1.0)
    moving.until_fault(2 * CYCLE_s)
    moving.client.ask("off", quit=True)
    moving.until(lambda: not moving.channel.is_running, 1.0 + 5 * CYCLE_s)
    assert not moving.connection.hardware.is_any_enabled()


def test_when_no_link_carries_anything_the_cycle_goes_on_and_says_so(moving: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(*arguments: object) -> None:
        raise LinkLost("can0: gone")

    monkeypatch.setattr(moving.runtime.parts.hardware, "read", lost)
    monkeypatch.setattr(moving.runtime.parts.hardware, "write", lost)
    moving.until_fault(2 * CYCLE_s)
    cycles = moving.runtime.cycles
    moving.run(0.3)
    assert moving.runtime.cycles > cycles + 140
    assert max(abs(v) for v in moving.rig.robot.plant.joint_rad()) < 2.6
    # Nobody told the boards to: they have stopped the arm by themselves, and their watchdogs hold it.
    held = moving.rig.joint_rad()
    moving.run(0.3)
    assert moving.rig.joint_rad() == pytest.approx(held, abs=3e-3)


def test_the_cycles_before_a_fault_are_kept_with_it(moving: Cell) -> None:
    moving.inject("lost_wire", "encoder", channel=0)
    moving.until_fault(4 * CYCLE_s)
    kept = moving.client.ask("fault_cycles")
    layout = moving.runtime.parts.recorder.layout
    import base64

    rows = list(layout.packing.iter_unpack(base64.b64decode(kept["rows"])))
    times = [row[0] for row in rows]
    assert 100 < len(rows) <= 250
    assert times == sorted(times)
    assert moving.runtime.now_s - times[-1] < 3 * CYCLE_s
    assert all(math.isfinite(row[kept["names"].index("q1_rad")]) for row in rows)


# ---- acknowledging


def test_a_fault_is_acknowledged_once_its_cause_is_gone_and_not_before(moving: Cell) -> None:
    moving.inject("over_temperature", "motor2")
    moving.until_fault(4 * CYCLE_s)
    moving.run(0.1)
    assert "motor board" in moving.refusal(do="acknowledge")
    assert moving.mode is Mode.FAULT
    moving.rig.clear_faults()
    moving.run(0.05)
    moving.client.acknowledge()
    assert moving.mode is Mode.BRAKED
    moving.client.hold()
    assert moving.mode is Mode.HOLDING
    moving.client.move_joints(moving.client.status()["q_rad"])


def test_a_held_fault_is_acknowledged_only_after_its_stop(moving: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    from control.safety.modes import Fault, Reaction

    moving.runtime.fail(Fault("test", "here", "a test", "nothing", Reaction.CONTROLLED))
    assert "not ended" in moving.refusal(do="acknowledge")
    moving.run(0.8)
    moving.client.acknowledge()
    assert moving.mode is Mode.HOLDING
    assert moving.client.ask("status")["faults"] == []


@pytest.mark.parametrize(
    "request_",
    [
        {"do": "enable"},
        {"do": "hold"},
        {"do": "home", "again": True},
        {"do": "move_joints", "q_rad": list(STRETCHED)},
        {"do": "guide"},
    ],
)
def test_in_fault_nothing_is_moved(moving: Cell, request_: dict[str, object]) -> None:
    moving.inject("lost_wire", "encoder", channel=0)
    moving.until_fault(4 * CYCLE_s)
    moving.run(0.1)
    assert "FAULT" in moving.refusal(**request_)
    moving.run(0.05)
    assert moving.mode is Mode.FAULT


def test_faults_that_were_not_acknowledged_keep_the_drives_off_after_off() -> None:
    with holding_cell(scenario(RIGHT.rest.q_rad if RIGHT.rest else None, effect=FRICTION)) as cell:
        cell.inject("lost_wire", "encoder", channel=0)
        cell.until_fault(4 * CYCLE_s)
        cell.client.off()
        cell.rig.clear_faults()
        assert cell.mode is Mode.OFF
        assert "acknowledge" in cell.refusal(do="enable")
        cell.run(0.1)
        assert cell.mode is Mode.OFF
        cell.client.acknowledge()
        cell.client.enable()
        assert cell.mode is Mode.HOLDING


def test_there_is_nothing_to_acknowledge_without_a_fault(cell: Cell) -> None:
    assert "there is no fault" in cell.refusal(do="acknowledge")
    assert cell.mode is Mode.HOLDING


def test_motion_is_refused_before_homing() -> None:
    with holding_cell(scenario(homed=False)) as cell:
        assert "home" in cell.refusal(do="move_joints", q_rad=list(STRETCHED))
        assert cell.mode is Mode.HOLDING


def test_a_drive_that_cannot_be_enabled_is_named_and_the_arm_is_in_fault() -> None:
    with open_cell() as cell:
        cell.inject("over_temperature", "motor3")
        cell.run(0.02)
        with pytest.raises((ArmFaulted, RequestRefused), match="joint 3"):
            cell.client.enable()
        assert cell.mode in (Mode.FAULT, Mode.OFF)
        assert set(cell.runtime.parts.servo.volts) == {0.0}


def test_a_motion_that_asks_for_more_than_its_limits_is_stopped_under_control(cell: Cell) -> None:
    from control.motion.setpoint import SetPoint, at_rest

    q1, q2, q3 = cell.runtime.set_point.q_rad

    class Jump:
        duration_s = 1.0

        def at(self, time_s: float) -> SetPoint:
            return at_rest((q1 + (0.3 if time_s > 0.1 else 0.0), q2, q3))

    cell.runtime.start(Jump())
    speeds = cell.true_speeds()
    cell.until_fault(0.2)
    cell.run(0.5)
    assert cell.faults == [("set_point_limit", "joint 1")]
    assert cell.runtime.monitor.is_held_fault
    assert max(speeds) < 0.3
