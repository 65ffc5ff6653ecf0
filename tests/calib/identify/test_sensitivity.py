"""What the points show, in blocks: the same as at once, for every kind of problem."""

import numpy as np
import pytest

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.expansion import Problem
from calib.arm_problem.posed import whole_problem
from calib.identify import outliers
from calib.identify.determinability import Sensitivity, determinability
from calib.identify.identification import uncertainty
from calib.identify.objective import SumOfDistances
from calib.points.points import Points, make_points
from tests.calib.identify.test_orientations import BASE, session
from tests.calib.simulated import RIGHT, board_points, true_dh


def of_boards(freed: frozenset[str]) -> Problem:
    rng = np.random.default_rng(5)
    return problem_of(RIGHT, board_points(rng, true_dh(rng)), Choice(freed=freed))


def of_poses() -> Problem:
    arm, _, points = session(3)
    return whole_problem(problem_of(arm, points, BASE))


PROBLEMS = {
    "boards": lambda: of_boards(frozenset()),
    "free base": lambda: of_boards(frozenset({"base"})),
    "orientations": of_poses,
}


@pytest.mark.parametrize("kind", PROBLEMS)
def test_blocks_show_what_the_whole_shows(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = PROBLEMS[kind]()
    x = np.full(len(problem.parameters), 0.01)
    x[1] = 1.0  # at its bound, so that intervals use the gradient
    whole, residuals = problem.sensitivity(x), problem.residuals(x)
    at_once = uncertainty(problem.parameters, SumOfDistances(), x, residuals, Sensitivity.at(problem, x))
    monkeypatch.setattr("calib.identify.determinability.BLOCK", 17)
    blocks = Sensitivity.at(problem, x)
    assert np.array_equal(np.concatenate([part for _, part in blocks.blocks()]), whole)
    assert blocks.compact.shape[0] == whole.shape[2]
    assert determinability(blocks.compact, problem.parameters).rank == at_once.known.rank
    found = uncertainty(problem.parameters, SumOfDistances(), x, residuals, blocks)
    for one, other in zip(found.estimates, at_once.estimates, strict=True):
        assert one.sd == pytest.approx(other.sd, rel=1e-6, nan_ok=True)
        assert one.interval == pytest.approx(other.interval, rel=1e-6, abs=1e-9)


def test_very_many_points_are_compared_in_parts_and_keep_their_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    dh = true_dh(rng)
    points = board_points(rng, dh)
    tips = np.array(points.tip_m)
    tips[41] += (0.0, 0.01, 0.0)
    problem = problem_of(RIGHT, make_points(points.setup, points.point, points.repeat, points.q_rad, tips), Choice())
    x = (dh - RIGHT.dh).ravel() / problem.scale
    monkeypatch.setattr(outliers, "PART", 40)
    suspects = outliers.find_suspects(problem, x)
    assert [one.row for one in suspects.outliers] == [41]
    assert suspects.points_count == len(points)


def test_what_no_point_has_takes_no_memory() -> None:
    points: Points = make_points(["free"], ["a"], [1], np.zeros((1, 3)), np.zeros((1, 3)))
    for values in (points.covariance, points.orientation, points.current_A, points.t_s, points.payload_kg):
        assert np.isnan(values).all()
        assert not any(values.strides)
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0
