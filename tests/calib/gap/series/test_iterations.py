"""Which of two looks at the same recordings stays: the one that predicts them better, as far as the runs agree on it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from calib.gap.series.iterations import BEGUN, FITTED, Validated, _done


def validated(*missed: float) -> Validated:
    """Prediction errors of runs of the same length."""
    nothing: Any = None
    weight = np.full(len(missed), 1.0 / len(missed))
    return Validated(nothing, (), np.array(missed), weight, np.zeros(0, dtype=bool))


@pytest.mark.parametrize(
    ("worse", "stays", "stays_remeasured"),
    [
        ((0.2, 0.2, 0.2, 0.2), False, False),
        ((0.05, 0.05, 0.05, 0.05), True, True),  # worth no word
        ((0.5, -0.3, 0.5, -0.3), False, True),  # worse in one half of the runs, and better in the other
        ((0.2,), False, False),
        ((-0.4, -0.2), True, True),
    ],
)
def test_a_fit_stays_unless_its_predictions_are_worse(worse: tuple[float, ...], stays: bool, stays_remeasured: bool) -> None:
    before, after = validated(*[1.0] * len(worse)), validated(*[1.0 + one for one in worse])
    assert (after.unless_worse_than(before) is after) == stays
    assert (after.unless_worse_than(before, is_remeasured=True) is after) == stays_remeasured


def test_the_first_fit_has_no_other() -> None:
    assert (first := validated(1.0)).unless_worse_than(None) is first


def test_what_is_done_grows_through_any_number_of_linearisations() -> None:
    done = [_done(turn, part) for turn in range(6) for part in (0.0, 0.05, 0.85)]
    assert done == sorted(done)
    assert done[0] == pytest.approx(BEGUN)
    assert done[-1] < FITTED
    assert _done(1, 1.0) == pytest.approx(_done(2, 0.0))
