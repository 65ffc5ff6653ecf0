"""Limit switches on an arm of four joints, on the rig: what moves towards one stops, homed or not, and homing may seek one."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from control.hardware.interface import ZERO_SET
from control.loop.cross_checks import LimitSwitch, MetSwitch
from control.model.arm import Arm, Home, LimitSwitches
from control.model.arm_checks import check_arm
from control.model.end_effector import Digital
from control.model.reader import Rejected
from control.safety.modes import Mode
from firmware_iface.errors import ArmwrightError
from hil_mocks.scenario import Scenario
from procedures.on_boards import REFERENCE, on_boards
from tests.cell import Cell, holding_cell, open_cell, scenario, with_drive
from tests.control.loop.test_encoder_places import FRICTION, arm_of_four

PINS = Digital("low", 3, 2, "input"), Digital("high", 3, 3, "input")
AT_rad = 0.6  # where the upper one of joint 3 changes, within its range: nothing else stops it there
SWITCHES = LimitSwitches(lower="low", upper="high", upper_rad=AT_rad)
MARGIN_rad = 0.01  # levels are asked for every 20 ms; the joint then brakes


def with_switches(switches: LimitSwitches = SWITCHES) -> Arm:
    return replace(with_drive(arm_of_four("motor"), 3, limit_switches=switches), digital=PINS, effects=FRICTION)


def near_it(homed: bool) -> Scenario:
    return scenario((0.0, 0.2, AT_rad - 0.1, 0.0), homed=homed)


def jog(cell: Cell, speed_rad_s: float) -> None:
    """Joint 3, for a second; each jog is renewed."""
    for _ in range(10):
        if cell.mode is not Mode.FAULT:
            cell.client.ask("jog", joint_speed_rad_s=[0.0, 0.0, speed_rad_s, 0.0])
        cell.run(0.1)


@pytest.mark.parametrize("homed", [True, False])
def test_a_jog_stops_at_a_limit_switch_and_goes_on_away_from_it(homed: bool) -> None:
    with holding_cell(near_it(homed), with_switches()) as cell:
        jog(cell, 0.2)
        assert cell.faults == [("limit_switch", "joint 3")]
        assert AT_rad <= cell.rig.joint_rad()[2] < AT_rad + MARGIN_rad
        cell.client.acknowledge()
        cell.client.enable()
        jog(cell, 0.2)
        assert cell.faults == [("limit_switch", "joint 3")]
        assert cell.rig.joint_rad()[2] < AT_rad + MARGIN_rad
        cell.client.acknowledge()
        cell.client.enable()
        jog(cell, -0.2)
        assert cell.faults == []
        assert cell.rig.joint_rad()[2] < AT_rad - 0.05


def test_a_broken_wire_is_a_switch_that_is_active() -> None:
    arm = with_switches(LimitSwitches(upper="high"))
    with holding_cell(near_it(True), arm) as cell:
        cell.run(0.1)
        cell.rig.set_pin("high", True)
        cell.start_move((0.0, 0.2, AT_rad, 0.0), 0.2)
        cell.until_fault(0.1)
        assert cell.faults == [("limit_switch", "joint 3")]


@pytest.mark.parametrize("homed", [True, False])
def test_a_switch_that_is_wired_to_the_other_end_stops_the_joint_also_after_off(homed: bool) -> None:
    swapped = LimitSwitches(lower="high", upper="low")
    with open_cell(near_it(homed), with_switches(), believed=with_switches(swapped)) as cell:
        cell.client.enable()
        jog(cell, 0.2)
        assert cell.faults == [("limit_switch", "joint 3")]
        assert "wired to the other end" in str(cell.runtime.monitor.faults[0])
        for _ in range(2):  # further in is refused again and again, whatever the file says of the switch's side
            cell.client.acknowledge()
            cell.client.enable()
            jog(cell, 0.2)
            assert cell.faults == [("limit_switch", "joint 3")]
            assert cell.rig.joint_rad()[2] < AT_rad + MARGIN_rad
        cell.client.acknowledge()
        cell.client.off()  # it sinks on into the switch, whose place is known all the same
        cell.client.enable()
        before_rad = cell.rig.joint_rad()[2]
        jog(cell, 0.2)
        assert cell.faults == [("limit_switch", "joint 3")]
        assert cell.rig.joint_rad()[2] < before_rad + MARGIN_rad


def test_a_switch_that_is_wired_to_the_other_end_lets_the_joint_back_out() -> None:
    swapped = LimitSwitches(lower="high", upper="low")
    with open_cell(near_it(True), with_switches(), believed=with_switches(swapped)) as cell:
        cell.client.enable()
        jog(cell, 0.2)
        cell.client.acknowledge()
        cell.client.enable()
        jog(cell, -0.2)
        assert cell.faults == []
        assert cell.rig.joint_rad()[2] < AT_rad - 0.05


SWITCH = LimitSwitch(2, "joint 3", "high", 1.0, True, False, edge_rad=0.01)


def followed(met: MetSwitch, q_rad: Iterable[float], speed_rad_s: float, is_active: bool = False) -> MetSwitch:
    for q in q_rad:
        met.follow(is_active, q, speed_rad_s)
    return met


def test_a_switch_that_is_met_just_as_the_joint_turns_round_bars_both_ways_until_the_drives_were_off() -> None:
    """A level comes late, and a joint lags: it met the switch on its way up, and its set-point goes down by then."""
    met = followed(MetSwitch(SWITCH), np.linspace(0.4, 0.601, 50), 0.2)
    followed(met, [0.602], -0.2)
    followed(met, [0.602, 0.601], -0.2, is_active=True)
    assert met.bars(0.2)
    assert met.bars(-0.2)
    met.forget()
    followed(met, [0.601, 0.600], -0.2, is_active=True)
    assert met.bars(0.2)
    assert not met.bars(-0.2)


def test_a_switch_that_was_met_at_the_other_end_is_known_there_until_it_is_met_at_its_own() -> None:
    met = followed(MetSwitch(SWITCH), np.linspace(0.0, -0.5, 50), -0.2)
    followed(met, [-0.5, -0.501], -0.2, is_active=True)
    met.forget()
    assert met.bars(-0.2)
    assert not met.bars(0.2)
    followed(met, np.linspace(-0.5, 0.6, 50), 0.2)
    followed(met, [0.6], 0.2, is_active=True)
    assert met.bars(0.2)
    assert not met.bars(-0.2)


def test_a_switch_that_chatters_lets_the_joint_out_all_the_same() -> None:
    with holding_cell(near_it(True), with_switches()) as cell:
        jog(cell, 0.2)
        assert cell.faults == [("limit_switch", "joint 3")]
        cell.client.acknowledge()
        cell.client.enable()
        levels = itertools.cycle([False] * 30 + [True] * 30)  # some questions long
        cell.watchers.append(lambda: cell.rig.set_pin("high", next(levels)))
        cell.client.ask("jog", joint_speed_rad_s=[0.0, 0.0, -0.05, 0.0])
        cell.run(0.2)
        assert cell.faults == []
        cell.client.ask("jog", joint_speed_rad_s=[0.0, 0.0, 0.05, 0.0])
        cell.until_fault(0.3)


def test_a_switch_of_which_the_board_says_nothing_bars_the_way_to_its_end() -> None:
    with holding_cell(near_it(True), with_switches(LimitSwitches(upper="high"))) as cell:
        boards = cell.connection.hardware.end.pins
        assert boards is not None
        board = boards._boards[3]
        cell.watchers.append(lambda: setattr(board, "reply_at_s", -np.inf))
        cell.run(0.1)
        jog(cell, -0.1)
        assert cell.faults == []
        cell.client.ask("jog", joint_speed_rad_s=[0.0, 0.0, 0.1, 0.0])
        cell.until_fault(0.2)
        assert cell.faults == [("limit_switch", "joint 3")]
        assert "does not say" in str(cell.runtime.monitor.faults[0])


@pytest.mark.parametrize("start_rad", [-0.51, -0.3, AT_rad + 0.005])
def test_homing_finds_its_limit_switch_from_there_and_from_the_other_end(start_rad: float) -> None:
    arm = with_switches(LimitSwitches(lower="low", lower_rad=-0.5, upper="high", upper_rad=AT_rad))
    arm = with_drive(arm, 3, home=Home(-0.5, -0.51, switch="lower"))
    with open_cell(scenario((0.0, 0.2, start_rad, 0.0), homed=False), arm) as cell:
        cell.client.enable()
        cell.client.home()
        assert cell.faults == []
        off_rad = np.subtract(cell.runtime.parts.measurement.q_rad, cell.rig.joint_rad())
        assert off_rad == pytest.approx(0, abs=1e-3)


def test_homing_by_a_switch_of_the_other_end_ends_there() -> None:
    switches = LimitSwitches(lower="low", lower_rad=-0.5, upper="high", upper_rad=AT_rad)
    arm = with_drive(with_switches(switches), 3, home=Home(-0.5, -0.51, switch="lower"))
    wrong = replace(switches, lower="high", upper="low")
    believed = with_drive(arm, 3, limit_switches=wrong)
    with open_cell(scenario((0.0, 0.2, 0.3, 0.0), homed=False), arm, believed=believed) as cell:
        cell.client.enable()
        cell.channel.request({"do": "home"})
        cell.until_fault(60.0)
        assert cell.faults[0] == ("limit_switch", "joint 3")
        assert cell.rig.joint_rad()[2] > -0.5 - MARGIN_rad


@pytest.mark.parametrize("lower_rad", [-0.6, -0.48])
def test_homing_seeks_a_limit_switch_where_a_joint_has_no_other(lower_rad: float) -> None:
    """The range may end before the switch, as `bringup` sets it."""
    arm = with_switches(LimitSwitches(lower="low", lower_rad=-0.5))
    arm = with_drive(arm, 3, home=Home(-0.5, -0.51, switch="lower"), joint_lower_rad=lower_rad)
    check_arm(arm)
    with open_cell(scenario((0.0, 0.2, -0.3, 0.0), homed=False), arm) as cell:
        cell.client.enable()
        cell.client.home()
        assert cell.faults == []
        assert np.subtract(cell.runtime.parts.measurement.q_rad, cell.rig.joint_rad()) == pytest.approx(0, abs=1e-3)
        cell.client.move_joints((0.0, 0.2, 0.3, 0.0), 0.3)


@pytest.mark.parametrize(
    ("switches", "home", "said"),
    [
        (LimitSwitches(lower="nowhere"), None, r'an input .low, high.; "drive" is for: roboclaw, cia402; .*, got "nowhere"'),
        (LimitSwitches(lower="low", upper="low"), None, "low a second time"),
        (LimitSwitches(lower="low"), Home(0.1, 0.11, switch="upper"), "a limit switch for homing"),
        (LimitSwitches(lower="low"), Home(0.1, 0.11, switch="lower"), "where the lower limit switch is active"),
    ],
)
def test_switches_that_cannot_be_are_refused(switches: LimitSwitches, home: Home | None, said: str) -> None:
    arm = with_switches(switches)
    with pytest.raises(Rejected, match=said):
        check_arm(with_drive(arm, 3, home=home) if home else arm)


@pytest.mark.parametrize("direction", [1, -1])
def test_a_drive_of_cia_402_says_of_switches_at_its_own_inputs(direction: Literal[1, -1]) -> None:
    """Bits 0 and 1 of 0x60FD, negative and positive in the sense of the drive, which may not be that of the joint."""
    own = LimitSwitches(lower="drive", lower_rad=-0.5, upper="drive", upper_rad=AT_rad)
    arm = on_boards(replace(arm_of_four("motor"), effects=FRICTION), "cia402")
    arm = with_drive(arm, 1, limit_switches=own, encoder_direction=direction, motor_direction=direction)
    arm = with_drive(arm, 1, home=Home(-0.5, -0.5, speed_rad_s=0.1, switch="lower"))
    check_arm(arm)
    start = scenario((AT_rad - 0.05, 0.0, 0.0, 0.0), homed=False)  # upright axis: it does not fall before it holds
    with open_cell(start, arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        for _ in range(10):
            if cell.mode is not Mode.FAULT:
                cell.client.ask("jog", joint_speed_rad_s=[0.2, 0.0, 0.0, 0.0])
            cell.run(0.1)
        assert cell.faults == [("limit_switch", "joint 1")]
        assert AT_rad <= cell.rig.joint_rad()[0] < AT_rad + 2.0 * MARGIN_rad
        cell.client.acknowledge()
        cell.client.enable()
        cell.channel.request({"do": "home"})
        cell.until(lambda: bool(cell.runtime.hardware.feedback.channel_flags[0] & ZERO_SET), 40.0)
        assert cell.faults == []
        assert cell.runtime.parts.measurement.q_rad[0] == pytest.approx(cell.rig.joint_rad()[0], abs=5e-3)


@pytest.mark.parametrize("kind", ["dynamixel", "feetech", "moteus", "vesc"])
def test_inputs_of_a_reference_board_serve_a_joint_whose_own_board_says_of_none(kind: str) -> None:
    arm = on_boards(replace(arm_of_four("motor"), effects=FRICTION), (kind, REFERENCE, REFERENCE, REFERENCE))
    pins = tuple(replace(pin, board=arm.drives[1].motor_node) for pin in PINS)
    arm = replace(with_drive(arm, 1, limit_switches=SWITCHES), digital=pins)
    start = scenario((AT_rad - 0.05, 0.0, 0.0, 0.0), homed=True)  # upright axis: it does not fall before it holds
    with open_cell(start, arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        behind_rad = 0.0  # a servo's own position loop lags, and catches up with the set-point that stands
        for _ in range(10):
            if cell.mode is not Mode.FAULT:
                behind_rad = cell.client.ask("status")["following_error_rad"][0]
                cell.client.ask("jog", joint_speed_rad_s=[0.2, 0.0, 0.0, 0.0])
            cell.run(0.1)
        assert cell.faults == [("limit_switch", "joint 1")]
        assert AT_rad <= cell.rig.joint_rad()[0] < AT_rad + 2.0 * MARGIN_rad + behind_rad


def on_roboclaws(joint: int, direction: Literal[1, -1], end: Literal["lower", "upper"], at_rad: float) -> Arm:
    """The arm with a limit switch at S4 or S5 of this joint's motor, on which it homes."""
    arm = on_boards(replace(arm_of_four("motor"), effects=FRICTION), "roboclaw")
    switches = LimitSwitches(**{end: "drive", f"{end}_rad": at_rad})  # type: ignore[arg-type]
    home = Home(at_rad, at_rad, speed_rad_s=0.1, switch=end)
    arm = with_drive(arm, joint, encoder_direction=direction, motor_direction=direction, limit_switches=switches, home=home)
    check_arm(arm)
    return arm


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("joint", "start_rad"), [(1, AT_rad - 0.05), (2, AT_rad - 0.1)])
def test_a_roboclaw_says_of_the_switch_at_its_s4_or_s5(joint: int, start_rad: float, direction: Literal[1, -1]) -> None:
    """Status bits of command 90; the board drives no further into it by itself. Joint 2 leans on its switch with its weight."""
    arm = on_roboclaws(joint, direction, "upper", AT_rad)
    start = scenario(tuple(start_rad if j == joint else 0.0 for j in (1, 2, 3, 4)))

    def jog_on(speed_rad_s: float) -> float:
        for _ in range(20):
            if cell.mode is not Mode.FAULT:
                speeds = [speed_rad_s if j == joint else 0.0 for j in (1, 2, 3, 4)]
                cell.client.ask("jog", joint_speed_rad_s=speeds)
            cell.run(0.1)
        return cell.rig.joint_rad()[joint - 1]

    with open_cell(start, arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        for _ in range(2):
            at_rad = jog_on(0.2)
            assert cell.faults == [("limit_switch", f"joint {joint}")]
            assert AT_rad <= at_rad < AT_rad + 2.0 * MARGIN_rad
            cell.client.acknowledge()
            cell.client.enable()
        assert jog_on(-0.2) < AT_rad - 0.05
        assert cell.faults == []


@pytest.mark.parametrize("direction", [1, -1])
def test_a_roboclaw_homes_on_its_limit_switch(direction: Literal[1, -1]) -> None:
    arm = on_roboclaws(1, direction, "lower", -0.5)
    start = scenario((-0.4, 0.0, 0.0, 0.0), homed=False)
    with open_cell(start, arm, period_s=1.0 / arm.usual_rate_Hz) as cell:
        cell.client.enable()
        cell.channel.request({"do": "home"})
        cell.until(lambda: bool(cell.runtime.hardware.feedback.channel_flags[0] & ZERO_SET), 40.0)
        assert cell.faults == []
        assert cell.runtime.parts.measurement.q_rad[0] == pytest.approx(cell.rig.joint_rad()[0], abs=5e-3)


def test_a_roboclaw_whose_pin_stops_the_motor_the_other_way_is_refused() -> None:
    wired, believed = on_roboclaws(1, 1, "lower", -0.5), on_roboclaws(1, 1, "upper", AT_rad)
    said = r'S4 as "Limit \(Fwd\)" \(0x12\).*its mode is 0x22'
    with pytest.raises(ArmwrightError, match=said), open_cell(scenario((0.0,) * 4), wired, believed=believed, period_s=0.01):
        pass


@pytest.mark.parametrize(
    ("kind", "keys", "said"),
    [
        ("vesc", {"lower": "drive"}, r'\[\[digital\]\] that is an input .* "drive" is for: roboclaw, cia402; other boards: let'),
        (
            "roboclaw",
            {"lower": "drive", "active": "low"},
            'active.*: expected "high": the board of joint 3 says itself .* got "low"',
        ),
        ("roboclaw", {"lower": "drive", "upper": "drive"}, "has one input for it: .* got the lower end and the upper end"),
    ],
)
def test_limit_switches_that_a_board_does_not_say_of_are_refused_with_what_to_take_instead(
    kind: str, keys: dict[str, str], said: str
) -> None:
    arm = on_boards(arm_of_four("motor"), kind)
    with pytest.raises(Rejected, match=said):
        check_arm(with_drive(arm, 3, limit_switches=LimitSwitches(**keys)))  # type: ignore[arg-type]
