"""Jogging without hardware: whatever is asked for, set-points stay inside all limits, and what is in the way is said."""

import math
import random
from dataclasses import replace
from itertools import pairwise

import pytest

from control.errors import ArmError, MotionError
from control.kinematics.inverse import InverseKinematics
from control.loop.jogging import Jogging, JointSpeeds, JointStep, TipStep, TipVelocity
from control.model.description import load_arm
from control.motion.guard import Guard
from control.motion.joint_limits import JogLimits, JointLimits, UNHOMED_SPEED_rad_s, reaches_m
from control.motion.joint_move import JointMove
from control.motion.setpoint import at_rest
from control.safety.limits import SetPointLimits, limit_set_point
from tests.thirds import third_of

ARM = load_arm("right")
ANYWHERE = Guard(  # neither floor nor table nor base: what they do is in tests/control/loop/test_workspace.py
    replace(ARM, table=None, limits=replace(ARM.limits, floor_z_m=-9.0, base_radius_m=0.0)), JointLimits.of(ARM)
)
INVERSE = InverseKinematics(ARM)
TIP = INVERSE.kinematics.tip
LIMITS = JogLimits.of(ARM)
PERIOD_S = 0.002
OVER_TABLE = INVERSE.nearest((0.5, 0.0, 0.1), (0.0, -0.6, 0.2))
GUARDS = [
    SetPointLimits(
        d.joint_lower_rad, d.joint_upper_rad, 1.05 * d.joint_speed_limit_rad_s, 1.05 * d.joint_acceleration_limit_rad_s2
    )
    for d in ARM.drives
]


class Hand:
    """Renews what it asks for every 0.1 s for as long as it holds on, and follows the set-point through the loop's guard."""

    def __init__(self, q_rad, is_homed=True):
        self.is_homed = is_homed
        self.jogging = Jogging(LIMITS, INVERSE, ANYWHERE if is_homed else None)
        self.state = at_rest(tuple(q_rad))
        self.guards = GUARDS
        self.now_s = 0.0
        self.states = [self.state]

    def ask(self, request):
        self.jogging.ask(self.now_s, request, self.state)

    def hold(self, duration_s, renews=True):
        for cycle in range(round(duration_s / PERIOD_S)):
            self.now_s += PERIOD_S
            if renews and cycle % 50 == 0:
                self.jogging.renew(self.now_s)
            wanted = self.jogging.advance(self.now_s, PERIOD_S, self.state)
            if self.is_homed:
                allowed = limit_set_point(wanted.q_rad, self.state.q_rad, self.state.speed_rad_s, self.guards, PERIOD_S)
                assert not allowed.reasons, (self.now_s, allowed.reasons)
                for v, before, guard in zip(wanted.speed_rad_s, self.state.speed_rad_s, self.guards, strict=True):
                    assert abs(v - before) / PERIOD_S <= guard.acceleration_rad_s2 + 1e-6, self.now_s
            self.state = wanted
            self.states.append(wanted)
            if self.jogging.is_over:
                break

    def tips(self):
        return [TIP(*state.q_rad) for state in self.states]


def test_a_result_that_ruckig_does_not_know_is_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its Python binding raises "-101 is not a valid Result" where it finds no target."""
    import ruckig

    class Lost:
        def __init__(self, joints: int) -> None:
            pass

        def calculate(self, asked: object, trajectory: object) -> None:
            raise ValueError("-101 is not a valid Result")

    monkeypatch.setattr(ruckig, "Ruckig", Lost)
    here = at_rest((0.1, -0.6, 0.2))
    for begin in (
        lambda: JointMove(here, (0.2, -0.5, 0.2), JointLimits.of(ARM)),
        lambda: Jogging(LIMITS, INVERSE, ANYWHERE).ask(0.0, JointSpeeds((0.1, 0.0, 0.0)), here),
    ):
        with pytest.raises(MotionError, match="there is no jerk-limited motion") as error:
            begin()
        assert "-101" not in str(error.value)


def test_a_joint_turns_at_the_speed_asked_for_and_rests_when_the_hand_lets_go():
    hand = Hand((0.1, -0.6, 0.2))
    hand.ask(JointSpeeds((0.2, 0.0, -0.3)))
    hand.hold(1.0)
    assert hand.state.speed_rad_s == pytest.approx((0.2, 0.0, -0.3), abs=1e-9)
    at = hand.now_s
    hand.hold(2.0, renews=False)
    assert hand.jogging.is_over
    # 0.2 s of silence since the last renewal, then 0.3 rad/s at 10 rad/s^2 and 200 rad/s^3: 80 ms
    assert hand.now_s - at < LIMITS.silence_s + 0.085
    assert max(map(abs, hand.state.speed_rad_s)) < 1e-12


def test_the_tip_goes_straight_and_no_faster_than_its_limit():
    hand = Hand(OVER_TABLE)
    hand.ask(TipVelocity((0.0, 0.0, 5.0)))
    hand.hold(1.0)
    hand.hold(1.0, renews=False)
    tips = hand.tips()
    steps = [math.dist(a, b) / PERIOD_S for a, b in pairwise(tips)]
    assert max(steps) == pytest.approx(0.25, rel=1e-6)
    # one Newton step a cycle: what 0.5 mm of way curve in it, at 0.25 m/s
    assert max(math.hypot(x - tips[0][0], y - tips[0][1]) for x, y, _ in tips) < 1e-6
    assert tips[-1][2] > 0.25
    assert hand.jogging.is_over


@pytest.mark.parametrize("joint", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_joint_comes_to_rest_at_the_end_of_its_range_and_says_so(joint, sign):
    hand = Hand((0.0, 0.0, 0.0))
    hand.ask(JointSpeeds(tuple(sign * 9.0 if j == joint else 0.0 for j in range(3))))
    hand.hold(12.0)
    drive = ARM.drives[joint]
    end = drive.joint_upper_rad if sign > 0 else drive.joint_lower_rad
    assert hand.state.q_rad[joint] == pytest.approx(end, abs=1e-9)
    assert hand.state.speed_rad_s[joint] == 0.0
    assert hand.jogging.limited == f"joint {joint + 1} is at the end of its range"
    hand.ask(JointSpeeds(tuple(-sign * 0.1 if j == joint else 0.0 for j in range(3))))
    hand.hold(0.5)
    assert hand.jogging.limited == ""
    assert sign * hand.state.q_rad[joint] < sign * end - 0.03


def with_elbow_to(upper_rad):
    """The arm with a longer range of joint 3, which can be stretched at 1.571 rad; its jog limits and inverse kinematics."""
    drives = (*ARM.drives[:2], replace(ARM.drives[2], joint_upper_rad=upper_rad))
    arm = replace(ARM, drives=drives)
    return JogLimits.of(arm), InverseKinematics(arm)


@pytest.mark.parametrize("speed_m_s", [0.02, 0.1, 0.25])
def test_before_a_stretched_pose_the_tip_slows_down_and_stops_in_words(speed_m_s):
    hand = Hand(OVER_TABLE)
    hand.guards = [*GUARDS[:2], replace(GUARDS[2], upper_rad=1.7)]
    hand.jogging = Jogging(*with_elbow_to(1.7), ANYWHERE)
    hand.ask(TipVelocity((speed_m_s, 0.0, 0.0)))
    hand.hold(0.6 / speed_m_s)
    assert "the jog stopped: " in hand.jogging.limited
    assert "singular pose" in hand.jogging.limited
    assert max(map(abs, hand.state.speed_rad_s)) < 1e-9
    shoulder_m = math.dist(TIP(*hand.state.q_rad), (0.0, 0.0, 0.076))
    assert 0.74 < shoulder_m < 0.7540  # the upper arm's 0.4 m and the forearm's 0.3543 m
    fastest = max(max(map(abs, state.speed_rad_s)) for state in hand.states)
    assert fastest <= 0.95 * 2.0
    hand.ask(TipVelocity((-speed_m_s, 0.0, 0.0)))
    hand.hold(0.2 / speed_m_s)
    assert TIP(*hand.state.q_rad)[0] < 0.7


def test_a_step_ends_where_it_was_to_and_needs_the_hand_until_then():
    hand = Hand(OVER_TABLE)
    start = TIP(*hand.state.q_rad)
    hand.ask(TipStep(2, 0.05, 0.1))
    hand.hold(3.0)
    assert hand.jogging.is_over
    assert TIP(*hand.state.q_rad) == pytest.approx((start[0], start[1], start[2] + 0.05), abs=1e-7)
    hand = Hand(OVER_TABLE)
    hand.ask(JointStep(1, 0.5, 0.2))
    hand.hold(3.0, renews=False)
    assert hand.jogging.is_over
    assert 0.02 < hand.state.q_rad[1] - OVER_TABLE[1] < 0.06


def test_a_step_out_of_range_or_reach_is_refused_and_nothing_moves():
    hand = Hand((0.0, 0.7, 0.0))
    with pytest.raises(ArmError, match=r"joint 2 cannot go to 0\.9000 rad"):
        hand.ask(JointStep(1, 0.2, 0.1))
    with pytest.raises(ArmError, match=r"rad \(this looks like degrees: write 0\.174533\)"):
        hand.ask(JointStep(1, 10.0, 0.1))
    with pytest.raises(ArmError, match="jog: "):
        hand.ask(TipStep(0, 2.0, 0.1))
    hand.hold(0.1)
    assert hand.state.q_rad == (0.0, 0.7, 0.0)


def test_from_a_nearly_stretched_pose_the_tip_can_be_jogged_back_but_not_on():
    for speed_m_s, moves in ((0.02, False), (-0.02, True)):
        hand = Hand((0.0, -1.5, math.pi / 2 - 0.04))
        hand.guards = [*GUARDS[:2], replace(GUARDS[2], upper_rad=1.7)]
        hand.jogging = Jogging(*with_elbow_to(1.7), ANYWHERE)
        start = TIP(*hand.state.q_rad)
        hand.ask(TipVelocity((speed_m_s, 0.0, 0.0)))
        hand.hold(1.0)
        assert ("the jog stopped: " in hand.jogging.limited) != moves
        assert (start[0] - TIP(*hand.state.q_rad)[0] > 0.01) == moves


def test_the_tip_does_not_cross_axis_1():
    hand = Hand(INVERSE.nearest((0.15, 0.0, 0.5), (0.0, 0.0, 0.5)))
    hand.ask(TipVelocity((-0.2, 0.0, 0.0)))
    hand.hold(2.0)
    assert hand.jogging.limited.startswith("the jog stopped: ")
    assert max(map(abs, hand.state.speed_rad_s)) < 1e-9


def test_from_joints_to_the_tip_the_arm_first_comes_to_rest():
    hand = Hand(OVER_TABLE)
    hand.ask(JointSpeeds((0.25, 0.0, 0.0)))
    hand.hold(0.5)
    hand.ask(TipVelocity((0.0, 0.0, 0.1)))
    hand.hold(1.0)
    moved = [b[2] - a[2] for a, b in zip(hand.tips(), hand.tips()[1:], strict=False)]
    assert moved[-1] / PERIOD_S == pytest.approx(0.1, rel=1e-6)
    assert any(not any(state.speed_rad_s) for state in hand.states[250:400])


def test_an_arm_that_is_not_homed_turns_its_joints_slowly_without_a_range_and_its_tip_not_at_all():
    hand = Hand((0.0, 0.79, 0.0), is_homed=False)
    hand.ask(JointSpeeds((0.0, 2.0, 0.0)))
    hand.hold(1.0)
    assert hand.state.speed_rad_s[1] == pytest.approx(UNHOMED_SPEED_rad_s)
    hand.hold(9.0)
    assert hand.state.q_rad[1] > 1.6
    hand.hold(1.0, renews=False)
    assert hand.jogging.is_over
    with pytest.raises(ArmError, match="armwright home"):
        Hand((0.0, 0.0, 0.0), is_homed=False).ask(TipVelocity((0.1, 0.0, 0.0)))


def test_a_joint_alone_never_moves_the_tip_faster_than_its_limit():
    reach = reaches_m(ARM)
    draw = random.Random(1)
    poses = [[draw.uniform(d.joint_lower_rad, d.joint_upper_rad) for d in ARM.drives] for _ in range(500)]
    columns = [list(zip(*INVERSE.kinematics.tip_jacobian(*q)[1], strict=True)) for q in poses]
    for joint in range(3):
        assert max(math.hypot(*pose[joint]) for pose in columns) <= reach[joint]
        assert LIMITS.joints.speed_rad_s[joint] * reach[joint] <= 0.25 + 1e-12


@pytest.mark.parametrize("seed", third_of(range(25)))
def test_whatever_is_asked_for_in_whatever_pose_all_limits_hold(seed):
    draw = random.Random(seed)
    hand = Hand([draw.uniform(d.joint_lower_rad, d.joint_upper_rad) for d in ARM.drives])

    def some(most):
        return tuple(draw.choice([0.0, draw.uniform(-most, most)]) for _ in range(3))

    for _ in range(12):
        request = draw.choice(
            [
                JointSpeeds(some(3.0)),
                TipVelocity(some(0.4)),
                TipVelocity(some(0.4)),
                JointStep(draw.randrange(3), draw.uniform(-0.3, 0.3), draw.uniform(0.1, 2.0)),
                TipStep(draw.randrange(3), draw.uniform(-0.1, 0.1), draw.uniform(0.01, 0.5)),
            ]
        )
        try:
            hand.ask(request)
        except ArmError:
            continue
        hand.hold(draw.choice([0.02, 0.1, 0.5, 1.0]), renews=draw.random() < 0.8)
        if hand.jogging.is_over:
            hand.jogging = Jogging(LIMITS, INVERSE, ANYWHERE)
            hand.state = at_rest(hand.state.q_rad)
