"""Motions for any input: what is promised of splines, joint moves and stops holds, or the input is refused."""

import math
from itertools import pairwise

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from control.errors import MotionError
from control.model.description import load_arm
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove, StopMotion
from control.motion.setpoint import SetPoint
from control.motion.spline import timed

LIMITS = JointLimits.of(load_arm("right"))
coordinates = st.floats(-0.5, 0.5).map(lambda value: round(value, 4))
points = st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=2, max_size=8)
angles = st.tuples(*(st.floats(low, high) for low, high in zip(LIMITS.lower_rad, LIMITS.upper_rad, strict=True)))


def _distinct(waypoints):
    return all(math.dist(a, b) > 1e-3 for a, b in pairwise(waypoints))


def _can_stay(state):
    """Whether a normal stop from `state` stays well inside: a move that starts so must not be refused."""
    room = [min(hi - q, q - lo) for q, lo, hi in zip(state.q_rad, LIMITS.lower_rad, LIMITS.upper_rad, strict=True)]
    return all(space > 0.3 for space in room)


@settings(max_examples=60, deadline=None)
@given(points, st.floats(0.01, 1.0), st.booleans())
def test_any_spline_meets_its_points_is_continuous_in_velocity_and_rests_at_its_ends(waypoints, speed, is_free):
    assume(_distinct(waypoints))
    recipe = timed(waypoints, None if is_free else speed, pace_m_s=speed)
    spline = recipe.spline()
    for knot, point in zip(spline.times_s, waypoints, strict=True):
        assert spline.at(knot)[0] == pytest.approx(point, abs=1e-9)
    for knot in spline.times_s[1:-1]:
        before, after = spline.at(knot * (1 - 1e-13)), spline.at(knot * (1 + 1e-13))
        assert before[1] == pytest.approx(after[1], abs=1e-6 * speed + 1e-9)
    assert math.hypot(*spline.at(0.0)[1]) < 1e-9
    assert math.hypot(*spline.at(spline.duration_s)[1]) < 1e-9


@settings(max_examples=60, deadline=None)
@given(points, st.floats(0.01, 1.0))
def test_with_one_speed_no_way_point_is_passed_faster_and_the_way_between_hardly(waypoints, speed):
    assume(_distinct(waypoints))
    spline = timed(waypoints, speed).spline()
    for knot in spline.times_s:
        assert math.hypot(*spline.at(knot)[1]) <= speed * (1.0 + 1e-9)
    for i in range(300):
        assert math.hypot(*spline.at(spline.duration_s * i / 300)[1]) <= 1.5 * speed


@settings(max_examples=60, deadline=None)
@given(angles, angles, st.floats(0.05, 1.0), st.floats(0.0, 1.0))
def test_any_move_and_a_stop_from_anywhere_on_it_keep_all_limits(start, end, fraction, share):
    move = JointMove(start, end, LIMITS.scaled(fraction))
    stop = StopMotion(move.at(share * move.duration_s), LIMITS)
    for motion in (move, stop):
        for i in range(41):
            point = motion.at(motion.duration_s * i / 40)
            for j in range(3):
                assert LIMITS.lower_rad[j] - 1e-9 <= point.q_rad[j] <= LIMITS.upper_rad[j] + 1e-9
                assert abs(point.speed_rad_s[j]) <= LIMITS.speed_rad_s[j] * (1 + 1e-9)
                assert abs(point.acceleration_rad_s2[j]) <= 3.0 * LIMITS.acceleration_rad_s2[j] * (1 + 1e-9)
    assert stop.overshoot_rad == (0.0, 0.0, 0.0)


@settings(max_examples=60, deadline=None)
@given(angles, st.tuples(*[st.floats(-2.0, 2.0)] * 3), angles)
def test_a_move_from_any_moving_state_stays_in_range_or_is_refused(start, speed, end):
    state = SetPoint(start, speed, (0.0, 0.0, 0.0))
    try:
        move = JointMove(state, end, LIMITS)
    except MotionError:
        assert not _can_stay(state)
        return
    assert move.at(move.duration_s).q_rad == end
    for i in range(41):
        for q, low, high in zip(move.at(move.duration_s * i / 40).q_rad, LIMITS.lower_rad, LIMITS.upper_rad, strict=True):
            assert low - 1e-8 <= q <= high + 1e-8
