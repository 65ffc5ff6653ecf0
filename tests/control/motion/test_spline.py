"""Cartesian cubics: equation (3) from end conditions, tangents on circles, speeds, corners and errors."""

import math
import random

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from control.errors import PathError
from control.motion.spline import arc_lengths, hermite, section_times, tangents, timed

RADIUS, SPEED = 0.09, 0.15


def through(points, speeds=None, **how):
    return timed(points, speeds, **how).spline()


def _circle(count=24, turns=1.0, radius=RADIUS):
    angles = [2.0 * math.pi * turns * i / count for i in range(count + 1)]
    return [(0.5 + radius * math.cos(a), radius * math.sin(a), 0.1) for a in angles]


def _sample(spline, times):
    return [np.array(values) for values in zip(*(spline.at(t) for t in times), strict=True)]


def _random_points(count, seed=3):
    numbers = random.Random(seed)
    return [tuple(numbers.uniform(-0.3, 0.3) for _ in range(3)) for _ in range(count)]


def test_a_section_meets_position_and_velocity_at_both_ends():
    points, velocities = [(0.1, 0.2, 0.3), (0.5, -0.1, 0.2)], [(0.3, 0.0, -0.2), (-0.1, 0.4, 0.0)]
    spline = hermite(points, velocities, [0.8])
    for time, point, velocity in zip((0.0, 0.8), points, velocities, strict=True):
        position, speed, _ = spline.at(time)
        assert position == pytest.approx(point, abs=1e-14)
        assert speed == pytest.approx(velocity, abs=1e-14)


def test_velocity_and_acceleration_are_the_derivatives_of_position():
    spline = through(_random_points(6), 0.2)
    step = 1e-5
    for time in np.linspace(0.01, spline.duration_s - 0.01, 37):
        if min(abs(time - knot) for knot in spline.times_s) < 2 * step:
            continue
        before, here, after = (spline.at(time + k * step) for k in (-1, 0, 1))
        for axis in range(3):
            assert here[1][axis] == pytest.approx((after[0][axis] - before[0][axis]) / (2 * step), abs=1e-7)
            assert here[2][axis] == pytest.approx((after[1][axis] - before[1][axis]) / (2 * step), abs=1e-7)


@pytest.mark.parametrize("speeds", [0.2, None, [0.3, 0.1, 0.4, 0.2, 0.1]])
def test_it_passes_through_every_way_point_with_continuous_velocity(speeds):
    points = _random_points(5)
    spline = through(points, speeds)
    for knot, point in zip(spline.times_s, points, strict=True):
        before, after = spline.at(knot - 1e-12), spline.at(knot + 1e-12)
        assert after[0] == pytest.approx(point, abs=1e-11)
        assert before[1] == pytest.approx(after[1], abs=1e-9)


def test_without_speeds_the_acceleration_is_continuous_and_the_ends_are_at_rest():
    points = _random_points(7)
    spline = through(points)
    for knot in spline.times_s[1:-1]:
        assert spline.at(knot - 1e-12)[2] == pytest.approx(spline.at(knot + 1e-12)[2], abs=1e-7)
    for time in (0.0, spline.duration_s):
        assert spline.at(time)[1] == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_without_speeds_it_is_the_clamped_cubic_spline_of_scipy():
    points = _random_points(9)
    spline = through(points)
    peer = CubicSpline(spline.times_s, np.array(points), bc_type="clamped")
    times = np.linspace(0.0, spline.duration_s, 200)
    position, velocity, acceleration = _sample(spline, times)
    np.testing.assert_allclose(position, peer(times), atol=1e-12)
    np.testing.assert_allclose(velocity, peer(times, 1), atol=1e-11)
    inside = np.min(np.abs(times[:, None] - np.array(spline.times_s)), axis=1) > 1e-9
    np.testing.assert_allclose(acceleration[inside], peer(times, 2)[inside], atol=1e-10)


def test_tangents_on_a_circle_are_exact_even_with_uneven_points():
    angles = [0.0, 0.2, 0.9, 1.0, 1.7, 2.5]
    points = [(math.cos(a), math.sin(a), 0.0) for a in angles]
    for tangent, a in zip(tangents(points), angles, strict=True):
        assert tangent == pytest.approx((-math.sin(a), math.cos(a), 0.0), abs=1e-12)


def test_section_lengths_on_a_circle_are_exact():
    points = [(math.cos(a), math.sin(a), 0.0) for a in (0.0, 0.2, 0.9, 1.0)]
    assert arc_lengths(points, tangents(points)) == pytest.approx([0.2, 0.7, 0.1], abs=1e-12)


def test_a_circle_of_24_points_runs_at_constant_speed_and_stays_round():
    spline = through(_circle(), SPEED)
    inner = np.linspace(spline.times_s[1], spline.times_s[-2] - 1e-9, 4001)
    position, velocity, acceleration = _sample(spline, inner)
    speed = np.linalg.norm(velocity, axis=1)
    assert np.ptp(speed) < 1e-4 * SPEED
    assert np.max(np.abs(np.hypot(position[:, 0] - 0.5, position[:, 1]) - RADIUS)) < 2e-6
    assert np.max(np.linalg.norm(acceleration, axis=1)) < 1.01 * SPEED**2 / RADIUS


@pytest.mark.parametrize("count", [8, 12, 48])
def test_speed_ripple_on_coarser_and_finer_circles_stays_below_one_percent(count):
    spline = through(_circle(count), SPEED)
    _, velocity, _ = _sample(spline, np.linspace(spline.times_s[1], spline.times_s[-2], 2001))
    assert np.ptp(np.linalg.norm(velocity, axis=1)) < 0.01 * SPEED


def test_the_time_of_a_circle_is_its_length_over_the_speed_plus_the_two_ends():
    spline = through(_circle(), SPEED)
    section = 2.0 * math.pi * RADIUS / 24
    assert spline.duration_s == pytest.approx((22 * section + 2 * 1.5 * section) / SPEED, rel=1e-9)


def test_a_straight_line_leaves_rest_on_a_parabola_of_speed_and_keeps_its_speed():
    points = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.2, 0.0, 0.0), (0.3, 0.0, 0.0)]
    spline = through(points, 0.1)
    assert spline.times_s == pytest.approx((0.0, 1.5, 2.5, 4.0))
    _, velocity, acceleration = spline.at(0.75)
    assert velocity[0] == pytest.approx(0.075)
    assert acceleration[0] == pytest.approx(0.1 / 1.5)
    assert spline.at(1.5 - 1e-12)[2] == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert spline.at(2.0)[1] == pytest.approx((0.1, 0.0, 0.0))


@pytest.mark.parametrize("start", [0.0, 0.3, 0.8, 1.0])
@pytest.mark.parametrize("end", [0.0, 0.5, 1.0])
def test_on_a_straight_section_the_speed_never_exceeds_the_pace_nor_turns_back(start, end):
    (time,) = section_times([0.2], [start, end], [1.0])
    spline = hermite([(0.0,) * 3, (0.2, 0.0, 0.0)], [(start, 0.0, 0.0), (end, 0.0, 0.0)], [time])
    speeds = [spline.at(time * i / 200)[1][0] for i in range(201)]
    assert max(speeds) <= 1.0 + 1e-12
    assert min(speeds) >= -1e-12


def test_two_points_go_from_rest_to_rest_and_reach_the_speed_in_the_middle():
    spline = through([(0.0, 0.0, 0.0), (0.0, 0.3, 0.0)], 0.2)
    assert spline.duration_s == pytest.approx(1.5 * 0.3 / 0.2)
    assert spline.at(spline.duration_s / 2)[1] == pytest.approx((0.0, 0.2, 0.0))


def test_ends_move_only_where_that_is_asked_for():
    line = [(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.2, 0.0, 0.0)]
    assert through(line, [0.3, 0.2, 0.1]).at(0.0)[1] == (0.0, 0.0, 0.0)
    moving = through(line, [0.3, 0.2, 0.1], ends_at_rest=False)
    assert moving.at(0.0)[1] == pytest.approx((0.3, 0.0, 0.0))
    assert moving.at(moving.duration_s)[1] == pytest.approx((0.1, 0.0, 0.0))


def test_each_way_point_has_the_speed_that_it_asks_for():
    speeds = [0.1, 0.2, 0.05, 0.3, 0.1]
    spline = through(_circle(4, turns=0.25), speeds)
    for knot, speed in list(zip(spline.times_s, speeds, strict=True))[1:-1]:
        assert math.hypot(*spline.at(knot)[1]) == pytest.approx(speed)


def test_at_a_reversal_the_path_stops_and_makes_no_loop():
    points = [(0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.05, 0.0, 0.0)]
    spline = timed(points, 0.3).spline()
    assert spline.at(spline.times_s[1])[1] == (0.0, 0.0, 0.0)
    position, _, _ = _sample(spline, np.linspace(0.0, spline.duration_s, 500))
    assert position[:, 0].max() <= 0.2 + 1e-12
    assert np.abs(position[:, 1:]).max() == 0.0


def test_a_right_angle_is_taken_at_the_documented_share_of_the_speed():
    recipe = timed([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.1, 0.1, 0.0)], 0.2)
    share = 0.5 / math.cos(math.radians(22.5)) ** 2
    assert recipe.speeds_m_s[1] == pytest.approx(0.2 * share)


def test_corners_up_to_45_degrees_keep_their_speed():
    turn = math.radians(44.9)
    recipe = timed([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (0.1 + 0.1 * math.cos(turn), 0.1 * math.sin(turn), 0.0)], 0.2)
    assert recipe.speeds_m_s[1] == 0.2


@pytest.mark.parametrize("degrees", [60, 90, 120, 150, 170, 179])
def test_no_corner_makes_the_path_leave_its_chords_by_a_quarter(degrees):
    turn = math.radians(degrees)
    corner = (0.1 + 0.1 * math.cos(turn), 0.1 * math.sin(turn), 0.0)
    spline = through([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), corner], 0.2)
    position, _, _ = _sample(spline, np.linspace(0.0, spline.times_s[1], 300))
    assert position[:, 0].max() < 0.125
    assert np.abs(position[:, 1]).max() < 0.025


def test_stretching_keeps_the_path_and_divides_speed_and_acceleration():
    spline = through(_random_points(5), 0.2)
    slow = spline.stretched(1.7)
    assert slow.duration_s == pytest.approx(1.7 * spline.duration_s)
    for time in np.linspace(0.0, spline.duration_s, 23):
        for power, (a, b) in enumerate(zip(spline.at(time), slow.at(1.7 * time), strict=True)):
            assert [value * 1.7**power for value in b] == pytest.approx(a, abs=1e-9)


def test_slowing_one_section_leaves_far_sections_alone_and_velocity_continuous():
    recipe = timed(_circle(), SPEED)
    factors = [1.0] * 24
    factors[10] = 2.0
    slow = recipe.slowed(factors)
    assert slow.speeds_m_s[10] == slow.speeds_m_s[11] == pytest.approx(SPEED / 2)
    assert slow.speeds_m_s[9] == slow.speeds_m_s[12] == SPEED
    before, after = np.diff(recipe.spline().times_s), np.diff(slow.spline().times_s)
    assert after[10] == pytest.approx(2.0 * before[10])
    np.testing.assert_allclose(np.delete(after, [9, 10, 11]), np.delete(before, [9, 10, 11]), rtol=1e-12)


def test_slowing_a_rest_to_rest_path_stretches_its_time():
    recipe = timed([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)], 0.2)
    assert recipe.slowed([3.0]).spline().duration_s == pytest.approx(3.0 * recipe.spline().duration_s)


def test_times_outside_of_the_path_are_clamped():
    spline = through(_random_points(4), 0.2)
    assert spline.at(-5.0) == spline.at(0.0)
    assert spline.at(1e9) == spline.at(spline.duration_s)


def test_sampling_in_any_order_gives_the_same_values():
    spline = through(_random_points(8), 0.2)
    times = [random.Random(5).uniform(0.0, spline.duration_s) for _ in range(100)]
    forward = {t: spline.at(t) for t in sorted(times)}
    assert all(spline.at(t) == forward[t] for t in times)


@pytest.mark.parametrize(
    ("points", "speeds", "pattern", "number"),
    [
        ([(0.0, 0.0, 0.0)], 0.1, "at least two way-points, got 1", None),
        ([], 0.1, "at least two way-points, got 0", None),
        ([(0, 0, 0), (1, 0, 0), (1, 0, 0)], 0.1, "way-points 2 and 3 are the same", 3),
        ([(0, 0, 0), (math.nan, 0, 0)], 0.1, "way-point 2: expected three finite", 2),
        ([(0, 0, 0), (math.inf, 0, 0)], 0.1, "way-point 2: expected three finite", 2),
        ([(0, 0), (1, 0)], 0.1, "way-point 1: expected three finite", 1),
        ([(0, 0, 0), (1, 0, 0)], -0.1, "way-point 1: expected a speed", 1),
        ([(0, 0, 0), (1, 0, 0)], [0.1, math.nan], "way-point 2: expected a speed", 2),
        ([(0, 0, 0), (1, 0, 0)], [0.1], "one for each of the 2 way-points, got 1", None),
        ([(0, 0, 0), (1, 0, 0)], 0.0, "way-points 1 and 2 both have 0 m/s", 1),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [0.1, 0.0, 0.0], "way-points 2 and 3 both have 0 m/s", 2),
    ],
)
def test_impossible_way_points_are_refused_by_number(points, speeds, pattern, number):
    with pytest.raises(PathError, match=pattern) as caught:
        through(points, speeds)
    assert caught.value.waypoint == number
