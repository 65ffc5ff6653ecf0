"""Tip jogs of arms of two to seven joints: straight, turning in place, inside all limits, through singular poses, and stops."""

import math
import random
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.arms import FIVE, FOUR, SEVEN, SIX, TWO
from control.errors import ArmError
from control.kinematics import rotation
from control.kinematics.inverse import InverseKinematics
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.pose_inverse import task_of
from control.loop.jogging import Jogging, JogRequest, TipStep, TipVelocity
from control.model.arm import Arm
from control.model.description import load_arm
from control.motion.guard import Guard
from control.motion.jogs import DampedRates
from control.motion.joint_limits import JogLimits, JointLimits
from control.motion.setpoint import SetPoint, at_rest
from control.safety.limits import SetPointLimits, limit_set_point
from tests.cell import RIGHT

PERIOD_S = 0.002
STILL = (0.0, 0.0, 0.0)


class Hand:
    """Renews its request every 0.1 s while it holds on; every set-point must pass the loop's guard unclipped."""

    def __init__(self, arm: Arm, q_rad: Sequence[float] | None = None) -> None:
        assert arm.rest is not None
        free = replace(arm, table=None, limits=replace(arm.limits, floor_z_m=-9.0))
        self.poses = PoseKinematics(ForwardKinematics(arm))
        self.jogging = Jogging(JogLimits.of(arm), InverseKinematics(arm), Guard(free, JointLimits.of(arm)))
        self.state = at_rest(tuple(q_rad or arm.rest.q_rad))
        self.guards = [
            SetPointLimits(
                d.joint_lower_rad, d.joint_upper_rad, 1.05 * d.joint_speed_limit_rad_s, 1.05 * d.joint_acceleration_limit_rad_s2
            )
            for d in arm.drives
        ]
        self.now_s = 0.0
        self.states: list[SetPoint] = [self.state]

    def ask(self, request: JogRequest) -> None:
        self.request = request
        self.jogging.ask(self.now_s, request, self.state)

    def hold(self, duration_s: float, renews: bool = True) -> None:
        for cycle in range(round(duration_s / PERIOD_S)):
            self.now_s += PERIOD_S
            if renews and cycle % 50 == 0:
                self.jogging.ask(self.now_s, self.request, self.state)
            wanted = self.jogging.advance(self.now_s, PERIOD_S, self.state)
            allowed = limit_set_point(wanted.q_rad, self.state.q_rad, self.state.speed_rad_s, self.guards, PERIOD_S)
            assert not allowed.reasons, (self.now_s, allowed.reasons)
            self.state = wanted
            self.states.append(wanted)

    def finish(self, longest_s: float = 8.0) -> None:
        for _ in range(round(longest_s / PERIOD_S)):
            self.jogging.renew(self.now_s)
            self.hold(PERIOD_S, renews=False)
            if self.jogging.is_over:
                return
        raise AssertionError(f"still jogging: {self.jogging.limited}")

    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """Position [m] and rotation vector [rad] of the tip in each state, from the first."""
        tip = self.poses.batch([state.q_rad for state in self.states])
        turned = rotation.logarithms(tip.rotation @ tip.rotation[0].T)
        return tip.position_m - tip.position_m[0], turned


@pytest.mark.parametrize("arm", [SIX, SEVEN], ids=lambda arm: arm.name)
def test_along_an_axis_the_tip_goes_straight_and_does_not_turn(arm: Arm) -> None:
    hand = Hand(arm)
    hand.ask(TipStep(2, -0.06, 0.1))
    hand.finish()
    way, turned = hand.moved()
    np.testing.assert_allclose(way[-1], (0.0, 0.0, -0.06), atol=1e-6)
    assert np.abs(way[:, :2]).max() < 1e-5
    assert np.abs(turned).max() < 1e-5
    assert hand.jogging.limited == ""


@pytest.mark.parametrize("arm", [SIX, SEVEN], ids=lambda arm: arm.name)
def test_about_an_axis_of_the_tip_it_turns_in_place(arm: Arm) -> None:
    hand = Hand(arm)
    axis = hand.poses.batch([hand.state.q_rad]).rotation[0][:, 2]
    hand.ask(TipStep(5, 0.3, 0.4, of_tip=True))
    hand.finish()
    way, turned = hand.moved()
    np.testing.assert_allclose(turned[-1], 0.3 * axis, atol=1e-3)
    assert np.linalg.norm(way, axis=1).max() < 1e-5


def test_along_an_axis_of_the_tip_the_direction_is_the_tips() -> None:
    hand = Hand(SIX)
    axis = hand.poses.batch([hand.state.q_rad]).rotation[0][:, 0]
    hand.ask(TipVelocity((-0.05, 0.0, 0.0), of_tip=True))
    hand.hold(1.0)
    way, _ = hand.moved()
    along = way[-1] @ axis
    assert along == pytest.approx(-0.05, abs=0.01)
    assert np.linalg.norm(way[-1] - along * axis) < 1e-5


@pytest.mark.parametrize("arm", [FOUR, FIVE], ids=lambda arm: arm.name)
def test_with_four_and_five_joints_the_tip_still_goes_straight(arm: Arm) -> None:
    hand = Hand(arm)
    hand.ask(TipStep(1, 0.05, 0.1))
    hand.finish()
    way, _ = hand.moved()
    np.testing.assert_allclose(way[-1], (0.0, 0.05, 0.0), atol=1e-4)
    assert np.abs(way[:, [0, 2]]).max() < 1e-4


def test_a_turn_that_the_joints_cannot_make_is_said() -> None:
    hand = Hand(FOUR)
    x_of_base = TipVelocity(STILL, (0.3, 0.0, 0.0))
    hand.ask(x_of_base)
    hand.hold(0.5)
    assert "cannot move the tip this way" in hand.jogging.limited


def test_two_joints_jog_on_the_surface_that_they_reach() -> None:
    hand = Hand(TWO)
    hand.ask(TipVelocity((0.0, 0.0, 0.05)))
    hand.hold(0.8)
    way, _ = hand.moved()
    assert way[-1, 2] > 0.005


@pytest.mark.parametrize("arm", [TWO, RIGHT], ids=lambda arm: arm.name)
def test_two_and_three_joints_say_that_their_tip_does_not_turn_by_itself(arm: Arm) -> None:
    jogging = Jogging(JogLimits.of(arm), InverseKinematics(arm), Guard(arm, JointLimits.of(arm)))
    with pytest.raises(ArmError, match=f"{arm.joint_count} joints cannot turn its tip"):
        jogging.ask(0.0, TipVelocity(STILL, (0.1, 0.0, 0.0)), at_rest((0.0, -0.6, 0.2)[: arm.joint_count]))


@pytest.mark.parametrize("arm", [FOUR, SIX, SEVEN], ids=lambda arm: arm.name)
def test_an_arm_jogged_out_until_it_stops_can_be_jogged_back(arm: Arm) -> None:
    """At a stretched arm itself no joint moves the tip inwards; the jog stops before."""
    hand = Hand(arm)
    x, y, _ = hand.poses.batch([hand.state.q_rad]).position_m[0]
    out = 0.15 / math.hypot(x, y)
    hand.ask(TipVelocity((out * x, out * y, 0.0)))
    hand.hold(8.0)
    assert "the jog stopped: " in hand.jogging.limited
    there, _ = hand.moved()
    hand.ask(TipVelocity((-out * x, -out * y, 0.0)))
    hand.hold(1.0)
    back, _ = hand.moved()
    assert np.linalg.norm(back[-1] - there[-1]) > 0.05


def test_through_a_singular_pose_the_jog_is_slowed_and_goes_on() -> None:
    """Axes 4 and 6 become parallel on this way; a path there is refused."""
    hand = Hand(SIX)
    hand.ask(TipVelocity(STILL, (0.0, 0.4, 0.0)))
    seen = set()
    for _ in range(40):
        hand.hold(0.1)
        seen.add(hand.jogging.limited.partition(":")[0])
    assert "slowed near a singular pose" in seen
    _, turned = hand.moved()
    assert turned[-1, 1] > 0.7
    speeds = np.abs([state.speed_rad_s for state in hand.states])
    assert speeds.max() <= max(d.joint_speed_limit_rad_s for d in SIX.drives)


def test_a_jog_that_only_the_joints_speeds_slow_is_not_said_to_be_near_a_singular_pose() -> None:
    """At 0.25 m/s joint 2 would need 0.97 of its speed here, far from every singular pose (0.10 m/rad)."""
    hand = Hand(load_arm("openmanipulatorx"), (0.0, -0.3, 0.3, 0.3))
    hand.ask(TipVelocity((0.25, 0.0, 0.0)))
    hand.hold(0.02)
    assert hand.jogging.limited == "slowed: joint speeds are limited"


def test_at_the_end_of_a_range_the_arm_comes_to_rest_inside_and_can_go_back() -> None:
    short = replace(SIX, drives=tuple(replace(d, joint_lower_rad=-0.5) if d.joint == 3 else d for d in SIX.drives))
    hand = Hand(short)
    hand.ask(TipVelocity((-0.15, 0.0, 0.0)))
    hand.hold(2.5)
    assert "joint 3 would leave its range" in hand.jogging.limited
    assert hand.state.speed_rad_s == (0.0,) * 6
    assert min(state.q_rad[2] for state in hand.states) >= -0.5
    before = hand.state.q_rad[2]
    hand.ask(TipVelocity((0.1, 0.0, 0.0)))
    hand.hold(0.5)
    assert hand.state.q_rad[2] > before


def test_silence_brings_the_tip_to_rest() -> None:
    hand = Hand(SEVEN)
    hand.ask(TipVelocity((0.0, 0.1, 0.0)))
    hand.hold(0.5)
    hand.hold(1.0, renews=False)
    assert hand.jogging.is_over
    assert not any(hand.state.speed_rad_s)


@pytest.mark.parametrize("arm", [TWO, FIVE, SEVEN], ids=lambda arm: arm.name)
def test_whatever_is_asked_for_every_set_point_is_inside_all_limits(arm: Arm) -> None:
    draw, hand = random.Random(3), Hand(arm)
    for _ in range(5):
        some = [draw.uniform(-0.3, 0.3) for _ in range(6)]
        if arm.joint_count < 4:  # it has no joints to turn its tip
            some[3:] = [0.0] * 3
        ways = TipVelocity((some[0], some[1], some[2]), (some[3], some[4], some[5]), draw.random() < 0.5)
        axis = draw.randrange(3 if arm.joint_count < 4 else 6)
        step = TipStep(axis, draw.uniform(-0.2, 0.2), draw.uniform(0.01, 0.5), draw.random() < 0.5)
        request: JogRequest = draw.choice((ways, replace(ways, turn_rad_s=STILL), step))
        hand.ask(request)
        hand.hold(0.4)
    for before, after in pairwise(hand.states):
        for q, then, speed in zip(before.q_rad, after.q_rad, after.speed_rad_s, strict=True):
            assert abs(then - q) <= PERIOD_S * (abs(speed) + 10.0 * PERIOD_S) + 1e-9


def test_damping_bounds_the_rates_at_the_singular_pose_itself() -> None:
    poses = PoseKinematics(ForwardKinematics(SIX))
    task = task_of(poses, True)
    singular = DampedRates(task, np.array(poses.at(0.2, 1.2, -0.5, 0.3, 0.0, 0.1)[2]))
    assert singular.is_damped
    assert singular.margin_m < 1e-6
    for axis in np.eye(6):
        tip = 0.1 * axis
        assert np.linalg.norm(singular.rates(tip)) < 0.1 / 0.03 + 3.0
    regular = DampedRates(task, np.array(poses.at(0.2, 1.2, -0.5, 0.3, 1.2, 0.1)[2]))
    tip = np.array([0.1, 0.0, -0.05, 0.2, 0.0, 0.1])
    jacobian = np.array(poses.at(0.2, 1.2, -0.5, 0.3, 1.2, 0.1)[2])
    np.testing.assert_allclose(jacobian @ regular.rates(tip), tip, atol=1e-12)
    assert math.isfinite(regular.margin_m)
