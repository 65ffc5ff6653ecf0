"""Held-out error: what was left out had no part in the fit, and is scored by what is known about it."""

import dataclasses

import numpy as np
import pytest

from calib.arm_problem.link_bending import known_bending
from calib.arrays import norms
from calib.errors import CalibrationError
from calib.identify import ArmModel, LeastSquares, problem_of
from calib.points.points import joined, make_points
from calib.validation.holdout import held_out
from control.model.arm import Effect
from tests.calib.simulated import RIGHT, NOISE_m, board_points, true_dh, with_rows

LSQ = LeastSquares()
UNPLACED = dataclasses.replace(RIGHT, table=dataclasses.replace(RIGHT.table, known_pose=False))


def build(points):
    return problem_of(RIGHT, points)


def test_each_setup_is_left_out_once_and_predicted_to_about_the_noise() -> None:
    rng = np.random.default_rng(1)
    points = board_points(rng, true_dh(rng))
    found = held_out(build, points, "setup", LSQ)
    assert [fold.name for fold in found.folds] == ['setup "normal"', 'setup "roll"', 'setup "pitch"']
    assert sorted(row for fold in found.folds for row in fold.rows) == list(range(99))
    nominal = norms(problem_of(RIGHT, points).residuals(np.zeros(16)))
    assert np.mean(found.before_m) == pytest.approx(nominal.mean(), rel=1e-6)
    # Noise alone makes 1.6 * 0.14 mm; from two boards to the third adds some.
    assert 1.3 * NOISE_m < np.mean(found.after_m) < 4 * NOISE_m
    assert found.improvement_percent > 90.0


def test_a_gross_error_in_one_setup_shows_there_and_not_in_its_own_fit() -> None:
    rng = np.random.default_rng(2)
    points = board_points(rng, true_dh(rng))
    tips = np.array(points.tip_m)
    tips[66:] += [0.0, 0.0, 0.004]
    found = held_out(build, with_rows(points, tip_m=tips), "setup", LSQ)
    assert found.folds[2].mean_after_m > 0.0025


def test_every_third_point_is_left_out_interleaved() -> None:
    rng = np.random.default_rng(3)
    points = board_points(rng, true_dh(rng), ("normal",))
    found = held_out(build, points, 3, LSQ)
    assert [fold.rows[:3] for fold in found.folds] == [(0, 3, 6), (1, 4, 7), (2, 5, 8)]
    assert {fold.measure for fold in found.folds} == {"error"}


def test_a_board_of_unknown_place_that_is_left_out_is_scored_by_the_scatter_in_its_cavities() -> None:
    rng = np.random.default_rng(4)
    dh = true_dh(rng, size=0.4)
    both = joined([board_points(rng, dh, is_measured=False) for _ in range(2)])
    found = held_out(lambda points: problem_of(UNPLACED, points), both, "setup", LSQ)
    assert found.is_scatter
    # Two tips about their mean: 1.6 * 0.14 mm / sqrt(2).
    assert np.mean(found.after_m) == pytest.approx(1.6 * NOISE_m / np.sqrt(2), rel=0.15)


def test_without_a_choice_setups_are_left_out_if_there_are_several_else_every_fifth_point() -> None:
    rng = np.random.default_rng(5)
    points = board_points(rng, true_dh(rng), ("normal",))
    assert held_out(build, points, objective=LSQ).by == "every 5th point"


def test_one_setup_cannot_be_left_out() -> None:
    rng = np.random.default_rng(6)
    points = board_points(rng, true_dh(rng), ("normal",))
    with pytest.raises(CalibrationError, match=r"got one \(\"normal\"\).*every 5th point"):
        held_out(build, points, "setup")
    with pytest.raises(CalibrationError, match="k from 2 to 33; got 1"):
        held_out(build, points, 1)


def test_progress_is_reported_fold_by_fold() -> None:
    rng = np.random.default_rng(7)
    heard = []
    points = board_points(rng, true_dh(rng))
    held_out(build, points, "setup", LSQ, report=lambda done, of: heard.append((done, of)))
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_free_poses_are_left_out_part_by_part() -> None:
    """Without any of them nothing tells about where they are: that would test the board, not the result."""
    rng = np.random.default_rng(4)
    dh = true_dh(rng)
    board, model = board_points(rng, dh), ArmModel(RIGHT)
    q = rng.uniform(-1.0, 1.0, (12, 3))
    tips = model.tips(dh, q) + rng.normal(0.0, NOISE_m, (12, 3))
    free = make_points(["free"] * 12, [f"f{k}" for k in range(12)], [1] * 12, q, tips)
    found = held_out(build, joined([board, free]), objective=LSQ)
    assert [fold.name for fold in found.folds[:3]] == ['setup "normal"', 'setup "roll"', 'setup "pitch"']
    assert [fold.name for fold in found.folds[3:]] == [f'part {k} of 4 of setup "free"' for k in (1, 2, 3, 4)]
    assert [len(fold.rows) for fold in found.folds[3:]] == [3, 3, 3, 3]
    assert found.after_m.mean() < 1.3 * 1.6 * NOISE_m


def test_a_flexure_that_the_arms_file_has_bends_what_is_left_out_too() -> None:
    rng = np.random.default_rng(9)
    arm = dataclasses.replace(RIGHT, effects=(Effect("link_flexure", 2, {"EI_Nm2": 60.0}),))
    points = board_points(rng, true_dh(rng))
    known = known_bending(arm, points.q_rad, points.payload_kg)
    assert known is not None
    bent = known.shift
    assert norms(bent).min() > 10 * NOISE_m
    points = with_rows(points, tip_m=points.tip_m + bent)
    found = held_out(lambda some: problem_of(arm, some), points, 3, LSQ)
    assert np.mean(found.after_m) < 2 * NOISE_m
