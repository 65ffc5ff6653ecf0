"""Speeds and accelerations are exact within the band that rows keep, and rows of noise are hardly correlated."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.signals.filters import filters_for


@pytest.mark.parametrize("rate_Hz", [200.0, 500.0, 1000.0])
@pytest.mark.parametrize("tone", [0.004, 0.02, 0.05])
def test_derivatives_are_those_of_the_filtered_angle(rate_Hz: float, tone: float) -> None:
    """A tone of this share of the sampling rate; an error of 1e-3 is far below what a floor shows of any motion."""
    w = 2 * np.pi * tone * rate_Hz
    q = np.sin(w * np.arange(2000) / rate_Hz)[:, None]
    value, speed, acceleration = (part[200:-200, 0] for part in filters_for(rate_Hz).states(q))
    whole = slice(0, 1500)  # whole periods of each of these tones
    size, fast, bent = (float(np.sqrt(np.mean(part[whole] ** 2))) for part in (value, speed, acceleration))
    assert fast / size == pytest.approx(w, rel=1e-3)
    assert bent / size == pytest.approx(w * w, rel=1e-3)


def test_a_standing_joint_has_neither_speed_nor_acceleration() -> None:
    value, speed, acceleration = filters_for(500.0).states(np.full((300, 2), 1.7))
    np.testing.assert_allclose(value, 1.7, rtol=1e-12)
    np.testing.assert_allclose(speed, 0.0, atol=1e-9)
    np.testing.assert_allclose(acceleration, 0.0, atol=1e-6)


def test_rows_of_white_noise_are_hardly_correlated_and_of_the_stated_size() -> None:
    filters = filters_for(500.0)
    noise = np.random.default_rng(3).normal(size=(200_000, 1))
    rows = filters.rows(filters.states(noise)[0])[:, 0]
    assert rows.std() == pytest.approx(filters.row_gain, rel=0.03)
    assert abs(np.corrcoef(rows[1:], rows[:-1])[0, 1]) < 0.4
    assert len(rows) == len(filters.places(200_000))
