"""Held-out error: what was left out had no part in the fit, and is scored by what is known about it."""

import dataclasses

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel, Bounds
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.joint_effects import known_corrections, resting_points
from calib.arm_problem.link_bending import known_bending
from calib.arrays import frozen, norms
from calib.calibration import CalibrationPlan, calibrate, calibrated_arm, identified
from calib.errors import CalibrationError
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise
from calib.points.points import joined, make_points
from calib.validation.holdout import held_out
from calib.validation.verify import errors_of, predicted_tips
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Effect
from tests.calib.simulated import RIGHT, NOISE_m, board_points, true_dh, with_rows

LSQ = LeastSquares()
UNPLACED = dataclasses.replace(RIGHT, table=dataclasses.replace(RIGHT.table, known_pose=False))


def build(points):
    return problem_of(RIGHT, points)


def predicted_by(build):
    """By least squares of the problem that is built of the other points."""

    def predicted(some, rest):
        best = minimise(problem := build(some), LSQ, starts_count=1)
        return tuple((build(rest), problem.solution(x)) for x in (np.zeros(len(best.x)), best.x))

    return predicted


def test_each_setup_is_left_out_once_and_predicted_to_about_the_noise() -> None:
    rng = np.random.default_rng(1)
    points = board_points(rng, true_dh(rng))
    held = held_out(predicted_by(build), points, "setup")
    assert [fold.name for fold in held.folds] == ['setup "normal"', 'setup "roll"', 'setup "pitch"']
    assert sorted(row for fold in held.folds for row in fold.rows) == list(range(99))
    nominal = norms(problem_of(RIGHT, points).residuals(np.zeros(16)))
    assert np.mean(held.before_m) == pytest.approx(nominal.mean(), rel=1e-6)
    # Noise alone makes 1.6 * 0.14 mm; from two boards to the third adds some.
    assert 1.3 * NOISE_m < np.mean(held.after_m) < 4 * NOISE_m
    assert held.improvement_percent > 90.0


def test_a_gross_error_in_one_setup_shows_there_and_not_in_its_own_fit() -> None:
    rng = np.random.default_rng(2)
    points = board_points(rng, true_dh(rng))
    tips = np.array(points.tip_m)
    tips[66:] += [0.0, 0.0, 0.004]
    found = held_out(predicted_by(build), with_rows(points, tip_m=tips), "setup")
    assert found.folds[2].mean_after_m > 0.0025


def test_every_third_point_is_left_out_interleaved() -> None:
    rng = np.random.default_rng(3)
    points = board_points(rng, true_dh(rng), ("normal",))
    held = held_out(predicted_by(build), points, 3)
    assert [fold.rows[:3] for fold in held.folds] == [(0, 3, 6), (1, 4, 7), (2, 5, 8)]
    assert {fold.measure for fold in held.folds} == {"error"}


def test_a_board_of_unknown_place_that_is_left_out_is_scored_by_the_scatter_in_its_cavities() -> None:
    rng = np.random.default_rng(4)
    dh = true_dh(rng, size=0.4)
    both = joined([board_points(rng, dh, is_measured=False) for _ in range(2)])
    held = held_out(predicted_by(lambda points: problem_of(UNPLACED, points)), both, "setup")
    assert held.is_scatter
    # Two tips about their mean: 1.6 * 0.14 mm / sqrt(2).
    assert np.mean(held.after_m) == pytest.approx(1.6 * NOISE_m / np.sqrt(2), rel=0.15)


def test_without_a_choice_setups_are_left_out_if_there_are_several_else_every_fifth_point() -> None:
    rng = np.random.default_rng(5)
    points = board_points(rng, true_dh(rng), ("normal",))
    assert held_out(predicted_by(build), points).by == "every 5th point"


def test_one_setup_cannot_be_left_out() -> None:
    rng = np.random.default_rng(6)
    points = board_points(rng, true_dh(rng), ("normal",))
    with pytest.raises(CalibrationError, match=r"got one \(\"normal\"\).*every 5th point"):
        held_out(predicted_by(build), points, "setup")
    with pytest.raises(CalibrationError, match="k from 2 to 33; got 1"):
        held_out(predicted_by(build), points, 1)


def test_progress_is_reported_fold_by_fold() -> None:
    rng = np.random.default_rng(7)
    heard = []
    points = board_points(rng, true_dh(rng))
    held_out(predicted_by(build), points, "setup", report=lambda done, of: heard.append((done, of)))
    assert heard == [(1, 3), (2, 3), (3, 3)]


def test_free_poses_are_left_out_part_by_part() -> None:
    """Without any of them nothing tells about where they are: that would test the board, not the result."""
    rng = np.random.default_rng(4)
    dh = true_dh(rng)
    board, model = board_points(rng, dh), ArmModel(RIGHT)
    q = rng.uniform(-1.0, 1.0, (12, 3))
    tips = model.tips(dh, q) + rng.normal(0.0, NOISE_m, (12, 3))
    free = make_points(["free"] * 12, [f"f{k}" for k in range(12)], [1] * 12, q, tips)
    held = held_out(predicted_by(build), joined([board, free]))
    assert [fold.name for fold in held.folds[:3]] == ['setup "normal"', 'setup "roll"', 'setup "pitch"']
    assert [fold.name for fold in held.folds[3:]] == [f'part {k} of 4 of setup "free"' for k in (1, 2, 3, 4)]
    assert [len(fold.rows) for fold in held.folds[3:]] == [3, 3, 3, 3]
    assert held.after_m.mean() < 1.3 * 1.6 * NOISE_m


def test_a_flexure_that_the_arms_file_has_bends_what_is_left_out_too() -> None:
    rng = np.random.default_rng(9)
    arm = dataclasses.replace(RIGHT, effects=(Effect("link_flexure", 2, {"EI_Nm2": 60.0}),))
    points = board_points(rng, true_dh(rng))
    known = known_bending(arm, points.q_rad, points.payload_kg)
    assert known is not None
    bent = known.shift
    assert norms(bent).min() > 10 * NOISE_m
    points = with_rows(points, tip_m=points.tip_m + bent)
    found = held_out(predicted_by(lambda some: problem_of(arm, some)), points, 3)
    assert np.mean(found.after_m) < 2 * NOISE_m


@pytest.mark.parametrize(
    "folds", [pytest.param(slice(0, None, 3), id="third"), pytest.param(slice(None), id="all", marks=pytest.mark.nightly)]
)
def test_what_calibrate_holds_out_is_predicted_by_the_same_fit_as_its_result(folds: slice) -> None:
    """Loads of the arm as it was drawn are others than those of the arm as it is: links are 20 mm longer."""
    rng = np.random.default_rng(10)
    q = rng.uniform([-1.5, 0.2, -1.8], [1.5, 1.8, -0.2], (40, 3))
    arm = RIGHT.with_dh(np.array(RIGHT.dh) * [1.4, 1.3, 1.0, 1.0])
    longer = np.array(arm.dh)
    longer[1:, 1] += 0.02
    soft = Effect("joint_compliance", 2, {"stiffness_Nm_rad": 150.0})
    true = dataclasses.replace(arm.with_dh(longer), effects=(soft,))
    names = [f"p{k}" for k in range(40)]
    bare = make_points(["free"] * 40, names, [1] * 40, q, np.zeros((40, 3)))
    tips = predicted_tips(true, bare) + rng.normal(0.0, NOISE_m, (40, 3))
    points = with_rows(bare, tip_m=tips)
    plan = CalibrationPlan(Choice(effects=("joint_compliance:2",), bounds=Bounds(length_m=0.03)), LSQ, None, 2)
    held = calibrate(arm, points, plan).held
    assert held is not None
    for fold in held.folds[folds]:
        rest, some = list(fold.rows), [k for k in range(40) if k not in fold.rows]
        others = points.chosen(some)
        own = calibrated_arm(arm, identified(arm, others, plan)[1], others)
        np.testing.assert_allclose(fold.after_m, norms(errors_of(own, points.chosen(rest))), atol=2e-6)


def test_where_a_gear_lies_on_an_unknown_flank_its_file_predicts_what_is_left_out() -> None:
    """Friction of an unknown share decides about the flank: the fit has its mean place there, no file has."""
    rng = np.random.default_rng(13)
    arm = RIGHT.with_dh(np.array(RIGHT.dh) * [1.4, 1.3, 1.0, 1.0])
    q = rng.uniform([-1.5, -0.8, -0.8], [1.5, 0.8, 0.4], (60, 3))
    names, sides = [f"p{k}" for k in range(60)], rng.choice([-1.0, 1.0], (60, 3))
    bare = make_points(["free"] * 60, names, [1] * 60, q, np.zeros((60, 3)), sides)
    loose = dataclasses.replace(arm, effects=(Effect("backlash", 3, {"width_rad": 0.006}),))
    at = resting_points(loose, bare)
    unclear = at.flank(3) == 0.0
    assert 10 < unclear.sum() < 50
    leaning_rad = sum(-0.003 * at.unclear_side(3, part) for part in range(8))
    q_rad = q + known_corrections(loose, bare)
    q_rad[:, 2] += leaning_rad
    tips = ForwardKinematics(arm).tips(q_rad) + rng.normal(0.0, NOISE_m, (60, 3))
    points = dataclasses.replace(bare, tip_m=frozen(tips))
    plan = CalibrationPlan(Choice(effects=("backlash:3",)), LSQ, None, 2)
    held = calibrate(arm, points, plan).held
    assert held is not None
    for fold in held.folds:
        rest, others = list(fold.rows), points.chosen([k for k in range(60) if k not in fold.rows])
        own = calibrated_arm(arm, identified(arm, others, plan)[1], others)
        np.testing.assert_allclose(fold.after_m, norms(errors_of(own, points.chosen(rest))), atol=1e-6)
    is_unclear = unclear[[row for fold in held.folds for row in fold.rows]]
    assert held.after_m[is_unclear].mean() > 3.0 * held.after_m[~is_unclear].mean()


def test_a_play_that_no_part_can_have_is_none_for_the_geometry_too() -> None:
    """Joint 2 moves as if its gear lay on the flank from which the load pulls it: a width below nought."""
    rng = np.random.default_rng(12)
    arm = RIGHT.with_dh(np.array(RIGHT.dh) * [1.4, 1.3, 1.0, 1.0])
    q = rng.uniform([-1.5, -0.8, -0.8], [1.5, 0.8, 0.4], (40, 3))
    names, sides = [f"p{k}" for k in range(40)], rng.choice([-1.0, 1.0], (40, 3))
    bare = make_points(["free"] * 40, names, [1] * 40, q, np.zeros((40, 3)), sides)
    loose = dataclasses.replace(arm, effects=(Effect("backlash", 2, {"width_rad": 0.004}),))
    added_rad = known_corrections(loose, bare)
    assert np.ptp(added_rad[:, 1]) == pytest.approx(0.004)
    tips = predicted_tips(arm, with_rows(bare, q_rad=q - added_rad))
    points = with_rows(bare, tip_m=tips + rng.normal(0.0, NOISE_m, (40, 3)))
    plan = CalibrationPlan(Choice(effects=("backlash:2",)), LSQ, None, 2)
    made = calibrate(arm, points, plan)
    _, without = identified(arm, points, dataclasses.replace(plan, choice=Choice()))
    np.testing.assert_allclose(made.found.dh, without.dh, atol=1e-9)
    assert not made.arm.effects
    assert any("backlash of joint 2: its estimate is below zero" in said for said in made.warnings)
    assert made.held is not None
    assert made.held.after_m == pytest.approx(calibrate(arm, points, dataclasses.replace(plan, choice=Choice())).held.after_m)
