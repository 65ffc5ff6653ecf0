"""What is left without a name: blocks, ambiguous sets, laws that do not hold; and the name that comes nearest."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from calib.arrays import rms
from calib.gap.effects.catalogue import told_apart_by
from calib.gap.finding import EffectName, Nameable, OpenQuestion, Remainder, Unknown
from calib.gap.poses.state import Linearised
from calib.gap.posterior.decide import Decision, left_with, share_of
from calib.gap.posterior.term import Block
from calib.gap.words import listed


def remainders(linearised: Linearised, decision: Decision, reasons: Mapping[EffectName, str]) -> tuple[Remainder, ...]:
    """What is left without one name, the largest first: blocks, sets that are ambiguous, laws that do not hold."""
    best = decision.best
    numbers = {linearised.terms[k].key: k for k, _ in best.members}
    ranked = []
    for group in (*decision.ambiguous, *decision.remainders):
        members = [numbers[key] for key in group if key in numbers]
        if not members:
            continue
        move = linearised.moved_m(best, members)
        size = {"tip_m": rms(move[linearised.looked.parts.known])} if move.any() else {}
        blocks = [linearised.terms[k].words for k in members if not linearised.terms[k].is_name]
        names = " or ".join(str(key) for key in group if isinstance(key, EffectName))
        unnamed = blocks[0] if blocks else "; ".join(why for key, why in reasons.items() if key in group)
        where = names if group in decision.ambiguous else unnamed
        ranked.append(Remainder(where, share_of(linearised.evidence, best, members), size))
    return tuple(sorted(ranked, key=lambda remainder: -remainder.share))


def unknown_part(linearised: Linearised, decision: Decision, reasons: Mapping[EffectName, str]) -> Unknown | None:
    """The remainder without a name that explains most, if there is one."""
    if not decision.remainders:
        return None
    best, terms = decision.best, linearised.terms
    numbers = {terms[k].key: k for k, _ in best.members}
    blocks = [key for group in decision.remainders for key in group if isinstance(key, Block)]
    ranked = sorted(
        (share_of(linearised.evidence, best, [numbers[key]]), terms[numbers[key]].words) for key in blocks if key in numbers
    )
    names = [key for group in decision.remainders for key in group if isinstance(key, EffectName)]
    if ranked:
        where = ranked[-1][1]
    elif blocks:
        where = terms[linearised.evidence.of_key[blocks[0]][0]].words
    else:
        where = reasons[names[0]]
    return Unknown(where, *_nearest(linearised, decision))


def _nearest(linearised: Linearised, decision: Decision) -> tuple[EffectName | None, float]:
    """The effect that is not named and explains most beside the names, and its share of what these leave."""
    evidence, best = linearised.evidence, decision.best
    named = tuple(member for member in best.members if linearised.terms[member[0]].key in decision.names)
    added = evidence.added(named, best.kappa)
    others = [k for k, term in enumerate(linearised.terms) if term.is_name and term.key not in decision.names]
    if not others:
        return None, 0.0
    top = max(others, key=lambda k: float(added.log[k]))
    key = linearised.terms[top].key
    alone, with_it = (
        left_with(evidence, dataclasses.replace(best, members=some)) for some in (named, (*named, (top, int(added.best[top]))))
    )
    excess = alone - left_with(evidence, best)
    share = min(1.0, max(0.0, (alone - with_it) / excess)) if excess > 0.0 else 0.0
    return (key if isinstance(key, EffectName) else None), round(share, 3)


AGAIN = "Look there, and repeat the recording in another order to see whether it comes back."


def next_experiment(
    ambiguous: Sequence[Sequence[EffectName]], unknown: Unknown | None, could: Sequence[Nameable], has_free: bool
) -> str | None:
    """A sentence, or None if nothing is open."""
    if ambiguous:
        return _apart(ambiguous[0])
    if unknown is not None:
        return f"The residual ({unknown.where}) is not in the list of effects. {AGAIN}"
    hidden = [effect for effect in could if not effect.is_nameable]
    if not hidden:
        return None
    names = listed([effect.name for effect in hidden[:4]]) + (" and others" if len(hidden) > 4 else "")
    free = "" if has_free else "a dozen or more free poses away from the table, seen by the camera; "
    wanted = told_apart_by([effect.name.effect for effect in hidden])
    return f"To name {names}, record {free}{'; '.join(wanted[:3])}."


def open_questions(ambiguous: Sequence[Sequence[EffectName]], remainder: Sequence[Remainder]) -> tuple[OpenQuestion, ...]:
    """Each set that is ambiguous, and each remainder, with the recording that would settle it."""
    sets = [OpenQuestion(f"{listed(names)}?", _apart(names)) for names in ambiguous if names]
    known = {" or ".join(map(str, names)) for names in ambiguous}
    left = [OpenQuestion(f"{one.where}: what is it?", AGAIN) for one in remainder if one.where not in known]
    return (*sets, *left)


def _apart(names: Sequence[EffectName]) -> str:
    wanted = told_apart_by([name.effect for name in names])
    return f"To tell {listed(names)} apart, record {'; '.join(wanted)}."
