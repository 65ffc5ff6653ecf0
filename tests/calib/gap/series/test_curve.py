"""A law that bends its response has one value behind two coefficients."""

from __future__ import annotations

import numpy as np
import pytest

from calib.gap.residuals.scene import Curve

CURVE = Curve(place=1, start=2e-3, near=2.4e-3, size=1e-3)


def test_a_value_at_a_secants_start_does_not_turn_it() -> None:
    assert CURVE.turned(2.0)[0] == pytest.approx(0.0)
    assert CURVE.turned(2.4)[0] == pytest.approx(1.2)


def test_a_turn_that_is_known_better_says_the_value() -> None:
    value = 2.1
    mean = np.array([value + 0.3, CURVE.turned(value)[0]])
    held, spread = CURVE.held(mean, np.diag([0.2**2, 0.02**2]))
    assert held[0] == pytest.approx(value, abs=0.02)
    assert np.sqrt(spread[0, 0]) < 0.05


def test_what_fits_its_curve_stays() -> None:
    mean = np.array([2.2, CURVE.turned(2.2)[0]])
    held, _ = CURVE.held(mean, np.eye(2))
    assert held == pytest.approx(mean)
