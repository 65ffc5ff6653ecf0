"""Whether a name helps recordings that it was not fitted to: every recording in turn is predicted from the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.poses.recordings import recordings
from calib.gap.poses.state import Around
from calib.gap.posterior.search import Weighed

FOLDS = 5


def holds_on_others(around: Around, best: Weighed, name: EffectName) -> bool:
    """Whether the set predicts recordings that were left out better with the name than without it.

    True where nothing can be left out, and where the tips do not show the effect.
    """
    own = [one for one in best.members if around.terms[one[0]].key == name]
    folds = list(_folds(around))
    if len(folds) < 2 or not around.moved_m(best, [k for k, _ in own]).any():
        return True
    without = dataclasses.replace(best, members=tuple(one for one in best.members if one not in own))
    return sum(_missed(around, best, *fold) for fold in folds) < sum(
        _missed(around, without, *fold) for fold in folds
    )


def _folds(around: Around) -> Iterator[tuple[Mask, Mask]]:
    """Poses (m,) that are fitted and those that are left out: every recording once, several at a time where there are many."""
    labels = recordings(around.points)
    names = list(dict.fromkeys(labels[around.rows].tolist()))
    for first in range(min(FOLDS, len(names))):
        out = np.isin(labels, names[first::FOLDS])
        yield around.rows & ~out, around.rows & out


def _missed(around: Around, found: Weighed, fitted: Mask, left_out: Mask) -> float:
    """Sum of squares, in variances of the floor, at poses `left_out` (m,) of a set that was fitted to others."""
    base, columns = around.linear.base, around.columns([k for k, _ in found.members])
    whole = np.hstack((base, columns))
    spread = [around.evidence.scales[k][0][h] for k, h in found.members]
    precision = np.concatenate([around.linear.precision, *(sd**-2.0 for sd in map(_positive, spread))])
    white, y = _whitened(around, whole, fitted), _whitened(around, around.linear.y[:, None], fitted)
    x = np.linalg.solve(white.T @ white + np.diag(precision), white.T @ y)
    rest = _whitened(around, around.linear.y[:, None] - whole @ x, left_out)
    return float(np.sum(rest**2))


def _positive(sd: Array) -> Array:
    return np.maximum(sd, 1e-9)


def _whitened(around: Around, values: Array, rows: Mask) -> Array:
    own = values.reshape(len(rows), 3, -1)[rows]
    return np.asarray((around.linear.weight[rows] / around.noise_m @ own).reshape(-1, own.shape[2]))
