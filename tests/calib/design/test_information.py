"""What poses tell: quick updates against plain linear algebra, ranks of the reference arm, unknown boards."""

import dataclasses

import numpy as np
import pytest

from benchmarks.calibration.design_trial import ARM, table_points
from calib.arm_problem.arm_model import ArmModel, Bounds
from calib.arm_problem.assembly import Choice, problem_of
from calib.design.information import CRITERIA, NAMES, criterion_of, uncertainty_of
from calib.errors import CalibrationError
from calib.identify.identification import identify
from calib.identify.objective import LeastSquares
from tests.calib.design.experiments import UNKNOWN, WORKSPACE, drawn, experiment


@pytest.mark.parametrize("arm", [ARM, UNKNOWN], ids=["known board", "unknown board"])
@pytest.mark.parametrize("name", CRITERIA)
def test_score_of_adding_a_pose_is_what_it_changes_when_all_is_computed_anew(arm, name):
    """Tolerance: inverses of matrices with condition numbers of some 1e8, so 1e-6 of the change."""
    one, _ = experiment(arm, free_count=60)
    taken, added = drawn(12, len(one.rows), 1), drawn(6, len(one.rows), 2)
    scores = criterion_of(name)(one, one.information(taken), one.rows[added])
    for score, row in zip(scores, added, strict=True):
        before, after = uncertainty_of(one, taken), uncertainty_of(one, [*taken, row])
        if name in ("D", "O1"):
            assert score == pytest.approx(after.log_det - before.log_det, rel=1e-6)
        elif name == "tip":
            assert score == pytest.approx(before.tip_m**2 - after.tip_m**2, rel=1e-6)
        else:  # the scores count the weak prior, the indices that are shown do not
            assert score == pytest.approx(after.indices.as_dict()[name], rel=2e-2)


def test_reference_arm_has_ten_combinations_and_a_level_board_shows_nine():
    whole, _ = experiment()
    level, _ = experiment(setups=("normal",), free_count=0)
    assert whole.rank == whole.visible.shape[1] == 10
    assert (level.rank, level.visible.shape[1]) == (10, 9)


def test_uncertainty_that_no_pose_can_reduce_stays_in_the_tip():
    """A level board leaves a combination that moves the tip elsewhere by far more than the noise."""
    level, poses = experiment(setups=("normal",), free_count=0)
    tilted, _ = experiment(setups=("normal", "roll"), free_count=0)
    assert uncertainty_of(level, np.arange(len(poses))).tip_m > 0.010
    assert uncertainty_of(tilted, np.arange(66)).tip_m < 0.002


def test_board_that_nobody_knows_tells_less_about_the_arm_than_one_that_is_known():
    known, poses = experiment(free_count=0)
    unknown, _ = experiment(UNKNOWN, free_count=0)
    rows = np.arange(len(poses))
    assert uncertainty_of(unknown, rows).tip_m > uncertainty_of(known, rows).tip_m
    assert known.is_tied
    assert not unknown.is_tied


def test_place_of_a_board_is_nothing_to_gain_by_itself():
    """Three cavities give nine numbers, six of which go into an unknown board: the arm gains what is left."""
    unknown, _ = experiment(UNKNOWN, setups=("normal",), free_count=0)
    known, _ = experiment(setups=("normal",), free_count=0)
    assert 0.0 < uncertainty_of(unknown, [0, 8, 16]).log_det < 0.7 * uncertainty_of(known, [0, 8, 16]).log_det


def test_what_no_board_at_an_unknown_place_can_show_is_no_uncertainty_of_the_arms_shape():
    """The height d1 and the zero theta1 of the base move the whole workspace: two combinations fewer count."""
    unknown, poses = experiment(UNKNOWN, free_count=0)
    assert unknown.rank == unknown.visible.shape[1] == 8
    assert uncertainty_of(unknown, np.arange(len(poses))).tip_m < 0.005


def test_without_any_pose_parameters_are_known_by_their_bounds():
    one, _ = experiment()
    nothing = uncertainty_of(one, [])
    assert nothing.log_det == pytest.approx(0.0, abs=1e-9)
    assert nothing.rank == 0
    assert set(nothing.indices.as_dict()) == set(NAMES)
    assert nothing.least_known_sd <= np.radians(2.0) * (1 + 1e-9)


def test_fixed_parameters_and_own_bounds_are_those_of_the_identification():
    fixed, _ = experiment(choice=Choice(fixed=("theta3", "d1"), bounds=Bounds(own={"L2": 0.001})))
    names = [parameter.name for parameter in fixed.parameters]
    assert len(names) == 14
    assert not {"theta3", "d1"} & set(names)
    assert fixed.parameters[names.index("L2")].bound == 0.001
    assert fixed.rank == 9  # d1 is missed; what theta3 does, L3 and L4 do as well


def test_unknown_tool_is_identified_and_counts():
    loose = dataclasses.replace(ARM, tool=dataclasses.replace(ARM.tool, known=False))
    one, _ = experiment(loose)
    assert [p.name for p in one.parameters][-3:] == ["tool_x", "tool_y", "tool_z"]
    assert one.rank >= 10


def test_predicted_uncertainty_is_what_identifications_scatter_by():
    """Six least-squares calibrations: the root mean square tip error over the workspace within 40 % of the prediction.

    One combination out of ten makes most of it here, so that six draws of it scatter by a third.
    """
    one, poses = experiment(free_count=0)
    squares, model = [], ArmModel(ARM)
    for seed in range(6):
        dh, points = table_points(np.random.default_rng(seed))
        found = identify(problem_of(ARM, points), objective=LeastSquares(), starts_count=1)
        miss = model.tips(found.dh, WORKSPACE) - model.tips(dh, WORKSPACE)
        squares.append(np.mean(np.sum(miss**2, axis=1)))
    predicted = uncertainty_of(one, np.arange(len(poses))).tip_m
    assert np.sqrt(np.mean(squares)) == pytest.approx(predicted, rel=0.4)


def test_unknown_criterion_is_one_error_that_lists_them():
    with pytest.raises(CalibrationError, match='expected one of D, O1, O2, O3, O4, O5, tip, got "best"'):
        criterion_of("best")
