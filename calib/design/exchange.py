"""Selection of poses: greedy, then exchanges until none helps.

Fedorov, Theory of Optimal Experiments, 1972; Mitchell, Technometrics 16 (1974) 203 (DETMAX, of which this is the case
without excursions: remove one, add the best one).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.design.criteria import Criterion
from calib.design.information import Experiment
from calib.design.reach import Rows
from calib.errors import CalibrationError

SWEEPS_LIMIT = 20
BETTER = 1e-9  # an exchange must gain more than this share


@dataclass(frozen=True, slots=True)
class Group:
    """Select `count` of these poses (rows of the experiment); `name` is for the error if there are too few."""

    name: str
    rows: Rows
    count: int


def select(
    experiment: Experiment,
    criterion: Criterion,
    taken: Rows,
    groups: Sequence[Group],
    start: Sequence[int] | None = None,
) -> list[int]:
    """Rows of the best poses to add to those recorded, with the count of each group.

    In order of value: each is the best of the chosen ones to add to the previous ones. `start`: a choice to
    start the exchanges with, instead of the greedy one. CalibrationError if a group has too few.
    """
    for group in groups:
        if group.count > len(group.rows):
            raise CalibrationError(
                f"{group.count} {group.name} were requested, but only {len(group.rows)} are available: request fewer"
            )
    if start is None:
        chosen = _greedy(experiment, criterion, taken, groups)
    else:
        chosen = [(row, next(k for k, group in enumerate(groups) if row in group.rows)) for row in start]
    _exchange(experiment, criterion, taken, groups, chosen)
    rows = np.array([row for row, _ in chosen], dtype=np.intp)
    ordered = _greedy(experiment, criterion, taken, [Group("poses", rows, len(rows))])
    return [row for row, _ in ordered]


def _greedy(
    experiment: Experiment, criterion: Criterion, taken: Rows, groups: Sequence[Group]
) -> list[tuple[int, int]]:
    """(row, group) of each choice: the best of all groups that are not complete yet."""
    information = experiment.information(taken)
    left = [np.array(group.rows) for group in groups]
    open_count = [group.count for group in groups]
    chosen: list[tuple[int, int]] = []
    while any(open_count):
        places = [(k, rows) for k, rows in enumerate(left) if open_count[k]]
        rows = np.concatenate([rows for _, rows in places])
        owner = np.concatenate([np.full(len(rows), k) for k, rows in places])
        best = int(np.argmax(criterion(experiment, information, experiment.rows[rows])))
        row, group = int(rows[best]), int(owner[best])
        chosen.append((row, group))
        open_count[group] -= 1
        left = [rows[rows != row] for rows in left]
        information = information + _information_of(experiment, row)
    return chosen


def _exchange(
    experiment: Experiment,
    criterion: Criterion,
    taken: Rows,
    groups: Sequence[Group],
    chosen: list[tuple[int, int]],
) -> None:
    """Replace each choice by the best of its group, again and again, until nothing changes."""
    for _ in range(SWEEPS_LIMIT):
        is_changed = False
        for place, (row, group) in enumerate(chosen):
            others = [other for other, _ in chosen if other != row]
            information = experiment.information(np.array([*taken, *others], dtype=np.intp))
            rows = groups[group].rows[~np.isin(groups[group].rows, others)]
            scores = criterion(experiment, information, experiment.rows[rows])
            best, own = int(np.argmax(scores)), float(scores[np.flatnonzero(rows == row)[0]])
            if scores[best] > own + BETTER * abs(own):
                chosen[place] = (int(rows[best]), group)
                is_changed = True
        if not is_changed:
            return


def _information_of(experiment: Experiment, row: int) -> Array:
    """J'J of one pose."""
    return np.asarray(experiment.rows[row].T @ experiment.rows[row])
