"""Which effects the evidence names: every single one and every pair, judged against all its rivals.

A name must beat the geometry alone, and every other explanation, by MARGIN in log evidence; a further name must pay more
than the first. What no explanation beats clearly is given as a set that this data cannot tell apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calib.gap.finding import EffectName
from calib.gap.static.candidates import Candidate
from calib.gap.static.evidence import Evidence
from calib.gap.static.linearised import places

MARGIN = (
    5.0  # odds of 150 to 1; names given with it were right in every case of the study behind gap_notes.md
)
FIRST_COST = 7.0  # log prior odds against an effect: some 16 names are tried
FURTHER_COST = 10.0  # a law of slightly wrong form leaves a remainder that a second name would soak up
SHAPE_DOUBT = 12.0  # in log evidence: shapes of an effect that are worse by more are wrong
KEPT_SINGLES = 24  # the best ones, of which pairs are tried


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
    """Nothing, every single candidate, and pairs of the best of them, best first."""
    at = places(candidates)

    def scored(chosen: tuple[int, ...]) -> Hypothesis:
        cost = (FIRST_COST + (len(chosen) - 1) * FURTHER_COST) if chosen else 0.0
        places_of = [place for k in chosen for place in at[k]]
        if not _is_physical([candidates[k] for k in chosen], evidence, places_of):
            return Hypothesis(chosen, -np.inf)
        return Hypothesis(chosen, evidence.log(places_of) - cost)

    singles = sorted((scored((k,)) for k in range(len(candidates))), key=lambda one: -one.score)
    helpers = _best_of_each_name(singles, candidates)
    pairs = [
        scored((a, b))
        for a, b in combinations(range(len(candidates)), 2)
        if candidates[a].name != candidates[b].name and (a in helpers or b in helpers)
    ]
    return sorted([scored(()), *singles, *pairs], key=lambda one: -one.score)


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


def _is_physical(chosen: Sequence[Candidate], evidence: Evidence, at: Sequence[int]) -> bool:
    """Whether every play and softness comes out positive."""
    positive = [one.is_positive for one in chosen for _ in one.size]
    return not any(positive) or bool(np.all(evidence.estimate(at)[0][positive] > 0.0))


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
