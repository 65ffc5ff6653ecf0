"""Standard deviations and intervals mean what they say: closed forms, and simulated sessions.

The long study is `make coverage-study`.
"""

import numpy as np
import pytest

from benchmarks.calibration.coverage import Session, studied
from calib.identify.determinability import Sensitivity
from calib.identify.identification import uncertainty
from calib.identify.objective import Huber, LeastSquares, SumOfCoordinates, SumOfDistances, leverages, noise_scale
from tests.calib.simulated import RIGHT, board_points, problem_of, true_dh

NONE = np.zeros((4000, 3, 3))


@pytest.mark.parametrize(
    ("objective", "times"),
    [
        (LeastSquares(), 1.0),
        (SumOfDistances(), 3 * np.pi / 8),  # E[1/|e|] of a normal vector is sqrt(2/pi) / sigma
        (SumOfCoordinates(), np.pi / 2),  # of a median
        (Huber(1.628), 1 / 0.95),
    ],
)
def test_the_variance_of_each_objective_is_the_one_of_theory(objective, times) -> None:
    noise = noise_scale(objective, np.random.default_rng(0).normal(size=(4000, 3)), NONE)
    assert noise.variance_m2 == pytest.approx(times, rel=0.12)  # the density at nought is known to 4 %


def test_least_squares_divides_by_the_degrees_of_freedom() -> None:
    rng = np.random.default_rng(1)
    q, _ = np.linalg.qr(rng.normal(size=(99, 9)))
    noise = rng.normal(size=99)
    left = (noise - q @ (q.T @ noise)).reshape(33, 3)
    found = noise_scale(LeastSquares(), left, leverages(q.reshape(33, 3, 9), np.eye(9)))
    # Point by point in place of all at once: equal on the mean.
    assert found.variance_m2 == pytest.approx(np.sum(left**2) / 90, rel=0.05)
    assert 40 < found.freedom < 200


@pytest.mark.parametrize("objective", [SumOfDistances(), SumOfCoordinates()], ids=["E2", "E1"])
def test_few_points_get_wider_intervals_than_the_normal_ones(objective) -> None:
    noise = noise_scale(objective, np.random.default_rng(2).normal(size=(20, 3)), np.tile(0.1 * np.eye(3), (20, 1, 1)))
    assert noise.quantile() > 1.98
    assert noise.quantile(0.5) < 0.75


def test_without_residuals_or_without_freedom_there_is_no_noise_to_tell() -> None:
    assert noise_scale(SumOfDistances(), np.zeros((5, 3)), NONE[:5]).variance_m2 == 0.0
    exact = noise_scale(LeastSquares(), np.ones((2, 3)), np.tile(0.95 * np.eye(3), (2, 1, 1)))
    assert np.isnan(exact.variance_m2)
    assert np.isnan(exact.quantile())


@pytest.mark.parametrize("what", [Session("known", 99, "e2"), Session("known", 33, "lsq", 1.0)], ids=["E2", "bounds bind"])
def test_intervals_cover_the_truth_as_often_as_they_say(what) -> None:
    study = studied(what, 30, seed=3)
    scores = sum(tally.count for tally in study.values())
    covered = sum(tally.by_interval for tally in study.values()) / scores
    # 9 or 10 correlated scores of 30 sessions: 95 % +- 2.5 %, twice that allowed.
    assert scores >= 270
    assert 0.90 < covered < 0.995


def test_the_interval_of_a_parameter_on_its_bound_ends_there_and_reaches_inside() -> None:
    rng = np.random.default_rng(4)
    dh = true_dh(rng, size=0.2)
    dh[1, 2] = RIGHT.dh[1, 2] + 0.00499  # L2 is as long as its bound lets it be, or nearly
    problem = problem_of(RIGHT, board_points(rng, dh))
    x = np.zeros(16)
    for _ in range(20):  # Gauss and Newton in the box, along what is determined
        residuals, jacobian = problem.residuals_and_jacobian(x)
        step, *_ = np.linalg.lstsq(jacobian.reshape(-1, 16), -residuals.ravel(), rcond=1e-5)
        x = np.clip(x + step, -1.0, 1.0)
    x[6] = 1.0
    residuals = problem.residuals(x)
    estimate = uncertainty(problem.parameters, LeastSquares(), x, residuals, Sensitivity.at(problem, x)).estimates[6]
    assert estimate.parameter.name == "L2"
    assert np.isnan(estimate.sd)
    assert estimate.interval[1] == pytest.approx(0.005)
    assert 0.0 < estimate.interval[0] < 0.00499
