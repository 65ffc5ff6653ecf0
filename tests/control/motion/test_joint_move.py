"""Joint moves and stops by ruckig: limits, synchronisation, moving starts, stops near the end of a range."""

import math
import random

import pytest

from control.errors import MissingModel, MotionError
from control.model.arm import Arm, Drive, Link
from control.model.description import load_arm
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import HARDEST, JointMove, StopMotion, StraightStop
from control.motion.setpoint import SetPoint, at_rest

LIMITS = JointLimits.of(load_arm("right"))
START, END = (0.1, -0.5, 0.2), (1.2, 0.4, -0.7)


def _samples(motion, count=400):
    return [motion.at(motion.duration_s * i / count) for i in range(count + 1)]


def _within(motion, limits):
    period = motion.duration_s / 400
    previous = None
    for point in _samples(motion):
        for joint in range(3):
            assert abs(point.speed_rad_s[joint]) <= limits.speed_rad_s[joint] + 1e-9
            assert abs(point.acceleration_rad_s2[joint]) <= limits.acceleration_rad_s2[joint] + 1e-9
            if previous is not None:
                change = abs(point.acceleration_rad_s2[joint] - previous.acceleration_rad_s2[joint])
                assert change <= limits.jerk_rad_s3[joint] * period + 1e-6
        previous = point


def _same(point, expected):
    for values, wanted in zip(point, expected, strict=True):
        assert values == pytest.approx(wanted, abs=1e-12)


def test_limits_come_from_the_drives_of_the_arm():
    assert LIMITS.lower_rad == (-2.6, -1.9, -1.2)
    assert LIMITS.upper_rad == (2.6, 0.8, 1.5)
    assert (LIMITS.speed_rad_s[0], LIMITS.acceleration_rad_s2[1], LIMITS.jerk_rad_s3[2]) == (2.0, 10.0, 200.0)


def test_an_arm_without_motion_limits_is_refused_and_the_missing_key_named():
    bare = Arm("x", (Link("revolute", 0.0, 0.0, 0.1, 0.0),), drives=(Drive(1, 1.0, 4096, 0.1, 1.0, 12.0),))
    with pytest.raises(MissingModel, match="joint_speed_limit_rad_s"):
        JointLimits.of(bare)


def test_a_move_starts_and_ends_at_rest_where_it_should_within_all_limits():
    move = JointMove(START, END, LIMITS)
    _same(move.at(0.0), at_rest(START))
    assert move.at(move.duration_s) == at_rest(END)
    _within(move, LIMITS)


def test_all_joints_arrive_together_on_a_straight_line_in_joint_space():
    move = JointMove(START, END, LIMITS)
    for point in _samples(move):
        shares = [(q - a) / (b - a) for q, a, b in zip(point.q_rad, START, END, strict=True)]
        assert shares == pytest.approx([shares[0]] * 3, abs=1e-9)


@pytest.mark.parametrize("fraction", [0.05, 0.2, 0.5, 1.0])
def test_a_speed_fraction_makes_the_same_motion_in_that_much_more_time(fraction):
    full, slow = JointMove(START, END, LIMITS), JointMove(START, END, LIMITS.scaled(fraction))
    assert slow.duration_s == pytest.approx(full.duration_s / fraction, rel=1e-6)
    for share in (0.2, 0.5, 0.9):
        assert slow.at(share * slow.duration_s).q_rad == pytest.approx(full.at(share * full.duration_s).q_rad, abs=1e-6)


@pytest.mark.parametrize("fraction", [0.0, -0.5, math.nextafter(1.0, 2.0), math.nan])
def test_impossible_speed_fractions_are_refused(fraction):
    with pytest.raises(MotionError, match="speed fraction"):
        LIMITS.scaled(fraction)


def test_a_move_to_where_the_arm_rests_takes_no_time():
    move = JointMove(START, START, LIMITS)
    assert move.duration_s == 0.0
    assert move.at(0.0) == move.at(1.0) == at_rest(START)


def test_a_move_from_a_moving_state_continues_it_and_keeps_the_means_to_brake():
    state = SetPoint((0.0, 0.0, 0.0), (1.5, -0.5, 0.0), (2.0, 0.0, 0.0))
    move = JointMove(state, END, LIMITS)
    _same(move.at(0.0), state)
    _within(move, LIMITS)
    assert move.at(move.duration_s) == at_rest(END)


@pytest.mark.parametrize("sign", [(1, 1, 1), (1, -1, 1), (-1, 1, 1)])
def test_a_move_over_the_distance_at_which_the_acceleration_limit_is_just_touched_is_possible(sign):
    start = (0.62, 0.68, -0.9816)
    end = tuple(q + 0.05 * s for q, s in zip(start, sign, strict=True))  # 2 a^3 / j^2 of all three joints
    move = JointMove(start, end, LIMITS)
    _same(move.at(move.duration_s), at_rest(end))
    _within(move, LIMITS)
    assert move.duration_s == pytest.approx(4 * 10.0 / 200.0, rel=1e-3)


def test_times_outside_are_clamped():
    move = JointMove(START, END, LIMITS)
    assert move.at(-1.0) == move.at(0.0)
    assert move.at(1e6) == at_rest(END)


@pytest.mark.parametrize(("joint", "q", "excess"), [(0, 2.7, "0.1000"), (1, -2.0, "0.1000"), (2, 1.5001, "0.0001")])
def test_a_target_out_of_range_names_the_joint_and_by_how_much(joint, q, excess):
    target = list(END)
    target[joint] = q
    with pytest.raises(MotionError, match=rf"joint {joint + 1} cannot go .* {excess} rad outside"):
        JointMove(START, target, LIMITS)


def test_a_target_in_degrees_is_told_its_radians():
    with pytest.raises(MotionError, match=r"\(this looks like degrees: write 1\.5708\)"):
        JointMove(START, (90.0, 0.0, 0.0), LIMITS)


def test_targets_at_the_ends_of_the_range_are_allowed():
    assert JointMove(START, LIMITS.upper_rad, LIMITS).at(99.0).q_rad == LIMITS.upper_rad
    assert JointMove(START, LIMITS.lower_rad, LIMITS).at(99.0).q_rad == LIMITS.lower_rad


def test_a_target_beyond_the_range_by_rounding_ends_on_it():
    low = tuple(q - 5e-10 for q in LIMITS.lower_rad)
    assert JointMove(START, low, LIMITS).at(99.0).q_rad == LIMITS.lower_rad


def test_a_joint_outside_its_range_may_come_back():
    move = JointMove((2.7, 0.0, 0.0), (2.5, 0.0, 0.0), LIMITS)
    assert move.at(move.duration_s).q_rad[0] == 2.5


def test_a_start_too_fast_to_stay_inside_is_refused():
    with pytest.raises(MotionError, match=r"joint 1 .* leave its range by .* stop first"):
        JointMove(SetPoint((2.55, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0,) * 3), END, LIMITS)


def test_a_moving_start_that_overshoots_only_while_braking_is_refused_too():
    state = SetPoint((0.0, -1.75, 0.0), (0.0, -2.0, 0.0), (0.0,) * 3)
    with pytest.raises(MotionError, match=r"joint 2 .* leave its range by 0\.09\d\d rad"):
        JointMove(state, (0.0, 0.0, 0.0), LIMITS)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_numbers_that_are_not_finite_are_refused(bad):
    with pytest.raises(MotionError, match="finite"):
        JointMove(START, (bad, 0.0, 0.0), LIMITS)
    with pytest.raises(MotionError, match="finite"):
        JointMove((bad, 0.0, 0.0), END, LIMITS)
    with pytest.raises(MotionError, match="finite"):
        StopMotion(SetPoint(START, (bad, 0.0, 0.0), (0.0,) * 3), LIMITS)


def test_a_wrong_number_of_joints_is_refused():
    with pytest.raises(MotionError, match="expected 3"):
        JointMove(START, (0.0, 0.0), LIMITS)


def test_a_stop_continues_the_motion_and_ends_at_rest_within_all_limits():
    state = SetPoint((0.0, 0.0, 0.0), (1.8, -0.7, 0.2), (5.0, -10.0, 0.0))
    stop = StopMotion(state, LIMITS)
    _same(stop.at(0.0), state)
    _within(stop, LIMITS)
    assert stop.at(stop.duration_s).speed_rad_s == (0.0, 0.0, 0.0)
    assert stop.at(stop.duration_s).q_rad == pytest.approx(stop.at(stop.duration_s - 1e-9).q_rad, abs=1e-8)
    assert stop.overshoot_rad == (0.0, 0.0, 0.0)


def test_a_stop_at_rest_takes_no_time_and_stays():
    stop = StopMotion(at_rest(START), LIMITS)
    assert stop.duration_s == 0.0
    assert stop.at(0.0) == stop.at(5.0) == at_rest(START)


def test_the_stop_takes_as_long_as_its_slowest_joint_and_the_others_rest_meanwhile():
    stop = StopMotion(SetPoint((0.0,) * 3, (2.0, 0.1, 0.0), (0.0,) * 3), LIMITS)
    assert stop.duration_s == pytest.approx(0.25)
    assert stop.at(0.2).speed_rad_s[1:] == pytest.approx((0.0, 0.0), abs=1e-12)
    assert stop.at(0.2).q_rad[1:] == pytest.approx(stop.at(9.0).q_rad[1:])


def test_near_the_end_of_its_range_a_joint_brakes_harder_and_does_not_overshoot():
    normal = StopMotion(SetPoint((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0,) * 3), LIMITS).at(9.0).q_rad[0]
    for room in (normal * 0.95, normal * 0.85, normal * 0.6, normal * 0.3):
        stop = StopMotion(SetPoint((2.6 - room, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0,) * 3), LIMITS)
        assert max(point.q_rad[0] for point in _samples(stop)) <= 2.6 + 1e-9
        assert stop.overshoot_rad == (0.0, 0.0, 0.0)


def test_what_cannot_stop_in_time_stops_as_hard_as_it_may_and_says_how_far_it_goes():
    stop = StopMotion(SetPoint((2.59, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0,) * 3), LIMITS)
    assert stop.overshoot_rad[0] == pytest.approx(stop.at(9.0).q_rad[0] - 2.6)
    assert 0.0 < stop.overshoot_rad[0] < 0.07
    low = StopMotion(SetPoint((-2.59, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0,) * 3), LIMITS)
    assert low.overshoot_rad == pytest.approx(stop.overshoot_rad)


def test_any_move_interrupted_anywhere_stops_inside_the_range():
    numbers = random.Random(2)
    for _ in range(200):
        ends = [[numbers.uniform(lo, hi) for lo, hi in zip(LIMITS.lower_rad, LIMITS.upper_rad, strict=True)] for _ in "ab"]
        move = JointMove(ends[0], ends[1], LIMITS)
        stop = StopMotion(move.at(numbers.uniform(0.0, move.duration_s)), LIMITS)
        assert stop.overshoot_rad == (0.0, 0.0, 0.0)
        for point in _samples(stop, 40):
            for q, low, high in zip(point.q_rad, LIMITS.lower_rad, LIMITS.upper_rad, strict=True):
                assert low - 1e-9 <= q <= high + 1e-9


@pytest.mark.parametrize("time_s", [0.03, 0.05, 0.3])  # the acceleration rises, is at its limit, is over
def test_a_straight_stop_continues_a_straight_move_and_brakes_all_joints_by_one_law(time_s: float):
    state = JointMove(START, END, LIMITS).at(time_s)
    stop = StraightStop(state, LIMITS, 0)
    _same(stop.at(0.0), state)
    _within(stop, LIMITS)
    _same(stop.at(stop.duration_s), at_rest(stop.at(9.0).q_rad))
    ratio = state.speed_rad_s[1] / state.speed_rad_s[0]
    assert all(p.speed_rad_s[1] == pytest.approx(ratio * p.speed_rad_s[0], abs=1e-12) for p in _samples(stop))
    assert StraightStop(state, LIMITS, HARDEST).duration_s < 0.5 * stop.duration_s


def test_a_straight_stop_says_when_it_would_leave_a_range():
    state = SetPoint((2.55, 0.0, 0.0), (2.0, 0.1, 0.0), (0.0,) * 3)
    assert not StraightStop(state, LIMITS, 0).is_in_range
    assert StraightStop(state._replace(q_rad=(2.0, 0.0, 0.0)), LIMITS, 0).is_in_range
    assert StraightStop(state._replace(q_rad=(-2.7, 0.0, 0.0)), LIMITS, 0).is_in_range  # it comes back
