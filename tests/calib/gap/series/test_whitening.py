"""The noise of a cell is measured: prediction errors of what it fits are white, and a gap begins anew."""

from __future__ import annotations

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.residuals.whitening import Noise, RowOrder, fitted

ROWS = 20_000


def slow(share: float, seed: int) -> Array:
    """An autoregressive sequence of first order, errors of size 2."""
    errors = 2.0 * np.random.default_rng(seed).normal(size=ROWS)
    values = np.zeros(ROWS)
    for k in range(1, ROWS):
        values[k] = share * values[k - 1] + errors[k]
    return values


def series(runs: int = 1) -> RowOrder:
    run = np.repeat(np.arange(runs), ROWS // runs)
    return RowOrder.of(run, np.tile(8 * np.arange(ROWS // runs), runs), 8, 1)


def test_prediction_errors_of_a_slow_noise_are_white_and_of_size_one() -> None:
    values, own = slow(0.9, 1), series()
    white = own.whitened(values[:, None], fitted(own, values, np.ones(ROWS, dtype=bool)))[:, 0]
    assert np.std(white) == pytest.approx(1.0, rel=0.02)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03


def test_the_mean_of_a_slow_noise_is_as_uncertain_as_it_is() -> None:
    """Weighed least squares of a constant: what independent rows would say is four times too sure at 0.9."""
    found, said = [], 0.0
    for seed in range(30):
        values, own = slow(0.9, seed), series()
        noise = fitted(own, values, np.ones(ROWS, dtype=bool))
        white = own.whitened(np.column_stack((np.ones(ROWS), values)), noise)
        found.append(float(white[:, 0] @ white[:, 1] / (white[:, 0] @ white[:, 0])))
        said = float((white[:, 0] @ white[:, 0]) ** -0.5)
    assert np.std(found) == pytest.approx(said, rel=0.4)  # 30 draws: 13 % of it is one deviation


def test_rows_after_a_gap_are_predicted_by_none_before_it() -> None:
    own = RowOrder.of(np.zeros(6, dtype=int), np.array([0, 8, 16, 40, 48, 56]), 8, 1)
    assert own.before.tolist() == [0, 1, 2, 0, 1, 2]
    noise = Noise((np.zeros(0), np.array([0.5])), np.array([2.0, 1.0]), np.ones(1))
    white = own.whitened(np.ones((6, 1)), noise)[:, 0]
    assert white.tolist() == [0.5, 0.5, 0.5, 0.5, 0.5, 0.5]


def test_rows_that_are_not_kept_are_like_gaps() -> None:
    kept = np.array([True, True, False, True, True])
    own = RowOrder.of(np.zeros(5, dtype=int), 8 * np.arange(5), 8, 1, kept)
    assert own.before.tolist() == [0, 1, 0, 0, 1]


def test_the_three_axes_of_a_tip_are_each_their_own_sequence() -> None:
    own = RowOrder.of(np.zeros(6, dtype=int), np.repeat([0, 5], 3), 5, 3)
    noise = Noise((np.zeros(0), np.array([1.0])), np.ones(2), np.ones(1))
    white = own.whitened(np.array([1.0, 2.0, 3.0, 1.0, 2.0, 3.0])[:, None], noise)[:, 0]
    assert white.tolist() == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]


def test_a_run_that_errs_more_counts_less() -> None:
    values, own = np.random.default_rng(3).normal(size=ROWS), series(2)
    values[ROWS // 2 :] *= 5.0
    noise = fitted(own, values, np.ones(ROWS, dtype=bool))
    assert noise.scale[1] / noise.scale[0] == pytest.approx(5.0, rel=0.05)
