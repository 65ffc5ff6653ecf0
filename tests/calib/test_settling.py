"""The one rule of iterations: it ends at a fixed point, or where steps no longer get shorter, and each value ends for itself."""

import numpy as np

from calib.settling import Settling


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
