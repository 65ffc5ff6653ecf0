"""Identification: recovers what was put in, is a real optimum, says what the data leave open."""

import numpy as np
import pytest

from benchmarks.calibration.chains import (
    MODIFIED,
    MODIFIED_DH,
    REFERENCE,
    REFERENCE_DH,
    TWO_JOINT,
    TWO_JOINT_DH,
    board_session,
    deviations,
)
from calib.arm_problem.arm_model import Bounds
from calib.arrays import norms
from calib.errors import CalibrationError, UnusablePointsError
from calib.identify.objective import LeastSquares, SumOfDistances
from tests.calib.arms import identified

ARMS = {"reference": (REFERENCE, REFERENCE_DH), "two joints": (TWO_JOINT, TWO_JOINT_DH), "modified": (MODIFIED, MODIFIED_DH)}
BOTH = pytest.mark.parametrize("objective", [SumOfDistances(), LeastSquares()], ids=["E2", "LSQ"])


def workspace(rng, model, dh, m, noise_m):
    """True dh, and m poses over the whole workspace with measured tips."""
    true = dh + deviations(rng, len(dh))
    q = rng.uniform(-1.2, 1.2, (m, sum(model.joints)))
    return true, q, model.tips(true, q) + rng.normal(0.0, noise_m, (m, 3))


@pytest.mark.parametrize("name", ARMS)
@BOTH
def test_without_noise_every_prediction_is_exact(name, objective) -> None:
    model, dh = ARMS[name]
    rng = np.random.default_rng(3)
    true, q, tips = workspace(rng, model, dh, 60, 0.0)
    identification = identified(model, dh, q, tips, objective=objective)
    fresh = rng.uniform(-2.0, 2.0, (200, q.shape[1]))
    # Parameters that trade against each other are not the true ones; the tips that they predict are, everywhere.
    assert norms(model.tips(identification.dh, fresh) - model.tips(true, fresh)).max() < 1e-6
    assert identification.is_converged


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("seed", range(3))
def test_with_camera_noise_predictions_hold_over_the_workspace(name, seed) -> None:
    model, dh = ARMS[name]
    rng = np.random.default_rng(seed)
    true, q, tips = workspace(rng, model, dh, 120, 0.00014)
    identification = identified(model, dh, q, tips)
    fresh = rng.uniform(-1.2, 1.2, (300, q.shape[1]))
    # 10 to 20 parameters from 360 coordinates: about 0.14 mm * sqrt(20 / 360) = 0.03 mm per axis is left.
    assert norms(model.tips(identification.dh, fresh) - model.tips(true, fresh)).mean() < 0.00012
    assert identification.noise_m == pytest.approx(0.00014, rel=0.15)


def test_a_level_board_determines_nine_of_sixteen_parameters_and_three_tilts_ten() -> None:
    """Rank 9 with condition near 1000 for 33 level points, rank 10 and some 300 on three tilts."""
    rng = np.random.default_rng(1)
    _, q, tips, _ = board_session(rng, ("normal",))
    level = identified(REFERENCE, REFERENCE_DH, q, tips)
    assert level.rank == 9
    assert 800 < level.condition_number < 1400
    _, q, tips, _ = board_session(rng)
    tilted = identified(REFERENCE, REFERENCE_DH, q, tips)
    assert tilted.rank == 10
    assert 200 < tilted.condition_number < 500


def test_what_cannot_be_determined_stays_at_nominal_and_is_named() -> None:
    _, q, tips, _ = board_session(np.random.default_rng(2))
    identification = identified(REFERENCE, REFERENCE_DH, q, tips)
    deviation = dict(zip((e.parameter.name for e in identification.estimates), identification.deviations.ravel(), strict=True))
    assert deviation["alpha4"] == 0.0
    assert abs(deviation["theta4"]) < 1e-4
    assert deviation["d2"] == pytest.approx(deviation["d3"], abs=2e-5)
    assert deviation["L3"] == pytest.approx(deviation["L4"], abs=2e-5)
    groups = {frozenset(group.names): group.freedoms_count for group in identification.undetermined}
    assert groups == {
        frozenset({"d2", "d3", "alpha3"}): 2,
        frozenset({"theta3", "L3", "L4"}): 2,
        frozenset({"theta4"}): 1,
        frozenset({"alpha4"}): 1,
    }
    text = " ".join(identification.in_words())
    assert "determine 10 of 16" in text
    assert "d2, d3 and alpha3 move together" in text
    assert "theta4 and alpha4 have no effect" in text


def test_the_words_are_true_a_named_trade_moves_no_tip() -> None:
    _, q, _, _ = board_session(np.random.default_rng(2))
    dh = REFERENCE_DH.copy()
    dh[2, 1] -= np.radians(0.16172)  # theta3 -0.162 deg with L3 +1.00 mm
    dh[2, 2] += 0.001
    assert norms(REFERENCE.tips(dh, q) - REFERENCE.tips(REFERENCE_DH, q)).max() < 3e-6


def test_bounds_that_bind_are_named_and_kept() -> None:
    rng = np.random.default_rng(0)
    true = REFERENCE_DH.copy()
    true[1, 2] += 0.008  # L2 is 8 mm longer: 3 mm more than the bound
    q = rng.uniform(-1.0, 1.0, (80, 3))
    tips = REFERENCE.tips(true, q) + rng.normal(0, 0.00014, (80, 3))
    identification = identified(REFERENCE, REFERENCE_DH, q, tips)
    assert "L2" in identification.binding
    assert identification.deviations[1, 2] == pytest.approx(0.005, abs=1e-9)
    assert "At the bound: " in " ".join(identification.in_words())
    freer = identified(REFERENCE, REFERENCE_DH, q, tips, bounds=Bounds(own={"L2": 0.02}))
    assert freer.binding == ()
    assert freer.deviations[1, 2] == pytest.approx(0.008, abs=1e-4)


def test_a_fixed_parameter_keeps_its_value() -> None:
    _, q, tips, _ = board_session(np.random.default_rng(4))
    identification = identified(REFERENCE, REFERENCE_DH, q, tips, fixed=["d1", "theta4"])
    assert identification.dh[0, 0] == REFERENCE_DH[0, 0]
    assert len(identification.estimates) == 14


def test_same_inputs_same_result_and_starts_do_not_matter() -> None:
    _, q, tips, _ = board_session(np.random.default_rng(6))
    one, again, other = (identified(REFERENCE, REFERENCE_DH, q, tips, seed=s) for s in (0, 0, 9))
    assert np.array_equal(one.dh, again.dh)
    assert other.objective_after == pytest.approx(one.objective_after, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda q, t: (q[:3], t[:3]), "3 different points are too few"),
        (lambda q, t: (np.tile(q[:2], (20, 1)), np.tile(t[:2], (20, 1))), "2 different points are too few"),
        (lambda q, t: (q[24:33], t[24:33]), "one straight line"),
        (lambda q, t: (np.degrees(q), t), "degrees or counts"),
        (lambda q, t: (q, np.where(np.arange(99)[:, None] == 4, np.nan, t)), "tip position of point 5"),
        (lambda q, t: (q, t[:-1]), "expected"),
    ],
)
def test_points_that_cannot_be_used_are_refused(change, says) -> None:
    _, q, tips, _ = board_session(np.random.default_rng(6))
    with pytest.raises(UnusablePointsError, match=says):
        identified(REFERENCE, REFERENCE_DH, *change(q, tips))


def test_a_bound_or_name_that_makes_no_sense_is_refused() -> None:
    _, q, tips, _ = board_session(np.random.default_rng(6))
    with pytest.raises(CalibrationError, match="no parameter theta9"):
        identified(REFERENCE, REFERENCE_DH, q, tips, fixed=["theta9"])
    with pytest.raises(CalibrationError, match="bound of L2"):
        identified(REFERENCE, REFERENCE_DH, q, tips, bounds=Bounds(own={"L2": 0.0}))


def test_the_chain_of_these_tests_has_the_derivatives_that_it_claims() -> None:
    for model, dh in ARMS.values():
        q = np.random.default_rng(0).uniform(-1, 1, (5, sum(model.joints)))
        _, jacobian = model.tips_and_dh_jacobian(dh, q)
        steps = (1e-30j * unit.reshape(dh.shape) for unit in np.eye(dh.size))
        numeric = np.stack([model.tips(dh + step, q).imag / 1e-30 for step in steps], axis=2)
        np.testing.assert_allclose(jacobian, numeric, atol=1e-14)
