"""Two arms keep apart: before a motion, in jogs, where motions lead, and at the last set-point."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import replace

import pytest

from control.errors import ArmError
from control.model.cell import Placed
from control.motion.setpoint import SetPoint, at_rest
from control.safety.collision import ArmBody, least_gap, pairs_between
from control.safety.modes import Mode
from control.server.client import RequestRefused
from procedures.drills.pair import thick_arm
from tests.cell import FRICTION, holding_cell, scenario
from tests.pair import APART, PAIR, Pair, holding_pair, open_pair

INWARD = {"left": (-0.6, -0.8, 0.0), "right": (0.6, -0.8, 0.0)}  # forearms would cross in the middle
OUTWARD = {"left": (0.6, -0.8, 0.0), "right": (-0.6, -0.8, 0.0)}
LEFT, RIGHT = (ArmBody(placed, PAIR.tool_length_m) for placed in PAIR.arms)


def beside_right() -> AbstractContextManager[Pair]:
    """The right arm stands in the middle, the left one clear of it: both have the same joint angles."""
    return holding_pair(scenario(INWARD["right"], effect=FRICTION))


def true_gap_m(pair: Pair) -> float:
    """How near the mocks' arms are."""
    one, other = LEFT.at(pair.robot("left").joint_rad()), RIGHT.at(pair.robot("right").joint_rad())
    return least_gap(one, other, pairs_between(LEFT, RIGHT), math.inf).gap_m


def least_true_gap_m(pair: Pair, duration_s: float) -> float:
    """The least of a time."""
    least = math.inf
    for _ in range(int(duration_s / 0.04)):
        pair.run(0.04)
        least = min(least, true_gap_m(pair))
    return least


def unchecked(pair: Pair) -> None:
    """Motions begin without a look at the other arm."""
    for one in pair.assembly.of_arms.values():
        one.requests.beside = None


def test_a_motion_that_meets_the_other_arm_is_refused_with_the_place() -> None:
    with beside_right() as pair:
        refusal = pair.refusal("left", do="move_joints", q_rad=INWARD["left"])
        assert "would come within" in refusal
        assert "of arm 'right' after 0." in refusal
        assert "m in the frame of the cell (clearance_m is 0.06); nothing was moved" in refusal
        assert pair.mode("left") is Mode.HOLDING
        pair.start_move("left", 0.3, -0.8, 0.0)


def test_a_motion_is_held_against_where_the_other_arm_will_be() -> None:
    with holding_pair() as pair:
        pair.start_move("right", *INWARD["right"], speed=0.3)
        pair.run(0.05)
        assert "of arm 'right'" in pair.refusal("left", do="move_joints", q_rad=INWARD["left"], speed=0.3)


def test_a_motion_may_follow_the_other_arm_into_the_place_that_it_leaves() -> None:
    with beside_right() as pair:
        pair.start_move("right", *OUTWARD["right"])
        pair.start_move("left", *INWARD["left"], speed=0.5)
        assert least_true_gap_m(pair, 1.2) > PAIR.clearance_m


def test_two_arms_may_pass_through_each_others_places_one_after_the_other() -> None:
    start = {"left": (-0.4, 0.7, -0.9), "right": (1.3, -0.2, -0.2)}
    goal = {"left": (-1.8, -0.2, -0.4), "right": (2.3, 0.5, -1.0)}
    with holding_pair(scenario(APART, base="demo")) as pair:
        for poses in (start, goal):
            moves = {arm: {"q_rad": q_rad, "speed": 1.0} for arm, q_rad in poses.items()}
            duration_s = pair.clients["left"].ask("move_together", moves=moves)["duration_s"]
            least_m = least_true_gap_m(pair, duration_s + 0.2)
        assert least_m > PAIR.clearance_m
        assert pair.mode("left") is pair.mode("right") is Mode.HOLDING


def test_two_motions_that_would_meet_are_stopped_before_they_do() -> None:
    with holding_pair() as pair:
        unchecked(pair)
        pair.start_move("left", *INWARD["left"], speed=0.7)
        pair.start_move("right", *INWARD["right"], speed=0.7)
        least_m = least_true_gap_m(pair, 0.8)
        assert pair.faults("left") == pair.faults("right") == [("collision", "motion")]
        assert pair.mode("left") is pair.mode("right") is Mode.FAULT
        assert least_m > 0.0


def test_a_motion_towards_an_arm_that_holds_stops_and_the_other_holds_on() -> None:
    with beside_right() as pair:
        unchecked(pair)
        pair.start_move("left", *INWARD["left"])
        assert least_true_gap_m(pair, 0.8) > 0.0
        assert (pair.faults("left"), pair.mode("right")) == ([("collision", "motion")], Mode.HOLDING)
        pair.clients["left"].acknowledge()
        pair.start_move("left", *OUTWARD["left"])  # away again


@pytest.mark.parametrize("jog", [{"joint_speed_rad_s": [-1.0, 0.0, 0.0]}, {"tip_velocity_m_s": [0.0, -0.3, 0.0]}])
def test_a_jog_comes_to_rest_before_the_other_arm(jog: dict[str, object]) -> None:
    arms = [placed.arm for placed in PAIR.arms]
    fast = PAIR.with_arms([replace(arm, limits=replace(arm.limits, jog_tip_speed_m_s=1.0)) for arm in arms])
    with holding_pair(scenario(INWARD["right"], effect=FRICTION), fast) as pair:
        limited = ""
        while not limited:
            limited = pair.clients["left"].ask("jog", **jog)["limited"]
            pair.run(0.1)
        pair.until(lambda: pair.mode("left") is Mode.HOLDING, 1.0)
        assert "of arm 'right'" in limited
        assert PAIR.clearance_m - 2e-3 < true_gap_m(pair) < PAIR.clearance_m + 0.06


def test_tips_may_meet() -> None:
    with holding_pair(scenario((0.4, -0.6, 0.2), effect=FRICTION)) as pair:
        pair.clients["left"].move_joints((-0.4, -0.6, 0.2))
        tips = [PAIR.placed(arm).in_cell(pair.robot(arm).tip_m()) for arm in ("left", "right")]
        assert math.dist(*tips) < PAIR.clearance_m


def test_beside_an_arm_that_is_not_homed_only_jogs_move() -> None:
    with open_pair() as pair:
        pair.clients["left"].enable()
        refusal = pair.refusal("left", do="move_joints", q_rad=OUTWARD["left"])
        assert refusal == (
            "arm 'right' is not homed, so its pose is unknown: home it first (`armwright home --arm right`); jogs are free"
        )
        assert pair.clients["left"].jog(joint=1, by_rad=0.05) == ""


def test_the_last_set_point_is_held_against_the_other_arm() -> None:
    with beside_right() as pair:
        objection = pair.runtime("left").parts.tool.guard.passing_objection
        assert objection(INWARD["left"], APART).startswith("the arm would come within 0.0")
        assert objection(OUTWARD["left"], APART) == ""
        assert objection(APART, INWARD["left"]) == ""


class Breaking:
    """A motion that stands, and raises from 0.2 s on: the watch of the arms looks there before the lookout of this one."""

    duration_s = 1.0

    def at(self, time_s: float) -> SetPoint:
        if time_s > 0.2:
            raise ArmError("no way further")
        return at_rest(APART)


def test_an_arm_whose_way_is_lost_ahead_is_stopped_and_the_loop_goes_on() -> None:
    with holding_pair() as pair:
        pair.runtime("left").start(Breaking())
        pair.until(lambda: pair.mode("left") is Mode.FAULT, 0.3)
        assert pair.faults("left") == [("motion", "motion")]
        assert "0.25 s later is unknown: no way further" in pair.runtime("left").monitor.faults[0].message
        pair.run(0.1)
        assert (pair.mode("right"), pair.faults("right")) == (Mode.HOLDING, [])


def test_an_arm_that_stands_alone_does_not_meet_itself() -> None:
    thick = thick_arm().arms[0].arm
    with holding_cell(scenario((0.0, -0.4, 0.4), effect=FRICTION), thick) as cell:
        with pytest.raises(RequestRefused, match="link 1 would meet its own link 3"):
            cell.client.move_joints((0.0, -0.4, -1.6))
        guard = cell.assembly.runtime.parts.tool.guard
        assert "link 1 of the arm would meet its own link 3" in guard.objection((0.0, -0.4, -1.6), (0.0, -0.4, 0.4))
        assert not guard.objection((0.0, -0.4, 0.2), (0.0, -0.4, 0.4))


def test_an_arm_does_not_meet_itself_between_the_poses_in_which_it_looks() -> None:
    thick, here = thick_arm().arms[0].arm, (0.0, -0.4, 0.4)
    body = ArmBody(Placed(thick), 0.0)
    with holding_cell(scenario(here, effect=FRICTION), thick) as cell:
        beside = cell.assembly.runtime.parts.tool.guard.beside
        assert beside is not None
        gaps_m = []
        for k in range(3000):  # folded and stretched in turn, by up to 0.03 rad from pose to pose
            q_rad = (0.3 * math.sin(0.01 * k), -0.4, -0.7 + 1.2 * math.sin(0.02 * k + 0.3 * math.sin(0.003 * k)))
            at = body.at(q_rad)
            gaps_m.append(least_gap(at, at, body.own_pairs, math.inf).gap_m)
            assert bool(beside.objection(q_rad, here, False)) == (gaps_m[-1] < 0.0), q_rad
        assert min(gaps_m) < 0.0 < max(gaps_m)
