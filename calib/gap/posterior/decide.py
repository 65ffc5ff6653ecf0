"""From weighed sets to an answer: what is named, what is ambiguous, what stays without a name."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import CERTAIN, CREDIBLE_LEAST, LAW_MOST, MARGIN
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Block, Key


@dataclass(frozen=True, slots=True)
class Decision:
    """Names, ambiguous sets of names, and remainders (the blocks, with the names that could be these instead).

    `probability`: posterior inclusion of every key that occurs; `best`: the best set.
    """

    names: tuple[EffectName, ...]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    remainders: tuple[tuple[Key, ...], ...]
    probability: dict[Key, float]
    best: Weighed

    def with_sets(self, pairs: Collection[tuple[EffectName, EffectName]]) -> Decision:
        """With names that lead a rival by too little: each is ambiguous with its rivals."""
        groups: dict[EffectName, tuple[EffectName, ...]] = {}
        for name, rival in pairs:
            groups[name] = (*groups.get(name, (name,)), rival)
        names = tuple(name for name in self.names if name not in groups)
        return replace(self, names=names, ambiguous=(*self.ambiguous, *groups.values()))


def decide(
    evidence: Evidence,
    found: Sequence[Weighed],
    rivals: Mapping[EffectName, Collection[EffectName]] | None = None,
) -> Decision:
    """Inclusion over all weighed sets: a name above CERTAIN, else the smallest set that is.

    `rivals`: names that an effect of usual size cannot be told from; among them a name needs more, MARGIN.
    """
    logs = np.array([one.log for one in found])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    sets = [frozenset(evidence.terms[k].key for k, _ in one.members) for one in found]
    chance: dict[Key, float] = {}
    for one, weight in zip(found, weights.tolist(), strict=True):
        for key in dict.fromkeys(
            evidence.terms[k].key for k, _ in one.members
        ):  # a set's order differs from run to run
            chance[key] = chance.get(key, 0.0) + weight
    groups = []
    for group in _credible(sets, weights, chance):
        if len(group) == 1 and isinstance(group[0], EffectName):
            group = (*group, *_near(sets, logs, group[0], (rivals or {}).get(group[0], ())))
        groups.append((*group, *crooked(evidence, found[0], group[0])) if len(group) == 1 else group)
    names = tuple(g[0] for g in groups if len(g) == 1 and isinstance(g[0], EffectName))
    ambiguous = tuple(
        tuple(key for key in g if isinstance(key, EffectName))
        for g in groups
        if len(g) > 1 and not any(isinstance(key, Block) for key in g)
    )
    left = tuple(g for g in groups if any(isinstance(key, Block) for key in g))
    return Decision(names, ambiguous, left, chance, found[0])


def _credible(
    sets: Sequence[frozenset[Key]], weights: np.ndarray, chance: dict[Key, float]
) -> list[tuple[Key, ...]]:
    """Smallest groups of keys of which at least one is in with CERTAIN probability, each in the place of the others."""
    done: set[Key] = set()
    groups: list[tuple[Key, ...]] = []
    for key in sorted(chance, key=lambda one: -chance[one]):
        if key in done:
            continue
        group, has = [key], np.array([key in keys for keys in sets])
        while weights[has].sum() < CERTAIN:
            gains = {
                k: _in_place_of(np.array([k in keys for keys in sets]), has, weights)
                for k in chance
                if k not in done
            }
            best = max(gains, key=lambda k: gains[k], default=None)
            if best is None or gains[best] < CREDIBLE_LEAST:
                break
            group.append(best)
            has |= np.array([best in keys for keys in sets])
        if weights[has].sum() >= CERTAIN:
            groups.append(tuple(group))
            done |= set(group)
    return groups


def _in_place_of(own: Mask, has: Mask, weights: Array) -> float:
    """Probability that a key is there without a group (s,), beyond that of both: what acts beside the group is no other of it."""
    return float(weights[own & ~has].sum() - weights[own & has].sum())


def _near(
    sets: Sequence[frozenset[Key]], logs: Array, name: EffectName, rivals: Collection[EffectName]
) -> tuple[EffectName, ...]:
    """Rivals that a set without the name, nearly as likely as the best, has in its place: what the best has beside it is none."""
    likely = [
        keys for keys, log in zip(sets, logs, strict=True) if name not in keys and log > logs[0] - MARGIN
    ]
    beside = sets[0] if name in sets[0] else ()
    return tuple(other for other in rivals if other not in beside and any(other in keys for keys in likely))


def _is_own(evidence: Evidence, name: EffectName, block: Block) -> bool:
    """Whether a block is of an effect's joint and a function of its law's variable."""
    own = evidence.terms[evidence.of_key[name][0]].traits.blocks
    return bool(own) and block.joint == name.acts_on and block.variable.startswith(own.format(j=name.joint))


def crooked(evidence: Evidence, best: Weighed, key: Key) -> tuple[Block, ...]:
    """Blocks that bend an effect's law, in its own variable, more than any real part does: then it is another law.

    Twice the largest departure is two standard deviations of it.
    """
    if not isinstance(key, EffectName):
        return ()
    moves = _moves(evidence, best)
    law = moves.get(key, 0.0)
    return tuple(
        block
        for block, move in moves.items()
        if isinstance(block, Block) and _is_own(evidence, key, block) and move > LAW_MOST * law
    )


def _moves(evidence: Evidence, best: Weighed) -> dict[Key, float]:
    """How far each member of a set moves its joints, root mean square."""
    size, _ = evidence.estimate(best.members, best.kappa)
    found: dict[Key, float] = {}
    first = 0
    for number, _ in best.members:
        one = evidence.terms[number]
        own = size[first : first + one.count]
        first += one.count
        if one.slope_rad is not None:
            found[one.key] = float(np.sqrt(np.mean(np.einsum("c,cmn->mn", own, one.slope_rad) ** 2)))
    return found


def share_of(evidence: Evidence, found: Weighed, drop: Sequence[int]) -> float:
    """Share of the excess of the tips over what the set leaves that the terms `drop` explain."""
    excess = evidence.gram.left - left_with(evidence, found)
    return explained_by(evidence, found, drop) / excess if excess > 0.0 else math.nan


def explained_by(evidence: Evidence, found: Weighed, drop: Sequence[int]) -> float:
    """The sum of squares, in variances of the floor, that the set leaves more without the terms `drop`."""
    rest = Weighed(tuple(one for one in found.members if one[0] not in drop), found.kappa, 0.0)
    return left_with(evidence, rest) - left_with(evidence, found)


def left_with(evidence: Evidence, found: Weighed) -> float:
    """The tips' sum of squares that a set leaves, in variances of the floor."""
    if not found.members:
        return evidence.gram.left
    at = np.concatenate([evidence.places[k] for k, _ in found.members])
    size, _ = evidence.estimate(found.members, found.kappa)
    gram = evidence.gram
    return float(gram.left - 2.0 * size @ gram.pull[at] + size @ gram.tip[np.ix_(at, at)] @ size)
