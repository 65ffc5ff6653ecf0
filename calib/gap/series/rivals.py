"""Names that explain nearly the same rows, compared each at the operating point of its own.

What a law does to the rows depends on the laws beside it: cogging follows the motor's angle, which an encoder's error shifts. At
the operating point of one name its rival therefore lacks what the neighbours would make up for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from calib.gap.finding import EffectName
from calib.gap.posterior.constants import FLOOR_DOUBT, MARGIN, NEARLY
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.search import Search, Weighed
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.series.fit import SeriesFit, weighed
from calib.gap.series.linear import SeriesLinear, marginalised
from calib.gap.series.settling import settled
from calib.gap.series.split import Picked, RowSplit

RIVALS_MOST = 3  # that are looked into: each costs a linearisation


def against_rivals(
    fit: SeriesFit, split: RowSplit, linearise: Callable[[OperatingPoint], SeriesLinear]
) -> SeriesFit:
    """The likeliest of a fit and its rivals' own; what leads by too little for a name is ambiguous with its rival."""
    scene = fit.around.scene
    near: list[tuple[EffectName, EffectName]] = []
    tried: set[frozenset[EffectName]] = set()
    for _ in range(RIVALS_MOST):
        open_ = (one for one in rivals(fit) if frozenset(one[:2]) not in tried)
        if (found := next(open_, None)) is None:
            break
        name, rival, members = found
        tried.add(frozenset((name, rival)))
        kept = scene.kept
        around = settled(_with(fit, members), split)
        keys = frozenset(fit.linear.terms[number].key for number, _ in members.members)
        other = weighed(around, linearise(around), fit.noises, split, [keys])
        rows = fit.rows & other.rows
        lead = _log(fit, rows) - _log(other, rows)
        if rival not in other.names or name in other.names or lead >= MARGIN:
            scene.keep(kept)
        elif lead > 0.0:
            near.append((name, rival))
            scene.keep(kept)
        else:
            fit = other
            near += [(rival, name)] if lead > -MARGIN else []
    # of pairs whose name has made room for another rival nothing is left to say
    still = [(name, rival) for name, rival in near if name in fit.decision.names]
    return replace(fit, decision=fit.decision.with_sets(still))


def rivals(fit: SeriesFit) -> Iterator[tuple[EffectName, EffectName, Weighed]]:
    """Each name with another that, in its place, adds nearly what it adds, and the likeliest such set."""
    terms, best = fit.linear.terms, fit.best
    for (number, _), gain in zip(best.members, best.gains, strict=True):
        name = terms[number].key
        if name not in fit.decision.names or not isinstance(name, EffectName):
            continue
        seen: set[EffectName] = set()
        for one in fit.found:
            if one.log < best.log - max(NEARLY * gain, MARGIN):
                break
            own = {terms[k].key for k, _ in one.members}
            new = [key for key in own - fit.names if isinstance(key, EffectName)]
            if name not in own and len(new) == 1 and new[0] not in seen:
                seen.add(new[0])
                yield name, new[0], one


def _with(fit: SeriesFit, members: Weighed) -> SeriesFit:
    return replace(fit, decision=replace(fit.decision, best=members))


def _log(fit: SeriesFit, rows: Picked) -> float:
    """Log posterior of a fit's best set on thin rows, that of another operating point may be compared with."""
    gram = marginalised(fit.linear.gram(fit.noises, rows), fit.linear.first)
    evidence = Evidence(gram, fit.linear.terms, FLOOR_DOUBT)
    return Search(evidence).weigh(fit.best.members).log - 0.5 * gram.left
