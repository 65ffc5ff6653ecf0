"""The solver: real optima for every objective, whatever the points; what does not matter stays at nominal."""

import numpy as np
import pytest
from scipy.optimize import minimize

from benchmarks.calibration.chains import MODIFIED, MODIFIED_DH, REFERENCE, REFERENCE_DH, ChainModel, board_session, deviations
from benchmarks.calibration.solver_study import best_known, case
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Observations
from calib.arm_problem.problem import ArmProblem
from calib.arrays import norms
from calib.errors import CalibrationError
from calib.identify.descent import CHUNK
from calib.identify.objective import LeastSquares, SumOfDistances, objective_named, value_of
from calib.identify.solver import COST_OF_NEARNESS, best_of_starts, minimise
from control.model.description import load_arm
from tests.calib.arms import problem_of_tips

NAMES = ("e2", "e1", "lsq", "huber")
MILLIONTH = 1e-6


def night(*case: str | int) -> pytest.ParameterSet:
    return pytest.param(*case, marks=pytest.mark.nightly)


def first_at_each_change(*names: str) -> pytest.MarkDecorator:
    """The first objective is tried at each change, the others at night; among the tests, each comes first somewhere."""
    return pytest.mark.parametrize("name", [names[0], *map(night, names[1:])])


def workspace_problem(m: int, seed: int, noise_m: float = 0.00014, size: float = 1.0) -> ArmProblem:
    """The reference arm with hidden deviations, seen all over the workspace."""
    rng = np.random.default_rng(seed)
    true = REFERENCE_DH + size * deviations(rng, 4)
    q = rng.uniform(-1.2, 1.2, (m, 3))
    return problem_of_tips(REFERENCE, REFERENCE_DH, q, REFERENCE.tips(true, q) + rng.normal(0.0, noise_m, (m, 3)))


@pytest.mark.parametrize(
    ("name", "seed"), [("e2", 15), ("lsq", 8), night("e2", 0), night("lsq", 15), night("huber", 3), night("e1", 15)]
)
def test_the_optimum_is_within_a_millionth_of_the_best_that_any_solver_finds(name, seed) -> None:
    """On the board and in the workspace, most of them with bounds that bind. `make solver-study` does that for hundreds."""
    problem = case(seed)
    minimum = minimise(problem, objective_named(name))
    known = best_known(problem, minimum.objective, seed, own_starts=2, slsqp_starts=1)
    assert minimum.value <= min(known.values()) * (1.0 + MILLIONTH)
    assert np.abs(minimum.x).max() <= 1.0
    assert minimum.is_converged


@first_at_each_change("e1", "e2", "lsq", "huber")
def test_without_noise_nothing_is_left(name) -> None:
    problem = workspace_problem(40, 1, noise_m=0.0)
    minimum = minimise(problem, objective_named(name))
    assert norms(problem.residuals(minimum.x)).max() < 1e-8  # some nanometres: what the search takes for nothing
    assert minimum.is_converged


@first_at_each_change("e1", "e2", "huber")
def test_every_fifth_point_may_be_wrong_by_centimetres(name) -> None:
    rng = np.random.default_rng(5)
    true = REFERENCE_DH + deviations(rng, 4)
    q = rng.uniform(-1.2, 1.2, (100, 3))
    tips = REFERENCE.tips(true, q) + rng.normal(0.0, 0.0001, (100, 3))
    tips[::5] += rng.uniform(-0.05, 0.05, (20, 3))
    minimum = minimise(problem_of_tips(REFERENCE, REFERENCE_DH, q, tips), objective_named(name))
    fresh = rng.uniform(-1.2, 1.2, (200, 3))
    dh = problem_of_tips(REFERENCE, REFERENCE_DH, q, tips).solution(minimum.x).dh
    assert norms(REFERENCE.tips(dh, fresh) - REFERENCE.tips(true, fresh)).mean() < 0.00015


@pytest.mark.parametrize(
    ("name", "m"), [("lsq", 4), ("huber", 7), night("e2", 4), night("e2", 7), night("lsq", 7), night("e1", 4)]
)
def test_a_handful_of_points_is_fitted_exactly_and_said_to_be(name, m) -> None:
    """12 or 21 coordinates, 10 determined combinations: 4 points leave nothing, 7 leave a little."""
    problem = workspace_problem(m, 2)
    minimum = minimise(problem, objective_named(name))
    other = best_of_starts(problem, minimum.objective, 4, 7)
    nothing = value_of(minimum.objective, np.full((m, 3), 1e-9))
    assert minimum.value <= max(other.value * (1.0 + MILLIONTH), nothing)


@first_at_each_change("lsq", "e2", "e1", "huber")
def test_an_arm_with_one_joint(name) -> None:
    model, dh = ChainModel((True,)), np.array([[0.1, 0.2, 0.3, 0.4]])
    rng = np.random.default_rng(4)
    true = dh + deviations(rng, 1)
    q = rng.uniform(-2.0, 2.0, (25, 1))
    problem = problem_of_tips(model, dh, q, model.tips(true, q) + rng.normal(0.0, 0.0001, (25, 3)))
    minimum = minimise(problem, objective_named(name))
    best = best_known(problem, minimum.objective, 3, own_starts=4, slsqp_starts=2)
    assert minimum.value <= min(best.values()) * (1.0 + MILLIONTH)
    np.testing.assert_allclose(problem.solution(minimum.x).dh[0, :3], true[0, :3], atol=2e-4)
    assert minimum.x[3] == 0.0  # alpha of the last link moves no tip


@first_at_each_change("huber", "e2", "e1", "lsq")
def test_an_arm_in_modified_convention_with_a_tool(name) -> None:
    rng = np.random.default_rng(6)
    true = MODIFIED_DH + deviations(rng, 5)
    q = rng.uniform(-1.2, 1.2, (60, 4))
    problem = problem_of_tips(MODIFIED, MODIFIED_DH, q, MODIFIED.tips(true, q) + rng.normal(0.0, 0.0002, (60, 3)))
    minimum = minimise(problem, objective_named(name))
    other = best_of_starts(problem, minimum.objective, 3, 11)
    assert minimum.value <= other.value * (1.0 + MILLIONTH)


def test_no_combination_that_the_noise_hides_ends_at_a_bound() -> None:
    """Seen in a small part of the workspace: a change of some combinations by their bounds is less than the noise."""
    rng = np.random.default_rng(2)
    true = REFERENCE_DH + 0.3 * deviations(rng, 4)
    q = rng.uniform(-0.15, 0.15, (60, 3))
    tips = REFERENCE.tips(true, q) + rng.normal(0.0, 3e-4, (60, 3))
    problem = problem_of_tips(REFERENCE, REFERENCE_DH, q, tips)
    lowest, nearest = (minimise(problem, SumOfDistances(), equal=how) for how in ("exactly", "by noise"))
    assert np.abs(lowest.x).max() == 1.0
    assert np.abs(nearest.x).max() < 0.8
    assert nearest.value < 1.015 * lowest.value  # no more than as many unknowns gain by fitting noise


@first_at_each_change("lsq", "e2")
def test_thousands_of_poses_are_summed_up_piece_by_piece(name) -> None:
    problem = workspace_problem(CHUNK + 300, 7)
    minimum = minimise(problem, objective_named(name))
    assert minimum.value == pytest.approx(value_of(minimum.objective, problem.residuals(minimum.x)), rel=1e-12)
    other = best_of_starts(problem, minimum.objective, 2, 5)
    assert minimum.value <= other.value * (1.0 + MILLIONTH)


@first_at_each_change("e2", "e1", "lsq", "huber")
def test_staying_near_nominal_costs_less_than_a_millionth(name) -> None:
    _, q, tips, _ = board_session(np.random.default_rng(8))
    problem = problem_of_tips(REFERENCE, REFERENCE_DH, q, tips)
    minimum = minimise(problem, objective_named(name))
    lowest = best_of_starts(problem, minimum.objective, 4, 0)
    assert minimum.value <= lowest.value * (1.0 + COST_OF_NEARNESS)
    assert np.linalg.norm(minimum.x) <= np.linalg.norm(lowest.x) + 1e-6
    assert minimum.x[15] == 0.0  # alpha4 moves no tip


@first_at_each_change("huber", "e2", "lsq")
def test_the_same_seed_gives_the_same_and_another_seed_as_good(name) -> None:
    problem = case(15)
    one, again, other = (minimise(problem, objective_named(name), seed=seed) for seed in (0, 0, 5))
    assert np.array_equal(one.x, again.x)
    assert other.value == pytest.approx(one.value, rel=2e-6)


def test_hubers_threshold_follows_the_noise() -> None:
    found = minimise(workspace_problem(400, 9, noise_m=0.0002), objective_named("huber"))
    assert found.objective.threshold_m == pytest.approx(1.628 * 0.0002, rel=0.1)  # median of 400 lengths


def test_hubers_loss_is_least_squares_far_out_and_a_sum_of_distances_close_in() -> None:
    problem = workspace_problem(60, 10)
    wide, narrow = (minimise(problem, objective_named("huber", t)) for t in (1.0, 1e-7))
    assert wide.value == pytest.approx(minimise(problem, LeastSquares()).value, rel=1e-6)
    # t s - t^2 / 2 of nearly every point: the sum of distances times t, to t over a typical distance.
    assert narrow.value / 1e-7 == pytest.approx(minimise(problem, SumOfDistances()).value, rel=1e-3)


def constrained_by_slsqp(problem: ArmProblem, start: np.ndarray, mean_m: float) -> float:
    """Least squares with a mean distance of at most mean_m."""

    def value(x):
        residuals, jacobian = problem.residuals_and_jacobian(x)
        return 1e4 * value_of(LeastSquares(), residuals), 1e4 * np.einsum("ij,ijk->k", residuals, jacobian)

    def room(x):
        return 1e2 * (mean_m * len(problem) - norms(problem.residuals(x)).sum())

    def room_slope(x):
        residuals, jacobian = problem.residuals_and_jacobian(x)
        return -1e2 * np.einsum("ij,ijk->k", residuals / norms(residuals)[:, None], jacobian)

    end = minimize(
        value,
        start,
        jac=True,
        method="SLSQP",
        bounds=[(-1.0, 1.0)] * len(start),
        constraints=[{"type": "ineq", "fun": room, "jac": room_slope}],
        options={"ftol": 1e-15, "maxiter": 500},
    )
    return value_of(LeastSquares(), problem.residuals(end.x))


def test_an_average_accuracy_between_the_two_optima_is_met_at_the_least_cost() -> None:
    problem = workspace_problem(60, 5, size=2.0)
    closest, free = minimise(problem, SumOfDistances()), minimise(problem, LeastSquares())
    least_m, free_m = (float(norms(problem.residuals(end.x)).mean()) for end in (closest, free))
    wanted_m = 0.5 * (least_m + free_m)
    minimum = minimise(problem, LeastSquares(), accuracy_limit_m=wanted_m)
    assert minimum.constraint_met
    assert norms(problem.residuals(minimum.x)).mean() == pytest.approx(wanted_m, rel=2e-6)
    assert free.value < minimum.value < value_of(LeastSquares(), problem.residuals(closest.x))
    # 2e-6 of the wanted accuracy may be left unused, which costs about as much of the objective.
    assert minimum.value == pytest.approx(constrained_by_slsqp(problem, closest.x, wanted_m), rel=5e-6)


@first_at_each_change("e2", "lsq", "e1")
def test_an_average_accuracy_that_cannot_be_met_is_said_with_the_least_possible(name) -> None:
    problem = workspace_problem(40, 5, size=2.0)
    least_m = float(norms(problem.residuals(minimise(problem, SumOfDistances()).x)).mean())
    minimum = minimise(problem, objective_named(name), accuracy_limit_m=0.9 * least_m)
    assert not minimum.constraint_met
    assert minimum.accuracy.least_m == pytest.approx(least_m, rel=1e-9)
    assert norms(problem.residuals(minimum.x)).mean() == pytest.approx(least_m, rel=1e-9)
    assert "cannot be met" in minimum.accuracy.in_words()
    easy = minimise(problem, objective_named(name), accuracy_limit_m=2.0 * least_m)
    assert easy.constraint_met
    assert easy.accuracy.multiplier == 0.0


@pytest.mark.parametrize("limit_m", [0.0, -1.0, float("nan"), float("inf")])
def test_an_average_accuracy_that_makes_no_sense_is_refused(limit_m) -> None:
    with pytest.raises(CalibrationError, match="average accuracy: expected a positive length"):
        minimise(workspace_problem(20, 1), SumOfDistances(), accuracy_limit_m=limit_m)


def test_nothing_to_explain_leaves_everything_at_nominal() -> None:
    model = ArmModel(load_arm("right"))
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (30, 3))
    problem = ArmProblem(model, Observations.of_tips(q, model.tips(model.nominal_dh, q)))
    for name in NAMES:
        assert np.abs(minimise(problem, objective_named(name)).x).max() < 1e-6
