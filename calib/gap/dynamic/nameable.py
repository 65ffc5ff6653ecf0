"""What this recording could name at all, before any residual is looked at: detectability and doubles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.catalogue import Candidate
from calib.gap.dynamic.screen import Screen
from calib.gap.dynamic.sizes import smallest
from calib.gap.dynamic.split import Split
from calib.gap.dynamic.terms import Term
from calib.gap.finding import EffectName, Nameable
from control.model.arm import Arm

ALIKE = 0.98  # cosine of two signatures that noise hardly separates


def nameable(arm: Arm, screen: Screen, split: Split, pool: Sequence[Candidate]) -> tuple[Nameable, ...]:
    """Detectability of each effect's smallest size in standard deviations, and the effects that look the same."""
    signatures: dict[EffectName, Array] = {}
    detectable: dict[EffectName, float] = {}
    for candidate in pool:
        if not candidate.is_listed:
            continue
        term = _typical(candidate)
        slopes = screen.slopes(term)[split.deciding]
        size = smallest(arm, term.form, term.index)
        norms = np.linalg.norm(slopes, axis=0)
        detectable[candidate.name] = float(norms.max()) * size
        signatures[candidate.name] = slopes / max(float(norms.max()), 1e-300)
    return tuple(Nameable(name, detectable[name], _doubles(name, signatures)) for name in signatures)


def _typical(candidate: Candidate) -> Term:
    """A start in the middle of the search, where the effect is one of many shapes."""
    if candidate.name.effect in ("cogging", "stribeck_friction"):
        return candidate.starts[min(len(candidate.starts) // 4, 6)]
    return candidate.starts[0]


def _doubles(name: EffectName, signatures: dict[EffectName, Array]) -> tuple[EffectName, ...]:
    own = signatures[name]
    if own.shape[1] != 1 or not np.any(own):
        return ()
    unit = own[:, 0] / np.linalg.norm(own[:, 0])
    return tuple(
        other
        for other, slopes in signatures.items()
        if other != name and slopes.shape[1] == 1 and _cosine(unit, slopes[:, 0]) > ALIKE
    )


def _cosine(unit: Array, other: Array) -> float:
    size = float(np.linalg.norm(other))
    return abs(float(unit @ other)) / size if size > 0 else 0.0
