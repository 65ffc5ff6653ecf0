"""What the points determine does not depend on what is unknown beside it, nor on residuals; the words say it plainly."""

import dataclasses

import numpy as np
import pytest

from calib.arm_problem.arm_model import ArmModel, Parameter
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.observations import Observations
from calib.arm_problem.problem import ArmProblem
from calib.identify.determinability import determinability, null_space, open_in_words
from calib.identify.identification import identify
from tests.calib.simulated import RIGHT, NOISE_m, board_points, true_dh

UNPLACED = dataclasses.replace(RIGHT, table=dataclasses.replace(RIGHT.table, known_pose=False))


def known(problem: ArmProblem, x: np.ndarray | None = None):
    at = np.zeros(len(problem.parameters)) if x is None else x
    return determinability(problem.sensitivity(at), problem.parameters)


def session(seed: int, setups=("normal", "roll", "pitch"), is_measured=True, noise_m=NOISE_m):
    rng = np.random.default_rng(seed)
    return board_points(rng, true_dh(rng), setups, noise_m, is_measured)


def test_poses_over_the_workspace_condition_the_parameters_ten_times_better_than_three_tilts() -> None:
    """Field notes: level board 952, three tilts 243, 300 poses over the workspace 17, at other draws of the poses."""
    q = np.random.default_rng(1).uniform([-2.0, -1.9, -1.2], [2.0, 0.8, 1.5], (300, 3))
    model = ArmModel(RIGHT)
    workspace = known(ArmProblem(model, Observations.of_tips(q, model.tips(RIGHT.dh, q))))
    assert workspace.rank == 10
    assert 8 < workspace.condition_number < 30
    assert 150 < known(problem_of(RIGHT, session(1))).condition_number < 400


def test_a_table_frame_of_unknown_place_leaves_fourteen_of_twenty_two() -> None:
    assert known(problem_of(RIGHT, session(2), Choice(freed={"base"}))).rank == 14


def test_a_residual_does_not_make_a_turn_of_arm_and_boards_together_visible() -> None:
    exact = known(problem_of(UNPLACED, session(3, is_measured=False, noise_m=0.0)))
    rough = known(problem_of(UNPLACED, session(3, is_measured=False, noise_m=0.003)))
    assert rough.rank == exact.rank
    assert rough.condition_number == pytest.approx(exact.condition_number, rel=0.2)


def test_the_condition_number_does_not_depend_on_how_unknown_boards_are_scaled() -> None:
    problem = problem_of(UNPLACED, session(4, is_measured=False))
    sensitivity = problem.sensitivity(np.zeros(len(problem.parameters)))
    here = determinability(sensitivity, problem.parameters)
    stretched = sensitivity.copy()
    stretched[:, :, [k for k, p in enumerate(problem.parameters) if not p.has_bound]] *= 30.0
    there = determinability(stretched, problem.parameters)
    assert there.rank == here.rank
    assert there.condition_number == pytest.approx(here.condition_number, rel=1e-6)


def test_what_unknown_boards_make_up_for_stays_at_nominal_and_is_told_in_one_sentence() -> None:
    problem = problem_of(UNPLACED, session(5, is_measured=False))
    identification = identify(problem, starts_count=1)
    deviation = {e.parameter.name: e.deviation for e in identification.estimates}
    assert max(abs(deviation[name]) for name in ("d1", "theta1")) < 1e-6
    said = [sentence for sentence in identification.in_words() if "the poses of the boards" in sentence]
    assert any(sentence.startswith("d1") and "cannot be told apart from" in sentence for sentence in said)
    assert len(identification.in_words()) <= 7


def test_the_combinations_that_stay_at_nominal_are_those_that_no_tip_sees() -> None:
    problem = problem_of(UNPLACED, session(6, is_measured=False, noise_m=0.0))
    sensitivity = problem.sensitivity(np.zeros(len(problem.parameters)))
    held = null_space(sensitivity, problem.parameters, 1e-4)
    np.testing.assert_allclose(held.T @ held, np.eye(held.shape[1]), atol=1e-12)
    basis = determinability(sensitivity, problem.parameters).basis
    assert np.abs(held.T @ basis).max() < 1e-12
    assert held.shape[1] + basis.shape[1] == len(problem.parameters)


def test_the_covariance_is_that_of_least_squares_over_what_is_determined() -> None:
    problem = problem_of(RIGHT, session(7))
    sensitivity = problem.sensitivity(np.zeros(16))
    here = determinability(sensitivity, problem.parameters)
    seen = sensitivity.reshape(-1, 16) @ here.basis
    wanted = here.basis @ np.linalg.inv(seen.T @ seen) @ here.basis.T
    np.testing.assert_allclose(here.covariance(4.0), 4.0 * wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())


def test_a_board_whose_points_lie_on_a_line_has_a_turn_that_nothing_depends_on() -> None:
    """Two columns: a parameter that is seen, and the turn of a board that is not."""
    parameters = (Parameter("L2", "m", 0.4, 0.005), Parameter("board_front_rx", "rad", 0.0, np.inf))
    columns = np.zeros((20, 3, 2))
    columns[:, 0, 0] = 1.0
    found = determinability(columns, parameters)
    assert found.rank == 1
    said = open_in_words(found.undetermined)
    assert said == ("board_front_rx has no effect on these points, which lie on one line; no result depends on it",)


def test_many_parameters_without_effect_are_told_in_one_short_sentence() -> None:
    parameters = tuple(Parameter(f"L{k}", "m", 0.0, 0.005) for k in range(15))
    columns = np.zeros((10, 3, 15))
    columns[:, 0, 0] = 1.0
    (sentence,) = open_in_words(determinability(columns, parameters).undetermined)
    assert sentence.endswith("and 6 more have no effect on these points; they stay at nominal")
