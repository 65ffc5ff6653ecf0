"""A path of one arm relative to the tip of another that moves meanwhile: planned, run, paused, and refused."""

from __future__ import annotations

import math

import numpy as np
import pytest

from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.pace import Stretched
from control.motion.plan import Beside, plan_beside
from control.motion.waypoints import Waypoints
from control.safety.modes import Mode
from tests.cell import FRICTION, scenario
from tests.pair import PAIR, PERIOD_S, Pair, holding_pair

POSE = (-0.2, -0.6, 0.3)
GOAL = (0.35, -0.4, 0.6)
LEFT, RIGHT = PAIR.placed("left"), PAIR.placed("right")
TIP = {placed.name: ForwardKinematics(placed.arm).tip for placed in PAIR.arms}
START = np.subtract(RIGHT.in_cell(TIP["right"](*POSE)), LEFT.in_cell(TIP["left"](*POSE)))
ROUND = np.array([(0.0, 0.0, 0.0), (0.0, -0.03, 0.02), (0.02, -0.05, 0.0), (0.0, -0.03, -0.02)])
OFFSETS = Waypoints(tuple(map(tuple, (START + ROUND).tolist())), None)
KEPT = Waypoints((tuple(START.tolist()),), None)


def led(goal: tuple[float, float, float] = GOAL) -> JointMove:
    return JointMove(POSE, goal, JointLimits.of(LEFT.arm).scaled(0.5))


def planned(offsets: Waypoints, goal: tuple[float, float, float] = GOAL) -> Beside:
    return plan_beside(RIGHT, LEFT, led(goal), offsets, POSE)


def at_the_start(pair: Pair) -> None:
    for client in pair.clients.values():
        client.move_joints(POSE)


def off_m(left_rad: tuple[float, ...], right_rad: tuple[float, ...], found: Beside, time_s: float) -> float:
    """How far the tips are from the offset of that time."""
    tips = RIGHT.in_cell(TIP["right"](*right_rad)), LEFT.in_cell(TIP["left"](*left_rad))
    return math.dist(np.subtract(*tips), found.offsets.at(time_s)[0])


@pytest.mark.parametrize("offsets", [OFFSETS, KEPT], ids=["a path", "kept"])
def test_the_plan_keeps_the_offset_all_along_within_micrometres(offsets: Waypoints) -> None:
    found = planned(offsets)
    assert found.slower >= 1.0
    leads = Stretched(led(), found.path.duration_s)
    follows = found.path.joints
    worst_m = 0.0
    for time_s in np.linspace(0.0, found.path.duration_s, 301).tolist():
        worst_m = max(worst_m, off_m(leads.at(time_s).q_rad, follows.at(time_s).q_rad, found, time_s))
    assert worst_m < 5e-6
    np.testing.assert_allclose(found.path.q_start_rad, POSE, atol=1e-6)


def run(pair: Pair, found: Beside, pauses: bool) -> tuple[float, float]:
    """Largest distances from the offset, of the set-points and of the true tips, over the whole motion."""
    moves = {"left": {"q_rad": GOAL, "speed": 0.5}, "right": {"path": found.path.to_message()}}
    pair.clients["left"].ask("move_together", moves=moves)
    wanted_m, true_m, cycle = [0.0], [0.0], 0
    paced = pair.runtime("right").paced
    assert paced is not None
    while pair.mode("left") is not Mode.HOLDING or pair.mode("right") is not Mode.HOLDING:
        pair.run(PERIOD_S)
        cycle += 1
        if pauses and cycle == 60:
            pair.clients["left"].pause()
        if pauses and cycle == 160:
            pair.clients["left"].override(0.6)
            pair.clients["left"].resume()
        left, right = (pair.runtime(arm).set_point.q_rad for arm in ("left", "right"))
        wanted_m.append(off_m(left, right, found, paced.time_s))
        tip, other = (placed.in_cell(pair.robot(placed.name).tip_m()) for placed in (RIGHT, LEFT))
        true_m.append(math.dist(np.subtract(tip, other), found.offsets.at(paced.time_s)[0]))
    return max(wanted_m), max(true_m)


@pytest.mark.parametrize("pauses", [True], ids=["paused and slowed"])
def test_both_tips_keep_the_offset_on_the_mock(pauses: bool) -> None:
    with holding_pair(scenario(POSE, effect=FRICTION)) as pair:
        at_the_start(pair)
        wanted_m, true_m = run(pair, planned(OFFSETS), pauses)
    print(f"relative error: set-points {1e6 * wanted_m:.1f} um, tips {1e3 * true_m:.2f} mm")
    assert wanted_m < 1e-5
    assert true_m < 3e-3


@pytest.mark.parametrize(
    ("offsets", "said"),
    [
        (Waypoints(((0.0, -0.5, 0.0), (0.0, -0.5, 1.0)), None), "s after the start, at offset way-point 1.*out of reach|beyond"),
        (Waypoints(KEPT.points, None, (), ((1.0, 0.0, 0.0, 0.0),)), "without orientation"),
    ],
)
def test_offsets_that_cannot_be_kept_are_refused_with_the_place(offsets: Waypoints, said: str) -> None:
    with pytest.raises(ArmError, match=said):
        planned(offsets)


def test_a_path_that_would_meet_the_other_arm_is_refused_by_the_runtime() -> None:
    inward = (-0.8, -0.4, 0.6)
    found = planned(Waypoints((KEPT.points[0], (0.0, 0.1, 0.05)), None), inward)
    with holding_pair(scenario(POSE, effect=FRICTION)) as pair:
        at_the_start(pair)
        moves = {"left": {"q_rad": inward, "speed": 0.5}, "right": {"path": found.path.to_message()}}
        assert "would come within" in pair.refusal("left", do="move_together", moves=moves)
        assert pair.mode("left") is pair.mode("right") is Mode.HOLDING
