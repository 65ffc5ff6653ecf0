"""Jog, pause and resume with a mock arm: whoever lets go, whenever it is, the arm comes to rest under control and is held."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest

from control.motion.plan import plan_path
from control.safety.modes import Fault, Mode, Reaction
from tests.cell import PERIOD_S, RIGHT, STRETCHED, Cell, handled, holding_cell, scenario, with_drive

SILENCE_S = RIGHT.limits.jog_silence_s
FAR = (1.2, -0.2, 0.9)
CIRCLE = [(0.5 + 0.09 * math.cos(a), 0.09 * math.sin(a), 0.1) for a in (2.0 * math.pi * i / 8 for i in range(9))]


@pytest.fixture
def cell() -> Iterator[Cell]:
    with holding_cell() as cell:
        yield cell


def jog(cell: Cell, duration_s: float, **request: object) -> None:
    """Ask, and renew every 0.1 s."""
    cell.client.ask("jog", **request)
    for _ in range(round(duration_s / 0.1)):
        cell.run(0.1)
        cell.client.ask("jog_on")


def is_at_rest(cell: Cell) -> bool:
    return not any(cell.runtime.set_point.speed_rad_s)


# ---- the dead man's switch


def test_a_jog_goes_on_while_it_is_renewed_and_the_arm_follows(cell: Cell) -> None:
    before = cell.rig.joint_rad()
    jog(cell, 1.0, joint_speed_rad_s=[0.2, 0.0, 0.0])
    assert cell.mode is Mode.JOGGING
    assert cell.runtime.set_point.speed_rad_s == pytest.approx((0.2, 0.0, 0.0))
    # 0.2 rad/s for 1 s, less the way to speed (0.2 rad/s at 10 rad/s^2 and 200 rad/s^3) and the lag of the drive
    assert cell.rig.joint_rad()[0] - before[0] == pytest.approx(0.2, abs=0.02)
    assert cell.runtime.monitor.faults == ()


def test_a_jog_that_nobody_renews_comes_to_rest_and_holds(cell: Cell) -> None:
    jog(cell, 0.5, tip_velocity_m_s=[0.0, 0.0, 0.2])
    to_slow_s = cell.until(lambda: math.hypot(*cell.runtime.set_point.acceleration_rad_s2) > 1.0, 1.0)
    assert to_slow_s == pytest.approx(SILENCE_S, abs=0.02)
    cell.until(lambda: cell.mode is Mode.HOLDING, 0.3)
    assert is_at_rest(cell)
    assert cell.runtime.monitor.faults == ()


def test_one_renewal_a_tenth_of_a_second_is_enough_and_one_missing_is_not_felt(cell: Cell) -> None:
    cell.client.ask("jog", joint_speed_rad_s=[0.2, 0.0, 0.0])
    for gap_s in (0.1, 0.19, 0.1, 0.19):
        cell.run(gap_s)
        cell.client.ask("jog_on")
    assert cell.runtime.set_point.speed_rad_s == pytest.approx((0.2, 0.0, 0.0))


def test_a_renewal_while_the_arm_slows_down_revives_a_jog_that_says_what_it_wants(cell: Cell) -> None:
    jog(cell, 0.3, tip_velocity_m_s=[0.0, 0.0, 0.2])
    cell.run(SILENCE_S + 0.06)
    assert cell.mode is Mode.JOGGING
    cell.client.ask("jog_on")  # too late: it says nothing of what is wanted
    cell.run(0.02)
    assert math.hypot(*cell.runtime.set_point.acceleration_rad_s2) > 0.1
    jog(cell, 0.4, tip_velocity_m_s=[0.0, 0.0, 0.2])
    assert cell.mode is Mode.JOGGING
    assert cell.runtime.monitor.faults == ()


def test_a_client_that_hangs_up_stops_its_jog_at_once(cell: Cell) -> None:
    jog(cell, 0.3, joint_speed_rad_s=[0.2, 0.1, -0.2])
    cell.channel.close()
    cell.run(PERIOD_S)
    assert cell.mode is Mode.STOPPING
    cell.until(lambda: cell.mode is Mode.HOLDING, 0.2)


def test_a_jog_belongs_to_one_client_and_everybody_may_stop_it(cell: Cell) -> None:
    jog(cell, 0.2, joint_speed_rad_s=[0.2, 0.0, 0.0])
    for request in ({"do": "jog", "joint_speed_rad_s": [0.0, 0.2, 0.0]}, {"do": "jog_on"}):
        answer = handled(cell, request, 8)
        assert "another client jogs" in answer["error"]
    cell.assembly.requests.on_gone(8)
    cell.run(0.01)
    assert cell.mode is Mode.JOGGING
    assert handled(cell, {"do": "stop"}, 8)["ok"]
    cell.until(lambda: cell.mode is Mode.HOLDING, 0.2)


@pytest.mark.parametrize(
    ("do", "keys"),
    [("move_joints", {"q_rad": list(STRETCHED)}), ("home", {"again": True}), ("guide", {}), ("pause", {}), ("resume", {})],
)
def test_while_the_arm_is_jogged_nothing_else_begins(cell: Cell, do: str, keys: dict[str, Any]) -> None:
    jog(cell, 0.2, joint_speed_rad_s=[0.2, 0.0, 0.0])
    assert "JOGGING" in cell.refusal(do=do, **keys)
    assert cell.mode is Mode.JOGGING


def test_there_is_nothing_to_renew_where_nothing_is_jogged(cell: Cell) -> None:
    assert "no jog to renew" in cell.refusal(do="jog_on")


# ---- what limits a jog


def test_at_the_end_of_a_range_the_arm_rests_without_a_fault_and_the_status_says_why(cell: Cell) -> None:
    cell.client.move_joints((0.1, -0.6, 1.4))
    jog(cell, 1.0, joint_speed_rad_s=[0.0, 0.0, 1.0])
    assert cell.mode is Mode.JOGGING
    assert cell.runtime.set_point.q_rad[2] == pytest.approx(1.5, abs=1e-9)
    assert "joint 3 is at the end of its range" in cell.client.status()["warnings"]
    assert cell.client.ask("jog_on")["limited"] == "joint 3 is at the end of its range"
    jog(cell, 0.3, joint_speed_rad_s=[0.0, 0.0, -0.5])
    assert cell.runtime.set_point.q_rad[2] < 1.45
    assert cell.runtime.monitor.faults == ()


def test_a_joint_that_a_hand_took_out_of_its_range_is_jogged_back_into_it() -> None:
    narrow = with_drive(RIGHT, 3, joint_upper_rad=1.0)
    with holding_cell(scenario((0.1, -0.6, 1.03)), believed=narrow) as cell:
        jog(cell, 0.3, joint_speed_rad_s=[0.0, 0.0, 0.3])
        assert cell.runtime.set_point.q_rad[2] == pytest.approx(1.03, abs=3e-3)
        jog(cell, 0.5, joint_speed_rad_s=[0.0, 0.0, -0.3])
        assert cell.rig.joint_rad()[2] < 0.95
        assert cell.runtime.monitor.faults == ()


def test_a_step_of_the_tip_ends_where_it_was_to(cell: Cell) -> None:
    before = cell.client.status()["tip_set_m"]
    cell.client.ask("jog", axis="z", by_m=0.03, speed_m_s=0.1)
    while cell.mode is Mode.JOGGING:
        cell.run(0.05)
        cell.channel.request({"do": "jog_on"})
    after = cell.client.status()["tip_set_m"]
    assert after == pytest.approx([before[0], before[1], before[2] + 0.03], abs=1e-6)


def test_an_arm_that_knows_no_zero_is_jogged_with_half_of_the_current_and_slowly() -> None:
    with holding_cell(scenario(homed=False)) as cell:
        assert "home the arm first" in cell.refusal(do="jog", tip_velocity_m_s=[0.0, 0.0, 0.1])
        assert "home the arm first" in cell.refusal(do="jog", axis="z", by_m=0.01)
        fractions: list[float] = []
        update = cell.runtime.parts.servo.update
        cell.runtime.parts.servo.update = lambda *a: (fractions.append(a[3]), update(*a))[1]  # type: ignore[method-assign]
        before = cell.rig.joint_rad()
        jog(cell, 1.0, joint_speed_rad_s=[1.0, 0.0, 0.0])
        assert set(fractions[2:]) == {0.5}
        assert cell.mode is Mode.JOGGING
        assert cell.rig.joint_rad()[0] - before[0] == pytest.approx(0.1, abs=0.015)


# ---- faults and going off


def test_a_fault_while_jogging_stops_the_arm_and_holds_it(cell: Cell) -> None:
    jog(cell, 0.3, joint_speed_rad_s=[0.29, 0.0, 0.0])
    cell.runtime.fail(Fault("x", "joint 1", "something", "look", Reaction.CONTROLLED))
    assert not is_at_rest(cell)
    cell.run(0.2)
    assert is_at_rest(cell)
    assert cell.mode is Mode.FAULT
    assert "FAULT" in cell.refusal(do="jog", joint_speed_rad_s=[0.1, 0.0, 0.0])
    cell.client.acknowledge()
    assert cell.mode is Mode.HOLDING


@pytest.mark.parametrize("is_paused", [False, True])
def test_a_silent_drive_brakes_a_jog_and_a_pause_like_everything_else(cell: Cell, is_paused: bool) -> None:
    if is_paused:
        cell.start_move(FAR)
        cell.run(0.4)
        cell.client.ask("pause")
    else:
        jog(cell, 0.3, joint_speed_rad_s=[0.29, 0.0, 0.0])
    cell.inject("silent", "motor1")
    cell.until_fault(0.5)
    assert ("drive_silent", "joint 1") in cell.faults
    assert cell.runtime.motion is None
    assert cell.runtime.jogging is None


@pytest.mark.usefixtures("nobody_below")
def test_the_way_off_leads_through_a_stop_from_jogging_and_from_a_pause(cell: Cell) -> None:
    jog(cell, 0.3, joint_speed_rad_s=[0.2, 0.0, 0.0])
    cell.client.off()
    assert cell.mode is Mode.OFF
    cell.client.enable()
    cell.start_move(FAR, 0.5)
    cell.run(0.3)
    cell.client.ask("pause")
    cell.run(0.1)
    cell.client.off()
    assert cell.mode is Mode.OFF


# ---- pause, resume, override


def test_a_paused_path_holds_on_it_and_goes_on_to_its_end(cell: Cell) -> None:
    path = plan_path(RIGHT, CIRCLE, 0.3, q_near_rad=STRETCHED)
    cell.client.move_joints(path.q_start_rad)
    cell.client.ask("run_path", path=path.to_message())
    cell.run(0.8)
    cell.client.ask("pause")
    assert cell.mode is Mode.PAUSED
    cell.until(lambda: is_at_rest(cell), 0.6)
    progress = cell.client.status()["progress"]
    x, y, _ = cell.client.status()["tip_set_m"]
    assert math.hypot(x - 0.5, y) == pytest.approx(0.09, abs=2e-3)  # the spline through 8 points
    cell.run(2.0)
    assert cell.client.status()["progress"] == progress
    assert cell.client.status()["pace"] == 0.0
    cell.client.ask("resume")
    cell.until(lambda: cell.mode is Mode.HOLDING, path.duration_s)
    assert cell.client.status()["tip_set_m"] == pytest.approx(CIRCLE[-1], abs=1e-4)
    assert cell.runtime.monitor.faults == ()


def test_a_pause_right_after_the_start_and_twice_and_resumed_while_slowing(cell: Cell) -> None:
    duration_s = cell.start_move(FAR)
    cell.client.ask("pause")
    cell.run(0.5)
    assert cell.client.status()["progress"] < 0.3
    cell.client.ask("resume")
    cell.run(0.4)
    cell.client.ask("pause")
    cell.client.ask("pause")
    cell.run(0.05)
    cell.client.ask("resume")
    cell.client.ask("resume")
    cell.until(lambda: cell.mode is Mode.HOLDING, duration_s + 1.0)
    assert cell.rig.joint_rad() == pytest.approx(FAR, abs=3e-3)
    assert cell.runtime.monitor.faults == ()


def test_a_pause_just_before_the_end_still_arrives_or_holds_short_of_it(cell: Cell) -> None:
    duration_s = cell.start_move((0.3, -0.5, 0.3))
    cell.run(duration_s - 0.01)
    cell.client.ask("pause")
    cell.run(1.0)
    assert cell.mode in (Mode.HOLDING, Mode.PAUSED)
    if cell.mode is Mode.PAUSED:
        cell.client.ask("resume")
    cell.until(lambda: cell.mode is Mode.HOLDING, 1.0)
    assert cell.rig.joint_rad() == pytest.approx((0.3, -0.5, 0.3), abs=2e-3)


def test_a_stop_leaves_a_paused_motion_for_good(cell: Cell) -> None:
    cell.start_move(FAR)
    cell.run(0.4)
    cell.client.ask("pause")
    cell.run(0.6)
    at = cell.runtime.set_point.q_rad
    cell.client.stop()
    assert cell.mode is Mode.HOLDING
    assert cell.runtime.set_point.q_rad == pytest.approx(at)
    assert "HOLDING" in cell.refusal(do="resume")
    cell.client.move_joints(STRETCHED)


def test_a_paused_motion_is_stopped_when_its_client_hangs_up(cell: Cell) -> None:
    cell.start_move(FAR)
    cell.run(0.4)
    cell.client.ask("pause")
    cell.run(0.02)
    cell.channel.close()
    cell.run(PERIOD_S)
    assert cell.mode is Mode.STOPPING
    cell.until(lambda: cell.mode is Mode.HOLDING, 0.5)


def test_an_override_slows_a_motion_down_and_up_again(cell: Cell) -> None:
    cell.client.ask("override", fraction=0.2)
    duration_s = cell.start_move(FAR)
    cell.run(duration_s)
    assert cell.client.status()["progress"] == pytest.approx(0.2, abs=0.01)
    cell.client.ask("override", fraction=1.0)
    cell.until(lambda: cell.mode is Mode.HOLDING, 0.8 * duration_s + 0.3)
    assert cell.client.status()["override"] == 1.0
    assert cell.runtime.monitor.faults == ()


def test_a_client_waits_for_its_motion_through_a_pause_however_long_it_is(cell: Cell) -> None:
    """`move_joints` gives up on an arm that has not arrived 5 s after its motion's time; a pause is no such thing."""
    begun_s = cell.rig.clock.now_s()
    phases = iter([("pause", 0.3), ("resume", 10.0)])
    phase = [next(phases)]

    def operate() -> None:
        do, at_s = phase[0]
        if cell.rig.clock.now_s() - begun_s >= at_s:
            assert handled(cell, {"do": do})["ok"]
            phase[0] = next(phases, ("status", math.inf))

    cell.watchers.append(operate)
    cell.client.move_joints(FAR)
    assert cell.rig.clock.now_s() - begun_s > 10.0
    assert cell.rig.joint_rad() == pytest.approx(FAR, abs=3e-3)


@pytest.mark.parametrize("delay_s", [0.1, 0.25, 0.4])
def test_a_stop_of_a_motion_ends_on_its_path(delay_s: float) -> None:
    goal = (0.8, -0.3, 0.6)
    with holding_cell(scenario((-0.8, -0.6, 0.2))) as cell:
        start = cell.runtime.set_point.q_rad
        cell.start_move(goal)
        cell.run(delay_s)
        cell.client.ask("stop")
        cell.until(lambda: cell.mode is Mode.HOLDING, 0.45)
        at = cell.runtime.set_point.q_rad
        share = [(q - a) / (b - a) for q, a, b in zip(at, start, goal, strict=True)]
        assert share == pytest.approx([share[0]] * 3, abs=1e-6)  # a joint move is a straight line of the joints
        assert 0.0 < share[0] < 1.0
        assert cell.runtime.was_stopped
