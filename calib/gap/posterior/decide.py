"""From weighed sets to an answer: names, ambiguous sets and what has no name; parameters; what these data could name at all.

With w_S = P(S | y) over all sets that were weighed, the inclusion of a key is the sum of w_S over the sets S that hold it. A
name is given where that exceeds CERTAIN; else the smallest group of keys, each in the place of the others, of which at least
one is in with that probability: a set of "one of these", or, where a block is among them, something without a name. Values are
averages over the variants and scales v of a key beside all others at their best,
  mean = sum w_v mean_v,   covariance = sum w_v (covariance_v + (mean_v - mean)(mean_v - mean)'),
in the law's own coefficients (c,), so that an interval counts departures that the data do not show.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri, ndtr

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName, Nameable, Parameters
from calib.gap.posterior.constants import (
    CERTAIN,
    CREDIBLE_LEAST,
    LAW_MOST,
    MARGIN,
    NAME_PRIOR,
    ROUGH,
    SIZE_COST,
    SIZE_LEVELS,
    CHECKED_sd,
    MOSTLY_sd,
    SURE_sd,
)
from calib.gap.posterior.evidence import Evidence, Places, Weighed
from calib.gap.posterior.term import Block, Key, Term


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


def decide(evidence: Evidence, sets: Sequence[Weighed]) -> Decision:
    """Names that lead every other in their place by MARGIN in log evidence; the others are ambiguous with it."""
    decision = included(evidence, sets)
    pairs = [(name, rival) for name in decision.names for rival, _ in rivals(evidence, sets, name, MARGIN)]
    return decision.with_sets(pairs)


def included(evidence: Evidence, sets: Sequence[Weighed]) -> Decision:
    """Inclusion over all weighed sets, best first: a name above CERTAIN, else the smallest set that is."""
    logs = np.array([weighed.log for weighed in sets])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    keys = [_keys(evidence, weighed) for weighed in sets]
    has = {key: np.zeros(len(sets), dtype=bool) for key in dict.fromkeys(itertools.chain(*keys))}
    for k, (weighed, present) in enumerate(zip(sets, keys, strict=True)):
        for key in (*present, *_as_laws(evidence, weighed, set(keys[0]) - set(present))):
            has[key][k] = True
    chance = {key: sum(weights[mask].tolist()) for key, mask in has.items()}
    groups = _credible(has, weights, chance)
    groups = [(*group, *crooked(evidence, sets[0], group[0])) if len(group) == 1 else group for group in groups]
    remainders = tuple(group for group in groups if any(isinstance(key, Block) for key in group))
    named = [tuple(key for key in g if isinstance(key, EffectName)) for g in groups if g not in remainders]
    names, ambiguous = (tuple(group[0] for group in named if len(group) == 1), tuple(group for group in named if len(group) > 1))
    return Decision(names, ambiguous, remainders, chance, sets[0])


def rivals(evidence: Evidence, sets: Sequence[Weighed], name: EffectName, reach: float) -> Iterator[tuple[EffectName, Weighed]]:
    """Names that stand in the place of one in sets, best first, which lie less than `reach` behind the best in log evidence, each
    with the likeliest such set. What the best set has beside the name is none of them.
    """
    best = _keys(evidence, sets[0])
    seen = set(best) if name in best else set()
    for weighed in itertools.takewhile(lambda weighed: weighed.log > sets[0].log - reach, sets):
        keys = _keys(evidence, weighed)
        if name in keys or (name in best and name in _as_laws(evidence, weighed, [name])):
            continue
        for rival in keys:
            if isinstance(rival, EffectName) and rival not in seen:
                seen.add(rival)
                yield rival, weighed


def _keys(evidence: Evidence, weighed: Weighed) -> list[Key]:
    return [evidence.terms[number].key for number, _ in weighed.members]


def _credible(has: Mapping[Key, Mask], weights: Array, chance: Mapping[Key, float]) -> list[tuple[Key, ...]]:
    """Smallest groups of keys of which at least one is in with CERTAIN probability, each in the place of the others.

    `has`: the sets (s,) with each key. What a key adds to a group is the probability that it is there without it, less that of
    both: what acts beside the group is no other of it.
    """
    done: set[Key] = set()
    groups: list[tuple[Key, ...]] = []
    for key in sorted(chance, key=lambda one: -chance[one]):
        if key in done:
            continue
        group, one_in = [key], has[key].copy()
        while weights[one_in].sum() < CERTAIN:
            gains = {
                rival: float(weights[mask & ~one_in].sum() - weights[mask & one_in].sum())
                for rival, mask in has.items()
                if rival not in done
            }
            best = max(gains, key=lambda rival: gains[rival], default=None)
            if best is None or gains[best] < CREDIBLE_LEAST:
                break
            group.append(best)
            one_in |= has[best]
        if weights[one_in].sum() >= CERTAIN:
            groups.append(tuple(group))
            done |= set(group)
    return groups


def crooked(evidence: Evidence, best: Weighed, key: Key) -> tuple[Block, ...]:
    """Blocks that bend an effect's law, in its own variable, more than any real part does: then it is another law.

    They are of its joint and functions of its law's variable. Twice the largest departure is two standard deviations of it.
    """
    variable = evidence.terms[evidence.of_key[key][0]].traits.blocks
    if not isinstance(key, EffectName) or not variable:
        return ()
    moves, begin = _moves(evidence, best), variable.format(j=key.joint)
    least = LAW_MOST * moves.get(key, 0.0)
    return tuple(
        block
        for block, move in moves.items()
        if isinstance(block, Block) and block.joint == key.acts_on and block.variable.startswith(begin) and move > least
    )


def _as_laws(evidence: Evidence, weighed: Weighed, names: Collection[Key]) -> Iterator[EffectName]:
    """Names for which a block of a set stands: a function of the law's own variable that bends it no more than real parts do.

    Such a block is that law, as it departs: without this the two divide the probability of one thing.
    """
    for number, size in evidence.sizes(weighed).items() if names else ():
        block = evidence.terms[number]
        if not isinstance(block.key, Block) or block.slope_rad is None:
            continue
        moved = np.einsum("c,cmn->mn", size, block.slope_rad).ravel()
        for name in names:
            law = evidence.terms[evidence.of_key[name][0]]
            if not isinstance(name, EffectName) or law.slope_rad is None or not law.traits.blocks:
                continue
            begin = law.traits.blocks.format(j=name.joint)
            if block.key.joint != name.acts_on or not block.key.variable.startswith(begin):
                continue
            columns = law.slope_rad[: law.laws].reshape(law.laws, -1).T
            share = np.linalg.lstsq(columns, moved, rcond=None)[0]
            as_law = columns @ share
            is_there = not law.is_positive or share[0] > 0.0
            if is_there and np.linalg.norm(moved - as_law) <= LAW_MOST * np.linalg.norm(as_law):
                yield name


def _moves(evidence: Evidence, best: Weighed) -> dict[Key, float]:
    """How far each member of a set moves its joints, root mean square."""
    moves: dict[Key, float] = {}
    for number, size in evidence.sizes(best).items():
        term = evidence.terms[number]
        if term.slope_rad is not None:
            moves[term.key] = float(np.sqrt(np.mean(np.einsum("c,cmn->mn", size, term.slope_rad) ** 2)))
    return moves


def share_of(evidence: Evidence, weighed: Weighed, drop: Sequence[int]) -> float:
    """Share of the excess of the tips over what the set leaves, in sums of squares, that the terms `drop` explain."""
    whole = left_with(evidence, weighed)
    rest = Weighed(tuple(one for one in weighed.members if one[0] not in drop), weighed.kappa, 0.0)
    excess = evidence.gram.left - whole
    return (left_with(evidence, rest) - whole) / excess if excess > 0.0 else math.nan


def left_with(evidence: Evidence, weighed: Weighed) -> float:
    """The tips' sum of squares that a set leaves, in variances of the floor."""
    if not weighed.members:
        return evidence.gram.left
    at = np.concatenate([evidence.places[k] for k, _ in weighed.members])
    size, _ = evidence.estimate(weighed.members, weighed.kappa)
    gram = evidence.gram
    return float(gram.left - 2.0 * size @ gram.pull[at] + size @ gram.tip[np.ix_(at, at)] @ size)


@dataclass(frozen=True, slots=True)
class Estimated:
    """An effect of the set: parameters with sd, and how far it departs from its law, as a share, in which variable.

    `variants`: numbers of the terms that may be it, and their posterior weights.
    """

    parameters: Parameters
    departure: float
    variable: str
    value: Array
    covariance: Array
    variants: tuple[tuple[int, float], ...]

    @property
    def sd(self) -> Array:
        """Standard deviations of `value`, (c,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def differs_from(self, reference: Array) -> bool:
        """Whether the coefficients differ from others (c,) by what one of them alone would at SURE_sd."""
        return sureness(self.value - reference, self.covariance, SURE_sd) > 1.0


def sureness(apart: Array, covariance: Array, least_sd: float) -> float:
    """How far coefficients (c,) are from nothing, whatever their axes, over what one of them alone is at `least_sd`."""
    least = chdtri(len(apart), 2.0 * ndtr(-least_sd))  # of chi-square
    return math.sqrt(max(0.0, float(apart @ np.linalg.solve(covariance, apart))) / float(least))


def sureness_of_file(file: Array, posterior: Array, covariance: Array) -> float:
    """How sure an effect is that a file has with coefficients (c,), over how sure it has to be: below 1, it may be none.

    The posterior has others, beside all that has no name; the file's laws take its part. Nothing says which of the two is right,
    so the interval around the file's reaches as far as the posterior's, on that side: where the posterior has more, nothing
    speaks for none.
    """
    reach = (posterior - file) / CHECKED_sd
    is_towards_none = float(reach @ np.linalg.solve(covariance, file)) < 0.0
    return sureness(file, covariance + is_towards_none * np.outer(reach, reach), CHECKED_sd)


def estimated(evidence: Evidence, weighed: Weighed, key: Key) -> Estimated:
    """Averaged over the variants and sizes of the effect, all others at their best."""
    rest = [one for one in weighed.members if evidence.terms[one[0]].key != key]
    means, covariances, weights, departs, terms, numbers = [], [], [], [], [], []
    for number, scale, log in _ways(evidence, weighed, rest, key):
        term = evidence.terms[number]
        size, covariance = evidence.estimate([*rest, (number, scale)], weighed.kappa)
        laws = slice(len(size) - term.count, len(size) - term.count + term.laws)
        means.append(size[laws] * term.size)
        covariances.append(covariance[laws, laws] * term.size**2)
        departs.append(_departure(term, size[len(size) - term.count :]))
        weights.append(np.exp(log))
        terms.append(term)
        numbers.append(number)
    share = np.array(weights) / np.sum(weights)
    mean = np.einsum("v,vc->c", share, np.array(means))
    apart = np.array(means) - mean
    covariance = np.einsum("v,vcd->cd", share, np.array(covariances)) + np.einsum("v,vc,vd->cd", share, apart, apart)
    best = terms[int(np.argmax(share))]
    made = best.parameters if best.between is None else best.between(*_likeliest(evidence, weighed, rest, key))
    named = made(mean, covariance) if made is not None else {}
    summed = dict.fromkeys(numbers, 0.0)
    for number, weight in zip(numbers, share.tolist(), strict=True):
        summed[number] += weight
    departs_by = float(share @ np.array(departs))
    return Estimated(named, departs_by, best.variable, mean, covariance, tuple(summed.items()))


def _ways(evidence: Evidence, weighed: Weighed, rest: list[tuple[int, int]], key: Key) -> list[tuple[int, int, float]]:
    """Variants and sizes that count, with their log evidence; those of exact laws left out, where a law may depart.

    No real part keeps its law: an interval holds only if it counts the departures that the data do not show.
    """
    ways = [
        (number, scale, evidence.value([*rest, (number, scale)], weighed.kappa))
        for number in evidence.of_key[key]
        for scale in range(len(evidence.weights[number]))
        if not is_exact(evidence, number, scale)
    ]
    top = max(log for _, _, log in ways)
    return [(number, scale, log - top) for number, scale, log in ways if log > top - MARGIN]


def _likeliest(evidence: Evidence, weighed: Weighed, rest: Sequence[tuple[int, int]], key: Key) -> tuple[float, float]:
    """The likeliest variant between those that were tried, and the standard deviation of its logarithm: of the parabola of log
    evidence through the best one and its neighbours. At an end of what was tried it is that end, however sure.
    """
    numbers = sorted(evidence.of_key[key], key=lambda number: evidence.terms[number].variant)
    logs = np.array(
        [
            np.logaddexp.reduce(
                [evidence.value([*rest, (number, scale)], weighed.kappa) for scale in range(len(evidence.weights[number]))]
            )
            for number in numbers
        ]
    )
    k, variants = int(np.argmax(logs)), [evidence.terms[number].variant for number in numbers]
    if not 0 < k < len(numbers) - 1:
        return variants[k], math.nan
    before, top, after = logs[k - 1 : k + 2].tolist()
    step, bend = 0.5 * math.log(variants[k + 1] / variants[k - 1]), 2.0 * top - before - after
    return variants[k] * math.exp(0.5 * (after - before) / bend * step), step / math.sqrt(bend)


def is_exact(evidence: Evidence, number: int, scale: int) -> bool:
    """Whether a size leaves a law that may depart as the textbook has it."""
    term = evidence.terms[number]
    departs = evidence.scales[number][0][scale][term.laws : term.laws + term.departures]
    return term.departures > 0 and not departs.any()


def _departure(term: Term, size: Array) -> float:
    """How far what an effect does is from every multiple of its law, over what it does; root mean squares.

    What a departure has of the law makes the effect another size, and its mean is another zero of the joint.
    """
    slope = next((one for one in (term.slope_rad, term.slope_m, term.slope_Nm) if one is not None), None)
    if slope is None or not term.departures:
        return 0.0
    columns = slope[: term.laws + term.departures]
    about = columns - columns.mean(axis=1, keepdims=True) if slope is term.slope_rad else columns
    flat = about.reshape(len(columns), -1).T
    law, whole = flat[:, : term.laws], flat @ size[: len(columns)]
    rest = whole - law @ np.linalg.lstsq(law, whole, rcond=None)[0]
    done = float(np.linalg.norm(np.tensordot(size[: len(columns)], columns, 1)))
    return float(np.linalg.norm(rest)) / done if done > 0.0 else 0.0


# What this data could name at all: how far an effect of usual size would stand out beside the geometry, and beside each rival.
#
# A rival may depart from its law as real parts do, so that it passes for more than its textbook form would.
ODDS = math.log(CERTAIN / (1.0 - CERTAIN))
# Standard deviations at which the expected log evidence, half their square, pays a name, and its margin over a rival:
NAMEABLE_sd = math.sqrt(2.0 * (ODDS - math.log(NAME_PRIOR) + SIZE_COST)) + MOSTLY_sd
TOLD_APART_sd = math.sqrt(2.0 * ODDS) + MOSTLY_sd
RIVAL_LEVEL = SIZE_LEVELS[2]  # a large one


def nameable(evidence: Evidence) -> tuple[Nameable, ...]:
    """Every effect of the list, the middle one of its variants, with those that it cannot be told from."""
    gram = evidence.gram
    names = {key: numbers[len(numbers) // 2] for key, numbers in evidence.of_key.items() if isinstance(key, EffectName)}
    columns = [evidence.places[k][: evidence.terms[k].laws] for k in names.values()]
    every, ends = np.concatenate([*columns, []]).astype(int), np.cumsum([len(own) for own in columns])
    places = {key: slice(end - len(own), end) for key, own, end in zip(names, columns, ends, strict=True)}
    alone = gram.tip[every, every] + (0.0 if gram.current is None else gram.current[every, every])
    beside = {rival: alone - _taken(evidence, every, k) for rival, k in names.items()}
    effects = []
    for key, at in places.items():
        seen_sd = _detectability(alone[at])
        rivals = [
            rival
            for rival, left in beside.items()
            if rival != key and seen_sd >= TOLD_APART_sd and _detectability(left[at]) < TOLD_APART_sd
        ]
        effects.append(Nameable(key, round(seen_sd, 2), tuple(rivals), needed_sd=NAMEABLE_sd))
    return tuple(effects)


def _taken(evidence: Evidence, columns: Places, rival: int) -> Array:
    """What a rival takes at most of G's diagonal at `columns`: all that the root mean square of what is left needs."""
    at, term = evidence.places[rival], evidence.terms[rival]
    sd = np.full(len(at), RIVAL_LEVEL)
    sd[term.laws : term.laws + term.departures] *= ROUGH
    return np.asarray(np.sum(evidence.taken(at, sd, columns, 1.0)[:, :-1] ** 2, axis=0))


def _detectability(seen: Array) -> float:
    """Root mean square over the coefficients' directions, each of usual size, in standard deviations."""
    return math.sqrt(max(0.0, float(np.mean(seen))))
