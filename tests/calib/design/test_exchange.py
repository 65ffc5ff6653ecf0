"""The choice of poses: against trying all, against greedy choice, quotas."""

import itertools

import numpy as np
import pytest

from calib.design.information import CRITERIA, Group, criterion_of, select, uncertainty_of
from calib.errors import CalibrationError
from tests.calib.design.experiments import drawn, experiment

EXPERIMENT, POSES = experiment(free_count=120)
TOTAL = len(EXPERIMENT.rows)
NOTHING = np.zeros(0, dtype=np.intp)


def log_det(rows) -> float:
    return uncertainty_of(EXPERIMENT, rows).log_det


@pytest.mark.parametrize("seed", range(2))
def test_choice_is_the_best_of_all_for_few_candidates(seed):
    """4 of 12, 495 ways: the exchange may end in a local optimum, at most 1 % below the best."""
    rows = np.sort(drawn(12, TOTAL, seed))
    chosen = select(EXPERIMENT, criterion_of("D"), NOTHING, [Group("poses", rows, 4)])
    best = max(log_det(list(way)) for way in itertools.combinations(rows, 4))
    assert log_det(chosen) >= 0.99 * best


def test_exchange_never_ends_below_the_greedy_choice_and_mostly_above():
    gains = []
    for seed in range(3):
        rows = np.sort(drawn(30, TOTAL, seed))
        chosen = select(EXPERIMENT, criterion_of("D"), NOTHING, [Group("poses", rows, 8)])
        greedy = []
        for _ in range(8):
            greedy.append(max((r for r in rows if r not in greedy), key=lambda r: log_det([*greedy, r])))
        gains.append(log_det(chosen) - log_det(greedy))
    assert min(gains) >= -1e-6
    assert max(gains) > 0.01


@pytest.mark.parametrize("name", CRITERIA)
def test_every_criterion_beats_the_median_of_random_choices_by_its_own_measure(name):
    def worth(rows):
        after = uncertainty_of(EXPERIMENT, rows)
        found = {"D": after.log_det, "tip": -after.tip_m, **after.indices.as_dict()}
        return found[name]

    chosen = select(EXPERIMENT, criterion_of(name), NOTHING, [Group("poses", np.arange(TOTAL), 10)])
    random = [worth(drawn(10, TOTAL, seed)) for seed in range(20)]
    assert worth(chosen) > max(random)


def test_so_many_of_each_group_are_chosen_and_none_twice():
    groups = [Group("cavities", np.arange(99), 7), Group("free poses", np.arange(99, TOTAL), 5)]
    chosen = select(EXPERIMENT, criterion_of("D"), NOTHING, groups)
    assert len(set(chosen)) == 12
    assert sum(row < 99 for row in chosen) == 7


def test_poses_come_in_the_order_of_their_worth():
    """Adding to an information matrix has falling returns: each gains no more than the one before."""
    chosen = select(EXPERIMENT, criterion_of("D"), NOTHING, [Group("poses", np.arange(TOTAL), 9)])
    gains = np.diff([log_det(chosen[:k]) for k in range(10)])
    assert (np.diff(gains) < 1e-9).all()


def test_what_is_taken_counts():
    """With the roll tilt taken, the choice is another than from nothing, and better than that one in its place."""
    taken = np.arange(33, 66)
    anew = select(EXPERIMENT, criterion_of("D"), NOTHING, [Group("poses", np.arange(66, TOTAL), 6)])
    after = select(EXPERIMENT, criterion_of("D"), taken, [Group("poses", np.arange(66, TOTAL), 6)])
    assert log_det([*taken, *after]) > log_det([*taken, *anew])


def test_more_than_there_are_is_one_error_that_says_how_many_there_are():
    with pytest.raises(CalibrationError, match="5 free poses were requested, but only 3 are available"):
        select(EXPERIMENT, criterion_of("D"), NOTHING, [Group("free poses", np.arange(3), 5)])
