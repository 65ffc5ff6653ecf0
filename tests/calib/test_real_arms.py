"""Real recordings calibrate with the same calls as simulated ones."""

from pathlib import Path

import numpy as np
import pytest

from calib.identify import ArmProblem, Identification, identify, problem_of
from calib.points import Points, read_points
from control.model.description import load_arm

PANDA = Path(__file__).parents[1] / "real" / "mukca_panda_1"


@pytest.fixture(scope="module")
def panda() -> tuple[Points, ArmProblem, Identification]:
    arm = load_arm(PANDA / "arm.toml")
    points, _ = read_points(PANDA / "points.csv", arm.joint_count)
    problem = problem_of(arm, points)
    return points, problem, identify(problem)


def consistency_m(problem: ArmProblem, dh: np.ndarray, tool_m: np.ndarray, points: Points) -> np.ndarray:
    """Distance of each predicted ball centre to the mean of its socket, (m,)."""
    tips = problem.model.tips(dh, points.q_rad, tool_m)
    sockets = np.array([f"{setup}/{point}" for setup, point in zip(points.setup, points.point, strict=True)])
    means = {socket: tips[sockets == socket].mean(axis=0) for socket in set(sockets)}
    return np.linalg.norm(tips - np.array([means[socket] for socket in sockets]), axis=1)


def test_a_panda_in_sockets_of_boards_at_unknown_places_becomes_consistent(panda) -> None:
    """Reference in the data's notes: mean 7.97 mm nominal, 0.46 mm fitted."""
    points, problem, found = panda
    start = problem.solution(np.zeros(len(problem.parameters)))
    before = consistency_m(problem, problem.model.nominal_dh, start.tool_m, points)
    after = consistency_m(problem, found.dh, found.solution.tool_m, points)
    assert before.mean() == pytest.approx(0.00797, abs=0.0001)
    assert after.mean() <= 0.00047
    assert found.is_converged


def test_setups_of_the_panda_that_were_left_out_are_consistent_too() -> None:
    """Reference in the data's notes: mean over the left-out setups 8.44 mm nominal, 0.80 mm fitted."""
    arm = load_arm(PANDA / "arm.toml")
    points, _ = read_points(PANDA / "points.csv", arm.joint_count)
    left_out = []
    for setup in dict.fromkeys(points.setup):
        is_here = np.array(points.setup) == setup
        problem = problem_of(arm, points.chosen(np.flatnonzero(~is_here)))
        found = identify(problem)
        kept = points.chosen(np.flatnonzero(is_here))
        left_out.append(consistency_m(problem, found.dh, found.solution.tool_m, kept))
    assert np.concatenate(left_out).mean() <= 0.00080
