"""When an arm counts as at rest: half a second without motion in its mode, or so long that any arm has sunk."""

from __future__ import annotations

import math

import pytest

from control.loop.drives import Standstill

STEP_S = 0.0625
SLOW_rad_s, FAST_rad_s = 0.02, 0.02 + 2**-40


def test_an_arm_is_still_half_a_second_after_its_last_motion() -> None:
    stillness = Standstill()
    assert stillness.mode_from_s == 0.0
    assert stillness.is_still(0.5, [SLOW_rad_s])
    stillness.enter_mode(8.0)
    assert stillness.mode_from_s == 8.0
    assert not stillness.is_still(8.5 - STEP_S, [SLOW_rad_s, -SLOW_rad_s])
    assert stillness.is_still(8.5, [SLOW_rad_s, -SLOW_rad_s])
    assert not stillness.is_still(9.0, [0.0, -FAST_rad_s])
    assert not stillness.is_still(9.5 - STEP_S, [0.0, 0.0])
    assert stillness.is_still(9.5, [0.0, 0.0])


@pytest.mark.parametrize("speed_rad_s", [9.0, math.nan])
def test_an_arm_that_never_seems_to_rest_is_still_after_it_must_have_sunk(speed_rad_s: float) -> None:
    stillness = Standstill()
    stillness.enter_mode(8.0)
    found = [stillness.is_still(8.0 + STEP_S * k, [9.0, speed_rad_s]) for k in range(1, 242)]
    assert found == [False] * 240 + [True]
