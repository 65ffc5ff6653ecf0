"""Which effects the evidence names: every single one, every pair, and more where pairs leave much, judged against all rivals.

A name must beat the geometry alone, and every other explanation, by MARGIN in log evidence; a further name must pay more
than the first. What no explanation beats clearly is given as a set that this data cannot tell apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.evidence import Evidence, tail
from calib.gap.static.linearised import places

MARGIN = 5.0  # odds of 150 to 1; names given with it were right in every case of the study behind docs/gap_scores.md
FIRST_COST = 7.0  # log prior odds against an effect: some 16 names are tried
FURTHER_COST = 10.0  # a law of slightly wrong form leaves a remainder that a second name would soak up
SHAPE_DOUBT = 12.0  # in log evidence: shapes of an effect that are worse by more are wrong
STRICTER = 3.0  # what every name after the second costs beyond the one before it
KEPT_SINGLES = 24  # the best ones, of which pairs are tried
KEPT_SETS = 12  # the best pairs, triples, ..., to which one more effect is added
NAMES_MOST = 4
MASSES_MOST = 1  # any two masses, of the links or at the tip, look like a third


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A set of candidates (indices), and its log evidence with the cost of its names."""

    chosen: tuple[int, ...]
    score: float


@dataclass(frozen=True, slots=True)
class Decision:
    """The best hypothesis, what of it is beyond doubt, and sets of rivals among which this data cannot decide.

    `leader`: the effect that explains most by itself, of those in the best hypothesis.
    """

    best: Hypothesis
    accepted: tuple[int, ...]
    ambiguous: tuple[tuple[EffectName, ...], ...]
    margin: float
    leader: EffectName | None

    def without(self, names: set[EffectName], candidates: Sequence[Candidate]) -> Decision:
        """The same when these names have turned out to be none."""
        left = [
            [k for k in some if candidates[k].name not in names] for some in (self.best.chosen, self.accepted)
        ]
        open_sets = [tuple(name for name in one if name not in names) for one in self.ambiguous]
        return dataclasses.replace(
            self,
            best=Hypothesis(tuple(left[0]), self.best.score),
            accepted=tuple(left[1]),
            ambiguous=tuple(one for one in open_sets if len(one) > 1),
        )


def decide(evidence: Evidence, candidates: Sequence[Candidate]) -> Decision:
    """Weigh everything."""
    ranked = hypotheses(evidence, candidates)
    best = ranked[0]
    names = {candidates[k].name for k in best.chosen}
    rivals = [
        one for one in ranked[1:] if not names < _names(one, candidates) and _names(one, candidates) != names
    ]
    near = [one for one in rivals if one.score > best.score - MARGIN]
    sure = [k for k in best.chosen if all(candidates[k].name in _names(one, candidates) for one in near)]
    margin = best.score - rivals[0].score if rivals else float("inf")
    single = [one.chosen[0] for one in ranked if len(one.chosen) == 1 and one.chosen[0] in best.chosen]
    leader = candidates[single[0]].name if single else None
    return Decision(best, tuple(sure), _ambiguous(best, near, sure, candidates), margin, leader)


def hypotheses(evidence: Evidence, candidates: Sequence[Candidate]) -> list[Hypothesis]:
    """Nothing, every single candidate, pairs of the best of them, and the best sets with one effect more, best first."""
    tails = _tails(evidence, candidates)
    singles = sorted(
        _scored(evidence, candidates, [(k,) for k in range(len(candidates))], tails),
        key=lambda one: -one.score,
    )
    helpers = _best_of_each_name(singles, candidates)
    pairs = [
        (a, b)
        for a, b in combinations(range(len(candidates)), 2)
        if candidates[a].name != candidates[b].name and (a in helpers or b in helpers)
    ]
    both = _scored(evidence, candidates, pairs, tails)
    found = sorted([Hypothesis((), 0.0), *singles, *both], key=lambda one: -one.score)
    for count in range(2, NAMES_MOST):
        if len(found[0].chosen) < count:
            break
        grown = _scored(evidence, candidates, sorted(_one_more(found, candidates, count)), tails)
        found = sorted([*found, *grown], key=lambda one: -one.score)
    return found


def _scored(
    evidence: Evidence,
    candidates: Sequence[Candidate],
    sets: Sequence[tuple[int, ...]],
    tails: Sequence[float],
) -> list[Hypothesis]:
    """Each set with its log evidence and the cost of its names; out of the question where it is not physical.

    What the tails of the prior give back to a large effect is no more than it would have alone where another acts on its joint:
    large effects that cancel each other are as unlikely as the Gaussian says.
    """
    at = places(candidates)
    logs, values = evidence.log_each([[place for k in chosen for place in at[k]] for chosen in sets])
    found = []
    for chosen, log, value in zip(sets, logs, values, strict=True):
        if not _is_physical(candidates, chosen, value):
            found.append(Hypothesis(chosen, -np.inf))
            continue
        ends = np.cumsum([len(at[k]) for k in chosen])
        parts = np.split(value, ends[:-1]) if len(chosen) else []
        joints = [candidates[k].name.joint for k in chosen]
        most = [
            tails[k] if joints.count(joint) > 1 else np.inf for k, joint in zip(chosen, joints, strict=True)
        ]
        back = sum(min(tail(part), limit) for part, limit in zip(parts, most, strict=True))
        found.append(Hypothesis(chosen, float(log) + back - cost_of(len(chosen))))
    return found


def _tails(evidence: Evidence, candidates: Sequence[Candidate]) -> list[float]:
    """What each candidate alone would be given back."""
    _, values = evidence.log_each(places(candidates))
    return [tail(value) for value in values]


def cost_of(count: int) -> float:
    """Log prior odds against this many names."""
    later = sum(STRICTER * k for k in range(1, count - 1))
    return FIRST_COST * (count > 0) + FURTHER_COST * max(0, count - 1) + later


def _one_more(
    found: Sequence[Hypothesis], candidates: Sequence[Candidate], count: int
) -> set[tuple[int, ...]]:
    """The best sets of `count`, each with every candidate whose effect it does not have."""
    best = [one for one in found if len(one.chosen) == count][:KEPT_SETS]
    return {
        tuple(sorted((*one.chosen, k)))
        for one in best
        for k in range(len(candidates))
        if candidates[k].name not in _names(one, candidates)
    }


def with_doubt(evidence: Evidence, candidates: Sequence[Candidate], best: Hypothesis, k: int) -> Candidate:
    """Candidate k of the best hypothesis, unsure also where another shape of it, nearly as good, says something else."""
    own, at = candidates[k], places(candidates)
    if own.unsure is None:
        return own
    beside = [place for other in best.chosen if other != k for place in at[other]]
    least = evidence.log([*beside, *at[k]]) - SHAPE_DOUBT
    doubt = own.unsure.copy()
    for other, same in enumerate(candidates):
        if same.name == own.name and evidence.log([*beside, *at[other]]) > least:
            doubt |= (same.slope_rad != own.slope_rad).any(axis=(0, 2))
    return dataclasses.replace(own, unsure=doubt)


def _is_physical(candidates: Sequence[Candidate], chosen: Sequence[int], value: Array) -> bool:
    """Whether every play and softness comes out positive, and no more loads are named than can be."""
    some, first = [candidates[k] for k in chosen], 0
    if len(some) > MASSES_MOST and sum(one.is_mass for one in some) > MASSES_MOST:
        return False
    for one in some:
        if one.is_positive and not one.physical(value[first : first + len(one.size)] * one.size):
            return False
        first += len(one.size)
    return True


def _best_of_each_name(singles: Sequence[Hypothesis], candidates: Sequence[Candidate]) -> set[int]:
    """The best shape of every effect."""
    found: dict[EffectName, int] = {}
    for one in singles:
        found.setdefault(candidates[one.chosen[0]].name, one.chosen[0])
    return set(list(found.values())[:KEPT_SINGLES])


def _names(one: Hypothesis, candidates: Sequence[Candidate]) -> set[EffectName]:
    return {candidates[k].name for k in one.chosen}


def _ambiguous(
    best: Hypothesis, near: Sequence[Hypothesis], sure: Sequence[int], candidates: Sequence[Candidate]
) -> tuple[tuple[EffectName, ...], ...]:
    """The names that compete for what is not sure; none if nothing at all would do as well."""
    open_names = [candidates[k].name for k in best.chosen if k not in sure]
    if not open_names:
        return ()
    certain = {candidates[k].name for k in sure}
    rivals = [name for one in near for name in sorted(_names(one, candidates) - certain, key=str)]
    together = tuple(dict.fromkeys([*open_names, *rivals]))
    return (together,) if len(together) > 1 else ()
