"""Off, whatever the arm does: stop, hold, brake, off; the arm sinks and does not drop. And control in the three modes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from control.loop import drives
from control.model.arm import Arm
from control.safety.modes import Mode
from tests.cell import FRICTION, RIGHT, STRETCHED, Cell, holding_cell, open_cell, scenario, with_drives

DROP_rad_s = 0.6
UPRIGHT = RIGHT.rest.q_rad if RIGHT.rest else STRETCHED


def modes_of(cell: Cell) -> list[Mode]:
    """Grows while cycles run: each mode that the arm goes through, once."""
    modes: list[Mode] = [cell.mode]

    def watch() -> None:
        if cell.mode is not modes[-1]:
            modes.append(cell.mode)

    cell.watchers.append(watch)
    return modes


def is_off(cell: Cell) -> bool:
    return cell.mode is Mode.OFF and not cell.connection.hardware.is_any_enabled()


def test_off_while_a_stretched_arm_moves_stops_holds_brakes_and_lets_it_sink(monkeypatch: pytest.MonkeyPatch) -> None:
    with holding_cell() as cell:
        cell.start_move((0.5, -0.4, 0.4))
        cell.run(0.1)
        modes, speeds = modes_of(cell), cell.true_speeds()
        monkeypatch.setattr(drives, "SINK_LIMIT_S", 3.0)
        cell.client.off()
        stopped = next(k for k, speed in enumerate(speeds) if speed < 0.05)
        cell.run(0.05)
        assert modes == [Mode.MOVING, Mode.STOPPING, Mode.HOLDING, Mode.BRAKED, Mode.OFF]
        assert is_off(cell)
        # Without any friction gravity pulls on shorted windings alone, all the way and after it.
        assert max(speeds[stopped:]) < DROP_rad_s
        assert stopped * 0.002 < 0.4


@pytest.mark.parametrize(
    "request_",
    [
        {"do": "move_joints", "q_rad": [0.5, -0.4, 0.4]},
        {"do": "jog", "joint_speed_rad_s": [0.1, 0.0, 0.0]},
        {"do": "home", "again": True},
        {"do": "enable"},
        {"do": "hold"},
        {"do": "guide"},
        {"do": "tool", "name": ""},
    ],
)
def test_nothing_begins_while_the_arm_is_being_switched_off(cell: Cell, request_: dict[str, object]) -> None:
    cell.client.ask("off")
    assert cell.mode is Mode.HOLDING
    assert "is being switched off" in cell.refusal(**request_)
    assert cell.mode is Mode.HOLDING


def test_off_with_friction_is_quick_because_the_arm_stays() -> None:
    with holding_cell(scenario(UPRIGHT, effect=FRICTION)) as cell:
        before = cell.rig.joint_rad()
        begun_s = cell.rig.clock.now_s()
        cell.client.off()
        assert cell.rig.clock.now_s() - begun_s < 2.0
        assert cell.rig.joint_rad() == pytest.approx(before, abs=0.01)
        cell.client.enable()
        assert cell.mode is Mode.HOLDING


@pytest.mark.parametrize("state", ["homing", "guiding", "braked", "held fault", "braked fault", "enabling", "off"])
def test_off_works_from_every_mode_and_nothing_drops(state: str) -> None:
    from control.safety.modes import Fault, Reaction

    hidden = scenario(UPRIGHT, homed=state != "homing", effect=FRICTION)
    with open_cell(hidden) as cell:
        if state not in ("enabling", "off"):
            cell.client.enable()
        match state:
            case "enabling":
                cell.client.ask("enable")
            case "homing":
                cell.client.ask("home")
                cell.run(0.2)
            case "guiding":
                cell.client.guide()
            case "braked":
                cell.client.ask("brake")
            case "held fault":
                cell.runtime.fail(Fault("test", "here", "a test", "none", Reaction.CONTROLLED))
            case "braked fault":
                cell.runtime.fail(Fault("test", "here", "a test", "none", Reaction.BRAKE))
        speeds = cell.true_speeds()
        cell.client.ask("off", quit=True)
        cell.until(lambda: not cell.channel.is_running, 4.0)
        assert is_off(cell)
        assert max(speeds) < DROP_rad_s


def test_a_held_fault_goes_off_through_braking_and_waits_until_the_arm_has_sunk() -> None:
    from control.safety.modes import Fault, Reaction

    with holding_cell() as cell:
        cell.runtime.fail(Fault("test", "here", "a test", "none", Reaction.CONTROLLED))
        cell.run(2.0)
        cell.client.ask("off")
        cell.until(lambda: not cell.runtime.monitor.is_held_fault, 0.1)
        cell.run(0.7)
        assert cell.mode is Mode.FAULT  # it still sinks, on windings that are shorted
        assert max(abs(v) for v in cell.runtime.parts.measurement.speed_rad_s) > 0.02


def test_a_joint_whose_coarse_encoder_hunts_does_not_keep_the_arm_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drives, "SINK_LIMIT_S", 1.0)
    with holding_cell(scenario(STRETCHED), with_drives(RIGHT, encoder_counts_per_rev=64)) as cell:
        cell.client.ask("off")
        cell.until(lambda: cell.mode is Mode.OFF, 3.0)


def test_enabling_again_while_going_off_ends_the_way_off(cell: Cell) -> None:
    cell.client.ask("off")
    cell.until(lambda: cell.mode is Mode.BRAKED, 1.0)
    cell.client.enable()
    cell.run(0.6)
    assert cell.mode is Mode.HOLDING


def test_a_brake_while_moving_is_a_fault_of_the_operators_and_needs_a_look(cell: Cell) -> None:
    cell.start_move((0.5, -0.4, 0.4))
    cell.run(0.1)
    cell.client.ask("brake")
    assert (cell.mode, cell.faults) == (Mode.FAULT, [("brake", "operator")])
    cell.run(0.1)
    cell.client.acknowledge()
    cell.client.hold()


def test_a_hand_guides_the_arm_and_hold_takes_it_where_it_is() -> None:
    with holding_cell(scenario(UPRIGHT, effect=FRICTION)) as cell:
        x, y, z = cell.rig.tip_m()
        cell.rig.hand.seat((x, y + 0.05, z))
        cell.client.guide()
        cell.run(0.5)
        assert {board.output[0] for board in cell.rig.robot.motor_boards} == {"open"}
        cell.client.hold()
        cell.rig.hand.let_go()
        held = cell.rig.tip_m()
        cell.run(0.3)
        assert cell.rig.tip_m() == pytest.approx(held, abs=1e-3)
        assert abs(held[1] - y) > 0.03


def with_mode(mode: str) -> Arm:
    """The reference arm with its controllers elsewhere; gains derived from the model."""
    return replace(RIGHT, drives=tuple(replace(d, pid=replace(d.pid, mode=mode)) for d in RIGHT.drives))


@pytest.mark.parametrize("mode", ["voltage", "current", "position"])
@pytest.mark.parametrize("direction", [1, -1])
def test_a_joint_move_ends_within_a_milliradian_in_every_mode_and_wiring(mode: str, direction: int) -> None:
    arm = with_drives(with_mode(mode), motor_direction=direction, encoder_direction=direction * -1)
    target = (0.4, -0.3, 0.5)
    with holding_cell(arm=arm) as cell:
        cell.client.move_joints(target)
        cell.run(0.4)
        assert cell.rig.joint_rad() == pytest.approx(target, abs=1e-3)
        cell.client.move_joints(STRETCHED)
        cell.run(0.4)
        assert cell.rig.joint_rad() == pytest.approx(STRETCHED, abs=1e-3)


@pytest.mark.parametrize("mode", ["current", "position"])
def test_homing_works_with_the_controller_on_the_board_too(mode: str) -> None:
    with holding_cell(scenario((-0.1, 0.0, 0.6), homed=False), with_mode(mode)) as cell:
        cell.client.home(20.0)
        cell.run(0.1)
        assert cell.runtime.parts.measurement.q_rad == pytest.approx(cell.rig.joint_rad(), abs=1e-4)
        held = cell.rig.joint_rad()
        cell.run(0.2)
        # In position mode the board's own integral carries the weight and unwinds as the feed-forward takes over.
        assert cell.rig.joint_rad() == pytest.approx(held, abs=1e-3)


def test_a_payload_that_is_told_is_held_without_sagging(cell: Cell) -> None:
    cell.run(0.3)
    before = cell.rig.tip_m()
    cell.client.ask("payload", mass_kg=1.0)
    cell.rig.set_payload(1.0)
    cell.run(0.3)
    assert cell.rig.tip_m() == pytest.approx(before, abs=1e-3)
