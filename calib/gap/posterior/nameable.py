"""What this data could name at all: how far an effect of usual size would stand out beside the geometry, and beside each rival.

A rival may depart from its law as real parts do, so that it passes for more than its textbook form would.
"""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName, Nameable
from calib.gap.posterior.constants import CERTAIN, DEPARTURES, NAME_PRIOR, SIZE_COST, SIZE_LEVELS, MOSTLY_sd
from calib.gap.posterior.evidence import Evidence

ODDS = math.log(CERTAIN / (1.0 - CERTAIN))
# Standard deviations at which the expected log evidence, half their square, pays a name, and its margin over a rival:
NAMEABLE_sd = math.sqrt(2.0 * (ODDS - math.log(NAME_PRIOR) + SIZE_COST)) + MOSTLY_sd
TOLD_APART_sd = math.sqrt(2.0 * ODDS) + MOSTLY_sd
RIVAL_LEVEL, RIVAL_DEPARTURE = SIZE_LEVELS[2], DEPARTURES[2]  # a large one, of the usual roughness


def nameable(evidence: Evidence) -> tuple[Nameable, ...]:
    """Every effect of the list, the middle one of its variants, with those that it cannot be told from."""
    gram = evidence.gram.tip + evidence.gram.current
    names = {
        key: numbers[len(numbers) // 2]
        for key, numbers in evidence.of_key.items()
        if isinstance(key, EffectName)
    }
    columns = [evidence.places[k][: evidence.terms[k].laws] for k in names.values()]
    every, ends = np.concatenate([*columns, []]).astype(int), np.cumsum([len(own) for own in columns])
    places = {key: slice(end - len(own), end) for key, own, end in zip(names, columns, ends, strict=True)}
    alone = np.diagonal(gram)[every]
    beside = {rival: alone - _taken(evidence, gram, every, k) for rival, k in names.items()}
    found = []
    for key, at in places.items():
        seen_sd = _detectability(alone[at])
        rivals = [
            other
            for other, left in beside.items()
            if other != key and seen_sd >= TOLD_APART_sd and _detectability(left[at]) < TOLD_APART_sd
        ]
        found.append(Nameable(key, round(seen_sd, 2), tuple(rivals), needed_sd=NAMEABLE_sd))
    return tuple(found)


def _taken(evidence: Evidence, gram: Array, columns: Array, rival: int) -> Array:
    """What a rival takes at most of G's diagonal at `columns`: all that the root mean square of what is left needs."""
    at, one = evidence.places[rival], evidence.terms[rival]
    sd = np.full(len(at), RIVAL_LEVEL)
    sd[one.laws : one.laws + one.departures] *= RIVAL_DEPARTURE
    across = sd[:, None] * gram[np.ix_(at, columns)]
    inner = np.eye(len(at)) + sd[:, None] * gram[np.ix_(at, at)] * sd
    return np.asarray(np.einsum("ij,ij->j", across, np.linalg.solve(inner, across)))


def _detectability(seen: Array) -> float:
    """Root mean square over the coefficients' directions, each of usual size, in standard deviations."""
    return math.sqrt(max(0.0, float(np.mean(seen))))
