"""The posterior of time series on prescribed motions: what is hidden is named, drag is unknown, nothing is found in nothing."""

from __future__ import annotations

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.finding import EffectName, GapFinding
from calib.gap.series.find import find
from tests.calib.gap.dynamic.prescribed import Hidden, arm_with_friction, log_of

ARM = arm_with_friction()


def hiding(law: Hidden | None = None) -> GapFinding:
    return find(ARM, log_of(ARM) if law is None else log_of(ARM, law))


def names(found: GapFinding) -> set[EffectName]:
    return {effect.name for effect in found.effects}


def test_nothing_is_found_where_nothing_is_hidden() -> None:
    found = hiding()
    assert not found.effects
    assert not found.ambiguous
    assert found.unknown is None
    assert found.gap_after == pytest.approx(1.0, abs=0.1)


def test_two_laws_that_are_only_roughly_right_are_both_named_as_what_they_are() -> None:
    """Friction by load that follows the angle by 6 %, and viscous friction that bends by as much."""

    def law(j: int, q: Array, speed: Array, link: Array) -> Array:
        if j == 1:
            return np.asarray(0.2 * np.abs(link) * np.sign(speed) * (1.0 + 0.06 * np.sin(2.0 * q + 1.0)))
        return np.asarray(0.6 * speed * (1.0 + 0.06 * np.abs(speed))) if j == 2 else np.zeros_like(q)

    found = hiding(law)
    assert names(found) == {EffectName("load_friction", 2), EffectName("viscous_friction", 3)}
    for effect in found.effects:
        assert effect.probability > 0.95
        assert effect.departure < 0.24
    load = next(one for one in found.effects if one.name.effect == "load_friction")
    value, sd = load.parameters["fraction"]
    assert value == pytest.approx(0.2, rel=0.1)
    assert abs(value - 0.2) < 3.0 * sd
    assert found.gap_after < 1.3 < found.gap_before


def test_drag_with_the_square_of_speed_is_unknown_and_says_where() -> None:
    found = hiding(lambda j, q, speed, link: 1.5 * speed * np.abs(speed) if j == 1 else np.zeros_like(q))
    assert not found.effects
    assert found.unknown is not None
    assert "joint 2" in found.unknown.where
