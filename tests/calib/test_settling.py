"""The one rule of iterations: it ends at a fixed point, or where steps no longer get shorter, and each value ends for itself."""

import numpy as np
import pytest

from benchmarks.gap.static.cases import Design, Hidden, designed
from calib import calibration
from calib.arm_problem.assembly import Choice
from calib.calibration import CalibrationPlan, about_settling, identified
from calib.identify.objective import LeastSquares
from calib.settling import FITS_MOST, JUDGED_BY, STEPS_MOST, Settling


def ended(mapped, x: np.ndarray, enough: float = 1e-9) -> tuple[np.ndarray, int]:
    settling, count = Settling(), 0
    while settling.goes_on:
        further = mapped(x)
        x = np.where(settling.takes(np.abs(further - x), enough), further, x)
        count += 1
    return x, count


def test_a_contraction_ends_at_its_fixed_point_and_a_slower_value_keeps_no_other_from_resting() -> None:
    moves = []

    def mapped(x: np.ndarray) -> np.ndarray:
        moves.append(x[0])
        return np.array([0.1, 0.9]) * x + np.array([0.9, 0.2])

    x, _ = ended(mapped, np.zeros(2))
    assert np.abs(x - np.array([1.0, 2.0])).max() < 1e-8
    assert len(moves) > 100
    assert len(set(moves)) < 15


def test_what_jumps_to_and_fro_or_away_ends_without_a_count_and_stays_where_it_was_last_nearer() -> None:
    flanks, count = ended(lambda x: -x, np.array([0.5]))
    assert (flanks.tolist(), count) == ([-0.5], 2)
    away, count = ended(lambda x: 3.0 * x, np.array([1.0]))
    assert (away.tolist(), count) == ([3.0], 2)
    lost, count = ended(lambda x: x * np.nan, np.array([1.0]))
    assert (lost.tolist(), count) == ([1.0], 1)


@pytest.mark.parametrize(("rate", "most"), [(0.97, STEPS_MOST), (0.999999, STEPS_MOST), (0.8, FITS_MOST)])
def test_what_would_not_settle_in_a_useful_number_of_steps_is_left_soon_and_said(rate: float, most: int) -> None:
    settling, count, step = Settling(most), 0, np.array([1.0, 1.0])
    while settling.goes_on:
        settling.takes(step, 1e-9)
        step, count = step * [rate, 0.01], count + 1
    assert settling.slow.tolist() == [True, False]
    assert count == JUDGED_BY + 2


def test_no_iteration_is_longer_than_the_useful_number_however_its_rate_changes() -> None:
    """Fast until it is nearly there, so that few steps seem to be left, then as slowly as can be."""
    settling, count, step = Settling(), 0, 1.0
    while settling.goes_on:
        settling.takes(step, 1e-9)
        step, count = max(0.5 * step, 1.0000001e-9 + 1e-18 * (1000 - count)), count + 1
    assert count <= STEPS_MOST
    assert settling.slow


def test_one_slow_step_among_fast_ones_ends_nothing() -> None:
    settling, count, step = Settling(FITS_MOST), 0, 1.0
    for factor in (0.5, 0.999, 0.5, 0.5, 0.999, *(0.4,) * 40):
        if settling.goes_on:
            settling.takes(step, 1e-6)
            step, count = step * factor, count + 1
    assert not settling.slow
    assert step < 1e-6


def test_a_calibration_whose_fits_do_not_settle_says_so(monkeypatch) -> None:
    soft = (Hidden("joint_compliance", 2, 300.0),)
    arm, points = designed(64, soft, Design(step=8, free=20))
    plan = CalibrationPlan(Choice(effects=("joint_compliance:2",)), LeastSquares(), starts_count=1)
    _, found = identified(arm, points, plan)
    assert about_settling(found) == []
    monkeypatch.setattr(calibration, "FITS_MOST", 1)
    monkeypatch.setattr(calibration, "SAME_sd", 1e-9)
    _, found = identified(arm, points, plan)
    (said,) = about_settling(found)
    assert f"{1e3 * found.unsettled_m:.2g} mm" in said
