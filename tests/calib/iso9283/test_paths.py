"""ISO 9283 path characteristics, settling, corners, speeds and weaving: by hand on paths whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest

from calib.iso9283 import path_criteria, pose_criteria
from calib.iso9283.pose_criteria import Iso9283Error

MM = 1e-3
LINE = np.array([(0.0, 0, 0), (0.4, 0, 0)])


def sampled(start: object, end: object, count: int = 41) -> np.ndarray:
    share = np.linspace(0.0, 1.0, count)[:, None]
    return np.asarray(start) + share * (np.asarray(end, dtype=float) - np.asarray(start))


def crossed(commanded: np.ndarray, attained: list[np.ndarray], count: int = 20) -> tuple[np.ndarray, np.ndarray]:
    points, tangents = path_criteria.calculation_points(commanded, count, 0.05)
    return points, np.stack([path_criteria.crossings(points, tangents, one) for one in attained])


def test_a_path_that_lies_beside_is_as_far_off_as_it_lies() -> None:
    beside = [sampled((-0.01, y, 0.004), (0.41, y, 0.004), 37) for y in (0.002, 0.004)]
    points, attained = crossed(LINE, beside)
    assert path_criteria.path_accuracy(points, attained).total_m == pytest.approx(5 * MM, abs=1e-12)  # barycentre (3, 4) mm
    # l = 1 mm in both cycles, without scatter: RT = 1 mm
    assert path_criteria.path_repeatability(points, attained).total_m == pytest.approx(1 * MM, abs=1e-12)


def test_path_repeatability_is_mean_plus_three_sd_where_it_is_largest() -> None:
    # Three cycles at y = -3, 0, 3 mm at the end and together at the beginning: 2 + 3 sqrt(3) mm at the last point.
    fans = [sampled((-0.02, 0, 0), (0.42, y, 0), 100) for y in (-3 * MM, 0, 3 * MM)]
    points, attained = crossed(LINE, fans)
    share = (points[-1, 0] + 0.02) / 0.44
    assert path_criteria.path_repeatability(points, attained).total_m == pytest.approx(
        share * (2 + 3 * np.sqrt(3.0)) * MM, rel=1e-9
    )


def test_speed_along_the_path_and_where_samples_fall_make_no_deviation() -> None:
    circle = np.array([(0.1 * np.cos(a), 0.1 * np.sin(a), 0) for a in np.linspace(0, 2 * np.pi, 400)])
    uneven = np.array([(0.1 * np.cos(a), 0.1 * np.sin(a), 0) for a in 2 * np.pi * np.linspace(0, 1, 300) ** 1.5])
    points, attained = crossed(circle, [uneven, uneven[::-1][::-1]])
    # Chords of 2 pi 0.1 / 200 leave 0.1 (1 - cos) = 12 um at most.
    assert path_criteria.path_accuracy(points, attained).total_m < 2e-5


def test_of_several_crossings_the_nearest_counts_so_a_circle_is_not_taken_for_its_other_side() -> None:
    circle = np.array([(0.1 * np.cos(a), 0.1 * np.sin(a), 0) for a in np.linspace(0, 2 * np.pi, 721)])
    points, attained = crossed(circle, [1.05 * circle])
    assert path_criteria.path_accuracy(points, attained).total_m == pytest.approx(5 * MM, rel=1e-3)


def test_where_the_frame_stands_changes_no_path_figure() -> None:
    rng = np.random.default_rng(1)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    commanded = np.cumsum(rng.normal(size=(30, 3)) * 0.002 + (0.01, 0, 0), axis=0)
    attained = [commanded + rng.normal(size=(30, 3)) * 1e-4 for _ in range(4)]
    here = crossed(commanded, attained)
    there = crossed(commanded @ q.T + 1.0, [one @ q.T + 1.0 for one in attained])
    for figure in (path_criteria.path_accuracy, path_criteria.path_repeatability):
        assert figure(*there).total_m == pytest.approx(figure(*here).total_m, rel=1e-9)


def test_points_that_a_path_does_not_pass_are_counted_and_too_many_are_refused() -> None:
    points, attained = crossed(LINE, [sampled((0.1, 0, 0), (0.5, 0, 0))])
    found = path_criteria.path_accuracy(points, attained)
    assert found.skipped == int((points[:, 0] < 0.1).sum()) > 0
    with pytest.raises(Iso9283Error, match="same frame"):
        path_criteria.path_accuracy(*crossed(LINE, [sampled((10, 0, 0), (11, 0, 0))]))


def test_half_of_the_points_are_enough_and_fewer_are_not() -> None:
    points = sampled((0.0, 0, 0), (0.9, 0, 0), 10)
    attained = np.stack([points, points])
    attained[0, :5] = np.nan
    assert path_criteria.path_accuracy(points, attained).skipped == 5
    attained[1, 5] = np.nan
    with pytest.raises(Iso9283Error, match="only 4 of 10 calculation points"):
        path_criteria.path_accuracy(points, attained)


def test_one_path_has_an_accuracy_but_no_repeatability() -> None:
    points, attained = crossed(LINE, [sampled((-0.1, 0, 0), (0.5, 0, 0))])
    assert path_criteria.path_accuracy(points, attained).total_m < 1e-12
    with pytest.raises(Iso9283Error, match="at least 2 attained paths, got 1"):
        path_criteria.path_repeatability(points, attained)


def test_path_velocity_by_hand() -> None:
    cycles = [np.array([0.98, 1.02]), np.array([1.00, 1.06])]  # means 1.00 and 1.03
    velocity = path_criteria.path_velocity(1.0, cycles)
    assert velocity.accuracy_percent == pytest.approx(1.5)
    assert velocity.repeatability_percent == pytest.approx(100 * 3 * 0.03 / np.sqrt(2.0))
    assert velocity.fluctuation_m_s == pytest.approx(0.06)
    assert path_criteria.path_velocity(1.0, cycles[:1]).repeatability_percent is None


def test_speeds_are_exact_on_a_straight_run_and_noise_averages_as_said() -> None:
    t = np.arange(200) * 0.01
    tips = t[:, None] * np.array((0.3, 0.4, 0.0))
    assert path_criteria.speeds(t, tips, 0.2)[1] == pytest.approx(0.5, abs=1e-12)
    noise = np.random.default_rng(2).normal(scale=1e-4, size=tips.shape)
    said = 1e-4 * np.sqrt(12.0 / 21) / 0.2
    assert path_criteria.speeds(t, tips + noise, 0.2)[1].std() == pytest.approx(said, rel=0.4)  # 10 windows' worth


def approach(time_s: np.ndarray, decay_s: float, period_s: float, size_m: float) -> np.ndarray:
    """Along x to the origin, ringing."""
    x = size_m * np.exp(-time_s / decay_s) * np.cos(2 * np.pi * time_s / period_s)
    return np.column_stack((x, 0 * x, 0 * x))


def test_stabilization_time_runs_from_the_first_crossing_to_the_last() -> None:
    # |x| = 10, 1, 3, 1, 0 mm at 0 .. 4 s, band 2 mm: in at 8/9 s, out at 1.5 s, in for good at 2.5 s.
    time_s = np.arange(5.0)
    tip = MM * np.array([(10.0, 0, 0), (1, 0, 0), (3, 0, 0), (1, 0, 0), (0, 0, 0)])
    zero = np.zeros(3)
    assert pose_criteria.stabilization_time(time_s, tip, zero, 2 * MM) == pytest.approx(2.5 - 8 / 9)
    assert pose_criteria.overshoot(time_s, tip, zero, 2 * MM) == pytest.approx(3 * MM)
    assert pose_criteria.posing_time(time_s, tip, 0.5, zero, 2 * MM) == pytest.approx(2.0)


def test_an_arm_that_enters_and_stays_has_no_stabilization_time_and_no_overshoot() -> None:
    time_s = np.linspace(0, 5, 501)
    tip = approach(time_s, 0.5, 1e9, 0.1)
    rest = pose_criteria.rest_position(time_s, tip, 0.2)
    assert pose_criteria.stabilization_time(time_s, tip, rest, 1 * MM) == 0.0
    assert pose_criteria.overshoot(time_s, tip, rest, 1 * MM) == 0.0
    # e^(-t / 0.5) 100 mm = 1 mm at 0.5 ln 100
    assert pose_criteria.posing_time(time_s, tip, 0.0, np.zeros(3), 1 * MM) == pytest.approx(0.5 * np.log(100), abs=0.01)


def test_overshoot_of_a_ringing_arm_is_its_first_swing_beyond() -> None:
    time_s = np.linspace(0, 6, 6001)
    tip = approach(time_s, 0.5, 1.0, 0.1)
    beyond = np.abs(tip[time_s > 0.25]).max()
    assert pose_criteria.overshoot(time_s, tip, np.zeros(3), 0.2 * MM) == pytest.approx(beyond)


def test_an_arm_that_does_not_come_to_rest_is_refused() -> None:
    time_s = np.linspace(0, 1, 101)
    with pytest.raises(Iso9283Error, match="record until the arm rests"):
        pose_criteria.stabilization_time(time_s, approach(time_s, 0.5, 1e9, 0.1), np.zeros(3), 1e-4)
    with pytest.raises(Iso9283Error, match="time does not increase at sample 2"):
        pose_criteria.overshoot([0.0, 0.0, 1.0], np.zeros((3, 3)), np.zeros(3), 1e-4)
    with pytest.raises(Iso9283Error, match="limit band"):
        pose_criteria.overshoot([0.0, 1.0], np.zeros((2, 3)), np.zeros(3), 0.0)


def test_a_corner_that_is_cut_is_rounded_off_and_one_that_is_overrun_overshoots() -> None:
    corner, first, second = np.zeros(3), (0.0, 1, 0), (1.0, 0, 0)  # along y to the origin, then along x
    cut = np.array([(0, -0.1, 0), (0, -0.02, 0), (0.02, 0, 0), (0.1, 0, 0)], dtype=float)
    assert path_criteria.corner_round_off(corner, [cut]) == pytest.approx(0.02 / np.sqrt(2))
    assert path_criteria.corner_overshoot(corner, first, second, 0.1, [cut]) == 0.0
    over = np.array([(0, -0.1, 0), (0, 0.003, 0), (0.01, 0.005, 0), (0.05, -0.007, 0), (0.2, 0.05, 0)])
    assert path_criteria.corner_round_off(corner, [over]) == pytest.approx(0.0)  # it passes through the corner
    assert path_criteria.corner_overshoot(corner, first, second, 0.1, [over]) == pytest.approx(0.005)
    assert path_criteria.corner_overshoot(corner, first, second, 0.1, [over, cut]) == pytest.approx(0.0025)
    with pytest.raises(Iso9283Error, match="lie on one line"):
        path_criteria.corner_overshoot(corner, first, first, 0.1, [cut])


def weave(stroke_m: float, frequency_Hz: float, tilt: float = 0.0, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.arange(0.0, 5.0, 0.01)
    y = 0.5 * stroke_m * np.sin(2 * np.pi * frequency_Hz * time_s) + tilt * time_s
    tip = np.column_stack((0.05 * time_s, y, 0 * y))
    return time_s, tip + np.random.default_rng(4).normal(scale=noise_m or 1e-12, size=tip.shape)


@pytest.mark.parametrize(("tilt", "noise_m"), [(0.0, 0.0), (0.001, 1.4e-4)])
def test_a_weave_is_measured_also_where_it_lies_askew_and_in_noise(tilt: float, noise_m: float) -> None:
    found = path_criteria.weave_of(*weave(0.03, 1.2, tilt, noise_m), (0, 1.0, 0))
    # Noise makes crests a little higher: the largest of some near samples, two sd or so.
    assert found.stroke_m == pytest.approx(0.03, abs=2e-4 + 5 * noise_m)
    assert found.frequency_Hz == pytest.approx(1.2, rel=0.01)


def test_weaving_deviations_by_hand() -> None:
    found = path_criteria.weaving_deviations(path_criteria.Weave(0.020, 2.0), path_criteria.Weave(0.019, 2.1))
    assert found == pytest.approx((5.0, 5.0))
    with pytest.raises(Iso9283Error, match="four crossings"):
        path_criteria.weave_of(np.arange(50.0), np.column_stack([np.arange(50.0)] * 3), (0, 1.0, 0))
