"""Tools that are joined rigidly: exact derivatives, and what the constant orientation between them adds."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.arms import SIX
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Frame
from calib.arrays import Array, frozen
from calib.closed_chain.calibrate import calibrate_pair
from calib.closed_chain.pair_problem import Contacts, PairPlan, PairProblem, read_contacts, turning
from calib.errors import PointsFileError
from calib.identify.determinability import determinability
from calib.identify.objective import LeastSquares
from control.kinematics.rotation import logarithms
from tests.calib.simulated import true_dh

ARMS = (replace(SIX, name="left"), replace(SIX, name="right"))
MODEL = ArmModel(SIX)
BASE = Frame("right_base", frozen(Rotation.from_rotvec([0.01, -0.02, 3.0]).as_matrix()), frozen([0.9, 0.05, 0.0]))
JOIN = Rotation.from_rotvec([np.pi - 0.4, 0.2, 0.1]).as_matrix()
NOISE_m = 5e-5


@cache
def joined_contacts(count: int) -> Contacts:
    """The second arm's tip where the first one's is, and its last link turned by JOIN against the first one's."""
    rng = np.random.default_rng(1)
    first, second = (true_dh(rng, SIX, 0.3) for _ in ARMS)
    q1 = rng.uniform(-0.5, 0.5, (40 * count, 6)) + np.array([0.0, 0.9, -1.2, 0.0, 1.2, 0.0])
    ours = MODEL.slopes(first, q1)
    goal = (ours.tips + rng.normal(0.0, NOISE_m, (len(q1), 3)) - BASE.origin_m) @ BASE.rotation
    turned = BASE.rotation.T @ ours.by_tool @ JOIN
    q2, is_there = posed(second, goal, turned, rng.uniform(-0.3, 0.3, q1.shape) + q1[:1])
    rows = np.flatnonzero(is_there)[:count]
    assert len(rows) == count
    names = tuple(f"a:{k}:1" for k in range(count))
    zeros = frozen(np.zeros(count))
    return Contacts(names, ("a",) * count, frozen(q1[rows]), frozen(q2[rows]), zeros, ("weld",) * count)


def posed(dh: Array, goal_m: Array, turned: Array, q_rad: Array) -> tuple[Array, Array]:
    """Newton's steps to tips (m, 3) with the last link at rotations (m, 3, 3); which have arrived."""
    for _ in range(40):
        found = MODEL.slopes(dh, q_rad)
        places = list(MODEL.theta_places)
        slopes = np.concatenate((found.by_dh[:, :, places], turning(found)[:, :, places]), axis=1)
        apart = logarithms(turned @ np.swapaxes(found.by_tool, 1, 2))
        missing = np.concatenate((goal_m - found.tips, apart), axis=1)
        step = np.einsum("mij,mj->mi", np.linalg.pinv(slopes, rcond=1e-3), missing)
        q_rad = q_rad + step * np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1), 1e-9))[:, None]
    return q_rad, (np.abs(missing).max(axis=1) < 1e-9) & (np.abs(q_rad).max(axis=1) < 2.8)


def test_derivatives_are_exact() -> None:
    problem = PairProblem(ARMS, joined_contacts(6), BASE, PairPlan(free_tools=("right",)))
    x = 0.2 * np.random.default_rng(2).uniform(-1, 1, len(problem.parameters))
    x[-9:] *= 0.02
    jacobian, h = problem.residuals_and_jacobian(x)[1], 1e-6
    slopes = [(problem.residuals(x + h * e) - problem.residuals(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    assert len(problem) == 12
    assert np.abs(jacobian - np.stack(slopes, axis=2)).max() < 1e-7


def test_the_constant_orientation_determines_more_and_contacts_left_out_close() -> None:
    contacts = joined_contacts(20)
    ranks = []
    for joined in ((), contacts.joined):
        problem = PairProblem(ARMS, replace(contacts, joined=joined), BASE)
        known = determinability(problem.sensitivity(np.zeros(len(problem.parameters))), problem.parameters)
        ranks.append(known.rank - 3 * bool(joined))  # the join's own turn
    assert ranks[1] > ranks[0]
    pair = calibrate_pair(ARMS, contacts, PairPlan(objective=LeastSquares()))
    assert pair.held_after_m.mean() < 4 * NOISE_m
    assert pair.held_before_m.mean() > 1e-3
    assert np.abs(pair.angles_rad).max() < 2e-3


def test_joined_tools_are_in_one_place(tmp_path) -> None:  # type: ignore[no-untyped-def]
    head = "setup,point,repeat," + ",".join(f"q{k}_rad" for k in range(1, 13)) + ",distance_m,joined\n"
    (tmp_path / "c.csv").write_text(head + "a,1,1," + "0.1," * 12 + "0.05,weld\n")
    with pytest.raises(PointsFileError, match=r"line 2, column joined: joined tools 'weld' are in one place"):
        read_contacts(tmp_path / "c.csv", ARMS)
