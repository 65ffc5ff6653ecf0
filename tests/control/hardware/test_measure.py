"""From counts to angles, speeds and directions: what boards and counters do must not look like motion."""

from __future__ import annotations

import math
import statistics

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from control.hardware.measurement import Averaging, DIRECTION_STEP_rad, Measurement, RunningMean

SCALE_rad = 1e-4  # of a count
PERIOD_S = 0.002


class Map:
    """A joint map with a scale alone."""

    def __init__(self, scale_rad: float = SCALE_rad) -> None:
        self._scale_rad = scale_rad

    def radians(self, count: int) -> float:
        return self._scale_rad * count


def measurement(joints: int = 1, bits: int = 32) -> Measurement:
    return Measurement([Map()] * joints, [bits] * joints)


def feed(measured: Measurement, counts: list[int], start_s: float = 1.0, shift: int = 0) -> None:
    for cycle, count in enumerate(counts):
        measured.update([count], [shift], [start_s + cycle * PERIOD_S])


def wrapped(count: int, bits: int) -> int:
    """As a counter of so many bits sends it."""
    half = 1 << (bits - 1)
    return (count + half) % (2 * half) - half


def test_a_16_bit_counter_may_wrap_many_times_inside_the_travel() -> None:
    measured = measurement(bits=16)
    true = [int(200_000 * math.sin(0.002 * k)) for k in range(3000)]
    for cycle, count in enumerate(true):
        measured.update([wrapped(count, 16)], [0], [1.0 + PERIOD_S * cycle])
        assert measured.q_rad[0] == pytest.approx(SCALE_rad * count, abs=1e-12)
    # No wrap shows as speed: the fastest is 400 counts a cycle.
    assert abs(measured.speed_rad_s[0]) < 400 * SCALE_rad / PERIOD_S


def test_a_gap_in_which_a_counter_may_have_wrapped_is_told_once_and_the_first_report_is_none() -> None:
    measured = Measurement([Map()], [16], unseen_s=[0.3])
    told = []
    for at_s in (5.0, 5.3, 5.601, 5.603):
        measured.update([int(1000 * at_s)], [0], [at_s])
        told.append(measured.has_lost_turns[0])
    assert told == [False, False, True, False]


def test_a_constant_speed_is_measured_after_a_few_filter_times() -> None:
    measured = measurement()
    feed(measured, [7 * k for k in range(60)])
    assert measured.speed_rad_s[0] == pytest.approx(7 * SCALE_rad / PERIOD_S, rel=1e-6)


@given(late=st.lists(st.floats(0.0, 0.1), min_size=20, max_size=60), period_s=st.sampled_from([0.001, 0.004, 0.02]))
def test_counts_that_may_be_younger_than_they_say_make_no_speed_twice_the_true_one(late: list[float], period_s: float) -> None:
    """Each question is asked when the last was answered, and counted at its answer; the true speed is 1 rad/s."""
    measured, at_s, greatest = Measurement([Map()], [32], [1.2]), 1.0, 0.0
    for late_s in late:
        counted_s = at_s + late_s
        measured.update([round(counted_s / SCALE_rad)], [0], [at_s], [late_s])
        assert measured.leap_rad == [0.0]
        greatest = max(greatest, abs(measured.speed_rad_s[0]))
        at_s = counted_s + period_s
    assert greatest < 2.0 + SCALE_rad / period_s


def test_late_reports_do_not_change_the_speed_because_the_board_says_when_it_counted() -> None:
    steady, jittery = measurement(), measurement()
    feed(steady, [7 * k for k in range(60)])
    time_s, count = 1.0, 0
    for cycle in range(60):
        jittery.update([count], [0], [time_s])
        step = 1 + cycle % 3  # some cycles see a report that is two or three periods younger
        time_s, count = time_s + step * PERIOD_S, count + 7 * step
    assert jittery.speed_rad_s[0] == pytest.approx(steady.speed_rad_s[0], rel=1e-6)


def test_a_report_that_was_seen_before_changes_nothing() -> None:
    measured = measurement()
    feed(measured, [7 * k for k in range(20)])
    before = (measured.q_rad[0], measured.speed_rad_s[0], measured.direction[0])
    measured.update([7 * 19], [0], [1.0 + 19 * PERIOD_S])
    assert (measured.q_rad[0], measured.speed_rad_s[0], measured.direction[0]) == before


def test_a_shift_of_the_counter_moves_the_angle_but_is_no_motion() -> None:
    measured = measurement()
    feed(measured, [7 * k for k in range(50)])
    speed = measured.speed_rad_s[0]
    assert measured.update([7 * 50 + 30_000], [30_000], [1.0 + 50 * PERIOD_S])
    assert measured.q_rad[0] == pytest.approx(SCALE_rad * (7 * 50 + 30_000))
    assert measured.shifted_rad[0] == pytest.approx(SCALE_rad * 30_000)
    assert measured.speed_rad_s[0] == pytest.approx(speed)
    assert measured.direction == [1]
    assert not measured.update([7 * 51 + 30_000], [30_000], [1.0 + 51 * PERIOD_S])


def test_a_counter_that_was_set_is_taken_at_its_word_however_often_it_had_wrapped() -> None:
    measured = measurement(bits=16)
    raw = [wrapped(count, 16) for count in range(32_700, 40_000, 100)]
    feed(measured, raw)
    assert measured.q_rad[0] > 32_767 * SCALE_rad
    measured.update([500], [500 - raw[-1]], [1.0 + len(raw) * PERIOD_S])
    assert measured.q_rad[0] == pytest.approx(500 * SCALE_rad)
    assert measured.shifted_rad[0] == pytest.approx((500 - 39_900) * SCALE_rad)


def test_the_shift_of_one_joint_leaves_the_others_where_they_are() -> None:
    measured = measurement(2)
    measured.update([10, 20], [0, 0], [1.0, 1.0])
    measured.update([110, 20], [100, 0], [1.002, 1.002])
    assert measured.shifted_rad == pytest.approx([100 * SCALE_rad, 0.0])
    measured.update([110, 70], [100, 50], [1.004, 1.004])
    assert measured.shifted_rad == pytest.approx([0.0, 50 * SCALE_rad])
    assert measured.speed_rad_s == pytest.approx([0.0, 0.0], abs=1e-9)


def test_dither_at_a_set_point_does_not_change_the_direction() -> None:
    measured = measurement()
    dither = int(DIRECTION_STEP_rad / SCALE_rad)
    feed(measured, [*range(0, 200, 5), *([195, 195 - dither] * 50)])
    assert measured.direction == [1]
    feed(measured, [195 - dither - 1], start_s=2.0 - PERIOD_S)  # one count more is a motion back
    assert measured.direction == [-1]


@pytest.mark.parametrize("scale_rad", [SCALE_rad, 1.5e-3])  # the supplied arm's, and a smart servo's
def test_an_encoder_between_two_counts_changes_no_direction(scale_rad: float) -> None:
    measured = Measurement([Map(scale_rad)], [16])
    feed(measured, [*range(1000, 1100), *([1099, 1098] * 50)])
    assert measured.direction == [1]
    feed(measured, [1096], start_s=1.0 + 200 * PERIOD_S)
    assert measured.direction == [-1]


def test_the_direction_is_unknown_until_something_has_moved() -> None:
    measured = measurement()
    feed(measured, [5] * 10)
    assert measured.direction == [0]


def test_a_slow_creep_turns_the_direction_though_no_single_cycle_moves_enough() -> None:
    measured = measurement()
    feed(measured, [*range(100), *range(99, 80, -1)])
    assert measured.direction == [-1]


@pytest.mark.parametrize("jump_s", [-0.9, -1e-6, 1.5])
def test_time_that_goes_backwards_or_stands_long_starts_the_speed_anew(jump_s: float) -> None:
    measured = measurement()
    feed(measured, [50 * k for k in range(30)])
    measured.update([-40_000], [0], [1.0 + 29 * PERIOD_S + jump_s])
    assert measured.speed_rad_s == [0.0]
    measured.update([-40_000], [0], [1.0 + 30 * PERIOD_S + jump_s])
    assert measured.speed_rad_s == [0.0]
    assert measured.q_rad == [pytest.approx(-40_000 * SCALE_rad)]


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**20), 2**20), st.integers(-(10**7), 10**7)),
        min_size=1,
        max_size=40,
    ),
    st.sampled_from([16, 24, 32]),
)
def test_whatever_a_board_sends_angles_and_speeds_are_finite(reports: list[tuple[int, int, int]], bits: int) -> None:
    measured = measurement(bits=bits)
    for count, shift, time_us in reports:
        measured.update([wrapped(count, bits)], [shift], [1e-6 * time_us])
        assert math.isfinite(measured.q_rad[0])
        assert math.isfinite(measured.speed_rad_s[0])
        assert measured.direction[0] in (-1, 0, 1)


@settings(deadline=None)
@given(st.lists(st.tuples(*[st.floats(-10.0, 10.0)] * 3), min_size=2, max_size=50), st.floats(-1e3, 1e3))
def test_a_running_mean_is_numpys(values: list[tuple[float, ...]], offset: float) -> None:
    mean = RunningMean()
    vectors = np.array(values) + offset
    for vector in vectors:
        mean.add([float(value) for value in vector])
    assert mean.count == len(values)
    assert mean.mean() == pytest.approx(vectors.mean(axis=0), abs=1e-10)
    assert mean.std() == pytest.approx(vectors.std(axis=0, ddof=1), abs=1e-5)


def test_a_single_vector_has_no_deviation() -> None:
    mean = RunningMean()
    mean.add([1.0, 2.0])
    assert (mean.mean(), mean.std()) == ((1.0, 2.0), (0.0, 0.0))


def test_micrometres_on_top_of_a_metre_keep_their_spread() -> None:
    mean, values = RunningMean(), [1.0 + 1e-6 * math.sin(k) for k in range(1000)]
    for value in values:
        mean.add([value])
    assert mean.std()[0] == pytest.approx(statistics.stdev(values), rel=1e-6)


def test_an_average_is_over_its_duration_of_cycles_and_of_the_frames_that_came() -> None:
    measured = measurement()
    averaging = Averaging(0.0, 0.1)
    for cycle in range(200):
        now_s = PERIOD_S * (cycle + 1)
        measured.update([1000 + cycle % 2], [0], [now_s])
        tip_m = (0.5, 0.0, 0.1 + 0.001 * (cycle % 10 == 5)) if cycle % 5 == 0 else None
        averaging.add(now_s, measured, [2.0], None if tip_m is None else (tip_m, None))
    result = averaging.result
    assert result is not None
    assert (result.samples, result.camera_frames, result.t_s) == (50, 10, 0.0)
    assert result.q_rad == pytest.approx((1000.5 * SCALE_rad,))
    assert result.count_rad == pytest.approx((SCALE_rad,))
    assert result.current_A == (2.0,)
    assert result.tip_m == pytest.approx((0.5, 0.0, 0.1005))
    assert result.tip_std_m == pytest.approx((0.0, 0.0, 0.000527), abs=1e-6)


def test_an_average_without_a_camera_has_no_tip() -> None:
    averaging = Averaging(0.0, 0.01)
    for cycle in range(6):
        averaging.add(PERIOD_S * cycle, measurement(), [0.0], None)
    assert averaging.result is not None
    assert (averaging.result.tip_m, averaging.result.camera_frames) == (None, 0)
