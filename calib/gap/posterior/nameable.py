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
    laws = {key: evidence.places[k][: evidence.terms[k].laws] for key, k in names.items()}
    found = []
    for key, own in laws.items():
        alone = _detectability(gram[np.ix_(own, own)])
        rivals = [
            other
            for other, k in names.items()
            if other != key
            and alone >= TOLD_APART_sd
            and _detectability(_beside(evidence, gram, own, k)) < TOLD_APART_sd
        ]
        found.append(Nameable(key, round(alone, 2), tuple(rivals), needed_sd=NAMEABLE_sd))
    return tuple(found)


def _beside(evidence: Evidence, gram: Array, own: Array, rival: int) -> Array:
    """What is left of G of columns `own` when a rival takes what it can."""
    at, one = evidence.places[rival], evidence.terms[rival]
    sd = np.full(len(at), RIVAL_LEVEL)
    sd[one.laws : one.laws + one.departures] *= RIVAL_DEPARTURE
    across = sd[:, None] * gram[np.ix_(at, own)]
    inner = np.eye(len(at)) + sd[:, None] * gram[np.ix_(at, at)] * sd
    return np.asarray(gram[np.ix_(own, own)] - across.T @ np.linalg.solve(inner, across))


def _detectability(seen: Array) -> float:
    """Root mean square over the coefficients' directions, each of usual size, in standard deviations."""
    return float(np.sqrt(max(0.0, np.trace(seen) / len(seen))))
