"""Looks: linearise around what was found, weigh sets of effects, and look again until the answer stays."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import DEPARTURES, FLOOR_DOUBT, LAW_MOST, SIZE_LEVELS
from calib.gap.posterior.decide import Decision, decide
from calib.gap.posterior.evidence import Evidence
from calib.gap.posterior.gram import Gram
from calib.gap.posterior.merging import MergingSearch
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Key
from calib.gap.series.always import always
from calib.gap.series.around import Around
from calib.gap.series.blocks import blocks_of
from calib.gap.series.constants import ALWAYS_MOST, UNTOLD
from calib.gap.series.departures import GEARS
from calib.gap.series.effects import terms_of
from calib.gap.series.linear import Linear, foretold, noises_of, without_first
from calib.gap.series.scene import Scene
from calib.gap.series.split import Picked, Split
from calib.gap.series.term import SeriesTerm
from calib.gap.series.whitening import Noise
from calib.gap.signals.terms import STEP, bounded
from calib.gap.signals.terms import Term as Law
from control.progress import Advance

LOOKS = 3  # linearisations, at most
SETTLINGS = 5  # refits of laws that bend
SETTLED = 0.01  # of a value
BARRED_MOST = 4  # searches, each without the laws that the one before bent too far


@dataclass(frozen=True, slots=True)
class Look:
    """One linearisation, the noise around it, and what was decided; `gram` with what is always there, on the rows."""

    around: Around
    linear: Linear
    noises: tuple[Noise, ...]
    gram: Gram
    evidence: Evidence
    decision: Decision
    rows: Picked

    @property
    def best(self) -> Weighed:
        """The set of largest posterior."""
        return self.decision.best

    @property
    def numbers(self) -> list[int]:
        """Terms of the best set."""
        return [number for number, _ in self.best.members]

    def laws(self, names: Collection[Key] | None = None) -> dict[Key, Law]:
        """The physics' terms of the best set's effects, at its estimates."""
        size, _ = self.evidence.estimate(self.best.members, self.best.kappa)
        found, first = {}, 0
        for number in self.numbers:
            one = self.linear.terms[number]
            if one.law is not None and (names is None or one.key in names):
                found[one.key] = _bounded(one.law(size[first : first + one.count]))
            first += one.count
        return found


def looked(
    scene: Scene, known: Sequence[Law], split: Split, names: Collection[str] | None, advance: Advance
) -> Look:
    """The last look."""
    around = Around.of(scene, known, {})
    starts: list[frozenset[Key]] = []
    noises = [Noise.white(len(scene.recording.runs)) for _ in scene.cells]
    first: list[SeriesTerm] = []
    blocks = list(blocks_of(around))
    for count in range(LOOKS):
        advance("what every effect would do", 0.1 + 0.28 * count)
        terms = [*terms_of(around, names, first), *blocks]
        first = first or terms
        linear = Linear.around(around, terms, tuple(always(around, terms)))
        advance("weighing effects", 0.2 + 0.28 * count)
        look = _weighed(around, linear, noises, split, starts)
        if count or look.best.kappa > UNTOLD:
            noises = list(measured(look, split))
            look = _weighed(around, linear, noises, split, starts)
        noises = list(measured(look, split))
        keys = frozenset(linear.terms[number].key for number in look.numbers)
        laws = look.laws()
        if not laws or (count and starts[:1] == [keys]) or count == LOOKS - 1:
            return look
        starts = [keys, frozenset(key for key in keys if isinstance(key, EffectName))]
        advance("settling what bends", 0.36 + 0.28 * count)
        kept = scene.kept
        after = settled(look, split)
        if _remains(after, look) > _remains(around, look):  # no better place to look from
            scene.keep(kept)
            return look
        around = after
    return look


def _remains(around: Around, look: Look) -> float:
    """What a model leaves of the rows that decide, each cell by its noise; blocks are in no model."""
    thin = zip(around.scene.thinned, around.scene.cells, strict=True)
    left = np.concatenate([one.of(around.residual[cell.rows]) for one, cell in thin])
    white = look.linear.whitened(left[:, None], look.noises)[look.rows]
    return float(np.sum(white**2))


def _bounded(law: Law) -> Law:
    """Where the effect means something."""
    return law.at(tuple(bounded(law, np.array(law.values)).tolist()))


def settled(look: Look, split: Split) -> Around:
    """Around the best set, its laws' values refitted until those that the rows follow in no straight line stay."""
    scene, known, laws = look.around.scene, look.around.known, look.laws()
    blocks = [look.linear.terms[k] for k in look.numbers if look.linear.terms[k].law is None]
    for turn in range(SETTLINGS):
        model = (*known, *laws.values())
        scene.keep(scene.rows.resting(model))
        around = Around.of(scene, known, laws)
        if turn == SETTLINGS - 1 or not any(law.form in STEP for law in laws.values()):
            break
        terms = [one for one in terms_of(around, keys=laws.keys()) if one.now is not None]
        linear = Linear.around(around, [*terms, *blocks])
        gram = linear.gram(look.noises, scene.picked(split.deciding & scene.kept))
        sd = np.concatenate([_usual(one) for one in linear.terms])
        inner = np.eye(len(sd)) + sd[:, None] * gram.tip * sd
        covariance = sd[:, None] * np.linalg.inv(inner) * sd
        size, first = covariance @ gram.pull, 0
        moved, largest = dict(laws), 0.0
        for one in terms:
            place = slice(first, first + one.count)
            own = size[place]
            first += one.count
            if one.law is None or not isinstance(one.key, EffectName):
                continue
            if one.curve is not None:
                own, _ = one.curve.held(own, covariance[place, place])
            if one.is_positive and own[0] <= 0.0:
                continue
            moved[one.key] = _bounded(one.law(own))
            if laws[one.key].form in STEP:
                counted = (
                    1 if one.key.effect in GEARS else 2
                )  # damping and a friction's share are never known well
                pairs = zip(moved[one.key].values[:counted], laws[one.key].values, strict=False)
                largest = max(largest, *(abs(new / now - 1.0) if now else 0.0 for new, now in pairs))
        laws = moved
        if largest < SETTLED:
            return Around.of(scene, known, laws)
    return around


def _usual(one: SeriesTerm) -> Array:
    """Standard deviations of a term that is surely there: of a large size and of the usual roughness."""
    scales, _ = one.scales()
    return (
        np.asarray(scales[-1])
        if not one.is_name
        else np.concatenate(
            [
                np.full(one.laws, SIZE_LEVELS[-1]),
                np.full(one.departures, DEPARTURES[2]),
                np.ones(one.count - one.laws - one.departures),
            ]
        )
    )


def _weighed(
    around: Around, linear: Linear, noises: Sequence[Noise], split: Split, starts: Sequence[frozenset[Key]]
) -> Look:
    rows = around.scene.picked(split.deciding & around.scene.kept)
    gram = linear.gram(noises, rows)
    evidence = Evidence(without_first(gram, linear.first), linear.terms, FLOOR_DOUBT)
    barred: set[Key] = set()
    for _ in range(BARRED_MOST):
        found = MergingSearch(evidence, barred).run(starts)
        if not (bent := _bent_too_far(evidence, linear, found[0])):
            break
        barred |= bent
    return Look(around, linear, tuple(noises), gram, evidence, decide(evidence, found), rows)


def _bent_too_far(evidence: Evidence, linear: Linear, best: Weighed) -> set[Key]:
    """Names of a set that depart from their law more than real parts do: another law is behind them.

    Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same.
    """
    size, first, found = evidence.estimate(best.members, best.kappa)[0], 0, set()
    for number, _ in best.members:
        one = linear.terms[number]
        own = size[first : first + one.count]
        first += one.count
        if one.is_name and not one.is_common and one.departed_by(own) > LAW_MOST:
            found.add(one.key)
    return found


def measured(look: Look, split: Split) -> list[Noise]:
    """The noise of every cell: what the best set leaves of recordings that it was not fitted to."""
    scene, members = look.around.scene, look.best.members
    sd = np.concatenate([look.evidence.scales[k][0][h] for k, h in members] or [np.zeros(0)])
    groups = [scene.picked(group & scene.kept) for group in split.groups]
    rest = foretold(look.linear, look.numbers, sd, look.noises, groups)
    return noises_of(scene, rest, look.rows)


def left(look: Look, numbers: Sequence[int], drop: Collection[int] = ()) -> Array:
    """What terms of the best set leave of all rows (rows,), refitted beside what is always there, without those of `drop`."""
    linear, scales = look.linear, dict(look.best.members)
    at = linear.at(numbers)
    sd = np.concatenate([np.ones(linear.first), *(look.evidence.scales[k][0][scales[k]] for k in numbers)])
    seen, pull = (part / look.best.kappa**2 for part in (look.gram.tip[np.ix_(at, at)], look.gram.pull[at]))
    size = sd * np.linalg.solve(np.eye(len(sd)) + sd[:, None] * seen * sd, sd * pull)
    kept = [np.full(linear.terms[k].count, k not in drop) for k in numbers]
    size[: linear.first] = np.clip(size[: linear.first], -ALWAYS_MOST, ALWAYS_MOST)
    size *= np.concatenate([np.ones(linear.first), *kept])
    return np.asarray(linear.y - linear.explained(numbers, size))
