"""What this data could name at all, before any residual is looked at: how far an effect of typical size would stand out
beside the geometry, and which other effects could pass for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.arrays import Mask
from calib.gap.finding import EffectName, Nameable
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.evidence import Evidence
from calib.gap.static.decision import FIRST_COST, MARGIN
from calib.gap.static.linearised import Linearised, places

# Standard deviations at which the expected log evidence, half their square, pays a first name and a margin over its rivals in
# 97 of 100 recordings: noise adds one standard deviation to how far an effect stands out.
MOSTLY_sd = 1.88
NAMEABLE_sd = math.sqrt(2.0 * (FIRST_COST + MARGIN)) + MOSTLY_sd
TOLD_APART_sd = math.sqrt(2.0 * MARGIN) + MOSTLY_sd


def nameable(around: Linearised, tried: Sequence[Candidate], rows: Mask) -> tuple[Nameable, ...]:
    """Every effect with its detectability at typical size, and the effects that this data cannot tell it from."""
    seen = _one_shape_each(tried)
    evidence = around.evidence(seen, rows)
    at = places(seen)
    found = []
    for one, own in zip(seen, at, strict=True):
        alone = _detectability(evidence, own)
        confounders = [
            rival.name
            for rival, other in zip(seen, at, strict=True)
            if rival is not one
            and alone >= TOLD_APART_sd
            and _detectability(evidence, own, other) < TOLD_APART_sd
        ]
        found.append(Nameable(one.name, round(alone, 2), tuple(confounders)))
    return tuple(found)


def is_nameable(one: Nameable) -> bool:
    """Whether an effect of typical size would be named."""
    return one.detectability >= NAMEABLE_sd and not one.confusable_with


def _one_shape_each(tried: Sequence[Candidate]) -> list[Candidate]:
    """Of an effect with several shapes the middle one."""
    names: dict[EffectName, list[Candidate]] = {}
    for one in tried:
        names.setdefault(one.name, []).append(one)
    return [same[len(same) // 2] for same in names.values()]


def _detectability(evidence: Evidence, own: Sequence[int], beside: Sequence[int] = ()) -> float:
    """Root mean square over the coefficients' directions, each of typical size."""
    each = [evidence.detectability(own, unit, beside) for unit in np.eye(len(own))]
    return math.sqrt(sum(one * one for one in each) / len(each))
