"""Whether a name helps recordings that it was not fitted to: every recording in turn is predicted from the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.poses.recordings import in_turn, parts
from calib.gap.poses.state import Linearised
from calib.gap.posterior.constants import FOLDS
from calib.gap.posterior.evidence import Weighed
from calib.gap.posterior.term import Block, Key


def holds_on_others(linearised: Linearised, best: Weighed, name: EffectName, names: Collection[EffectName]) -> bool:
    """Whether recordings that were left out are predicted better with the name than without it: by the set, and by a file that
    has the laws of all `names` and nothing else. One of an ambiguous set is there, whichever it is.

    True where nothing can be left out, and where the tips do not show the effect.
    """
    labels = parts(linearised.looked.points, FOLDS)
    return all(_helps(linearised, weighed, name, labels) for weighed in (best, _laws_alone(linearised, best, names)))


def _laws_alone(linearised: Linearised, best: Weighed, names: Collection[EffectName]) -> Weighed:
    """The set without blocks, and without how parts depart from their laws."""
    members = []
    for number, scale in best.members:
        term, sizes = linearised.terms[number], linearised.evidence.scales[number][0]
        if term.key in names:
            same = sizes[:, 0] == sizes[scale, 0]
            exact = ~sizes[:, term.laws : term.laws + term.departures].any(axis=1)
            members.append((number, int(np.flatnonzero(same & exact)[0])))
    return dataclasses.replace(best, members=tuple(members))


def shows_in_others(linearised: Linearised, best: Weighed, block: Block) -> bool:
    """Whether the set predicts single poses that were left out better with a block than without it.

    What has no name may be of one recording alone; what is there shows in the poses between those that were left out, and
    what a rich fit made of its own noise does not.
    """
    labels = np.empty(len(linearised.looked.points), dtype=object)
    labels[in_turn(linearised.looked.points)] = [f"{turn % FOLDS}" for turn in range(len(labels))]
    return _helps(linearised, best, block, labels.astype(str))


def _helps(linearised: Linearised, best: Weighed, key: Key, labels: npt.NDArray[np.str_]) -> bool:
    members = [member for member in best.members if linearised.terms[member[0]].key == key]
    folds = list(_folds(linearised, labels))
    if len(folds) < 2 or not linearised.moves(best, [k for k, _ in members]):
        return True
    without = dataclasses.replace(best, members=tuple(member for member in best.members if member not in members))
    return sum(_missed(linearised, best, *fold) for fold in folds) < sum(_missed(linearised, without, *fold) for fold in folds)


def _folds(linearised: Linearised, labels: npt.NDArray[np.str_]) -> Iterator[tuple[Mask, Mask]]:
    """Poses (m,) that are fitted and those that are left out: every label once, several at a time where there are many."""
    order = in_turn(linearised.looked.points)
    names = list(dict.fromkeys(labels[order[linearised.looked.parts.known[order]]].tolist()))
    for first in range(min(FOLDS, len(names))):
        out = np.isin(labels, names[first::FOLDS])
        yield linearised.looked.parts.known & ~out, linearised.looked.parts.known & out


def _missed(linearised: Linearised, weighed: Weighed, fitted: Mask, left_out: Mask) -> float:
    """Sum of squares, in variances of the floor, at poses `left_out` (m,) of a set that was fitted to others."""
    base, columns = linearised.linear.base, linearised.columns([k for k, _ in weighed.members])
    whole = np.hstack((base, columns))
    spread = [linearised.evidence.scales[k][0][h] for k, h in weighed.members]
    precision = np.concatenate([linearised.linear.precision, *(sd**-2.0 for sd in map(_positive, spread))])
    values, noise_m = linearised.linear.y[:, None], linearised.looked.floor.tip_m
    white = linearised.linear.whitened(whole, fitted, noise_m)
    y = linearised.linear.whitened(values, fitted, noise_m)
    x = np.linalg.solve(white.T @ white + np.diag(precision), white.T @ y)
    return float(np.sum(linearised.linear.whitened(values - whole @ x, left_out, noise_m) ** 2))


def _positive(sd: Array) -> Array:
    return np.maximum(sd, 1e-9)
