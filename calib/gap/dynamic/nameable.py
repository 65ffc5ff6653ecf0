"""What this recording could name at all, before any residual is looked at: detectability and confounders."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.dynamic.catalogue import Candidate
from calib.gap.dynamic.choose import MARGIN
from calib.gap.dynamic.screen import Screen
from calib.gap.dynamic.sizes import NAMEABLE_sd, smallest
from calib.gap.dynamic.split import Split
from calib.gap.dynamic.verdict import GEOMETRIC, SHARE_EXACT
from calib.gap.finding import EffectName, Nameable
from calib.gap.signals.terms import Term
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
    return tuple(
        Nameable(
            name,
            detectable[name],
            (*_confounders(name, signatures), *_waves(name, signatures, detectable[name])),
            needed_sd=NAMEABLE_sd,
        )
        for name in signatures
    )


def _typical(candidate: Candidate) -> Term:
    """A start in the middle of the search, where the effect is one of many shapes."""
    if candidate.name.effect in ("cogging", "stribeck_friction"):
        return candidate.starts[min(len(candidate.starts) // 4, 6)]
    return candidate.starts[0]


def _confounders(name: EffectName, signatures: dict[EffectName, Array]) -> tuple[EffectName, ...]:
    own = signatures[name]
    if own.shape[1] != 1 or not np.any(own):
        return ()
    unit = own[:, 0] / np.linalg.norm(own[:, 0])
    return tuple(
        other
        for other, slopes in signatures.items()
        if other != name and slopes.shape[1] == 1 and _cosine(unit, slopes[:, 0]) > ALIKE
    )


def _waves(
    name: EffectName, signatures: dict[EffectName, Array], detectability: float
) -> tuple[EffectName, ...]:
    """Sines of an angle that pass for an error in proportion to it, where the travel is short; as the verdict tells them."""
    own = signatures[name]
    if name.effect not in GEOMETRIC or own.shape[1] != 1 or not np.any(own):
        return ()
    unit = own[:, 0] / np.linalg.norm(own[:, 0])
    found = []
    for other, slopes in signatures.items():
        if other.effect != "encoder_eccentricity" or slopes.shape[1] != 2:
            continue
        left = unit - slopes @ np.linalg.lstsq(slopes, unit, rcond=None)[0]
        share = float(left @ left)
        if share < SHARE_EXACT or 0.5 * share * detectability**2 < MARGIN:
            found.append(other)
    return tuple(found)


def _cosine(unit: Array, other: Array) -> float:
    size = float(np.linalg.norm(other))
    return abs(float(unit @ other)) / size if size > 0 else 0.0
