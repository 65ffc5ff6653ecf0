"""The fit: linearise around what was found, weigh sets of effects, and again until the answer stays."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import series_terms
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import (
    DEPARTURES,
    FLOOR_DOUBT,
    LAW_MOST,
    NUISANCE_MOST,
    REMAINS,
    SIZE_LEVELS,
    UNTOLD,
)
from calib.gap.posterior.decide import Decision, decide
from calib.gap.posterior.evidence import Evidence, Gram
from calib.gap.posterior.search import MergingSearch, Weighed
from calib.gap.posterior.term import Key
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.scene import Scene
from calib.gap.residuals.term import SeriesTerm
from calib.gap.residuals.whitening import Noise
from calib.gap.series.blocks import blocks_of
from calib.gap.series.linear import Linear, cross_validated, marginalised, noises_of
from calib.gap.series.nuisances import nuisances
from calib.gap.series.split import Picked, Split
from calib.gap.signals.terms import Term as Law
from control.progress import Advance

LINEARISATIONS = 3  # linearisations, at most
SETTLINGS = 5  # refits of laws that bend
SETTLED = 0.01  # of a value
BARRED_MOST = 4  # searches, each without the laws that the one before bent too far


@dataclass(frozen=True, slots=True)
class Fit:
    """One linearisation, the noise around it, and what was decided; `gram` with nuisances, on the rows."""

    around: OperatingPoint
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
                found[one.key] = one.law(size[first : first + one.count]).bounded()
            first += one.count
        return found


@dataclass(frozen=True, slots=True)
class Validated:
    """A fit, and how well its best set predicts recordings that it was not fitted to.

    `noises`: what is left there, of every cell; `missed`: the mean logarithm of its prediction errors' variance; `kept`: the
    rows that were looked at.
    """

    fit: Fit
    noises: tuple[Noise, ...]
    missed: float
    kept: Picked

    @classmethod
    def of(cls, fit: Fit, split: Split) -> Validated:
        """Every group of recordings predicted from the others."""
        scene, members = fit.around.scene, fit.best.members
        sd = np.concatenate([fit.evidence.scales[k][0][h] for k, h in members] or [np.zeros(0)])
        groups = [scene.picked(group & scene.kept) for group in split.groups]
        rest = cross_validated(fit.linear, fit.numbers, sd, fit.noises, groups)
        noises = noises_of(scene, rest, fit.rows)
        errors = [
            one.scale[series.run[fit.rows[thin]]] * one.sd[-1]
            for one, series, thin in zip(noises, scene.series, scene.thin, strict=True)
        ]
        return cls(fit, tuple(noises), 2.0 * float(np.mean(np.log(np.concatenate(errors)))), scene.kept)

    def unless_worse_than(self, before: Validated | None) -> Validated:
        """This one, or the one before if that predicted better by what is worth a word."""
        return self if before is None or self.missed <= before.missed + math.log1p(REMAINS) else before


def fitted(
    scene: Scene, known: Sequence[Law], split: Split, names: Collection[str] | None, advance: Advance
) -> Fit:
    """The last fit that predicts recordings no worse than those before it."""
    around = OperatingPoint.of(scene, known, {})
    last: Validated | None = None
    starts: list[frozenset[Key]] = []
    noises = [Noise.white(len(scene.recording.runs)) for _ in scene.cells]
    first: list[SeriesTerm] = []
    blocks = list(blocks_of(around))
    for count in range(LINEARISATIONS):
        advance("what every effect would do", 0.1 + 0.28 * count)
        terms = [*series_terms(around, names, first), *blocks]
        first = first or terms
        linear = Linear.around(around, terms, tuple(nuisances(around, terms)))
        advance("weighing effects", 0.2 + 0.28 * count)
        judged = Validated.of(_weighed(around, linear, noises, split, starts), split)
        if count or judged.fit.best.kappa > UNTOLD:
            again = Validated.of(_weighed(around, linear, judged.noises, split, starts), split)
            judged = again.unless_worse_than(judged)
        fit, noises = judged.fit, list(judged.noises)
        last = judged.unless_worse_than(last)
        keys = frozenset(linear.terms[number].key for number in fit.numbers)
        laws = fit.laws()
        if last is not judged or not laws or (count and starts[:1] == [keys]) or count == LINEARISATIONS - 1:
            break
        starts = [keys, frozenset(key for key in keys if isinstance(key, EffectName))]
        advance("settling what bends", 0.36 + 0.28 * count)
        after = settled(fit, split)
        if _remains(after, fit) > _remains(around, fit):  # no better point of linearisation
            break
        around = after
    assert last is not None  # the first is taken
    scene.keep(last.kept)
    return last.fit


def _remains(around: OperatingPoint, fit: Fit) -> float:
    """What a model leaves of the rows that decide, each cell by its noise; blocks are in no model."""
    thin = zip(around.scene.thinned, around.scene.cells, strict=True)
    left = np.concatenate([one.of(around.residual[cell.rows]) for one, cell in thin])
    white = fit.linear.whitened(left[:, None], fit.noises)[fit.rows]
    return float(np.sum(white**2))


def settled(fit: Fit, split: Split) -> OperatingPoint:
    """Around the best set, its laws' values refitted until those that the rows follow in no straight line stay.

    Of all turns the one that leaves least: what a play does to the rows bends so much that a refit may lead away.
    """
    scene, known, laws = fit.around.scene, fit.around.known, fit.laws()
    best: tuple[float, OperatingPoint, Picked] | None = None
    change = np.inf
    for turn in range(SETTLINGS):
        scene.keep(scene.rows.resting((*known, *laws.values())))
        around = OperatingPoint.of(scene, known, laws)
        remains = _remains(around, fit)
        if best is None or remains < best[0]:
            best = remains, around, scene.kept
        if change < SETTLED or turn == SETTLINGS - 1 or all(law.form.is_straight for law in laws.values()):
            break
        laws, change = _refitted(fit, around, split)
    assert best is not None  # there is a first turn
    scene.keep(best[2])
    return best[1]


def _refitted(fit: Fit, around: OperatingPoint, split: Split) -> tuple[dict[Key, Law], float]:
    """The laws of a model one step further, and by what share the values of those that bend changed, at most."""
    scene, laws = around.scene, around.found
    blocks = [fit.linear.terms[k] for k in fit.numbers if fit.linear.terms[k].law is None]
    terms = [one for one in series_terms(around, keys=laws.keys()) if one.now is not None]
    linear = Linear.around(around, [*terms, *blocks])
    gram = linear.gram(fit.noises, scene.picked(split.deciding & scene.kept))
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
        moved[one.key] = one.law(own).bounded()
        if not laws[one.key].form.is_straight:
            # damping and a friction's share are never known well
            counted = 1 if laws[one.key].form.is_gear else 2
            pairs = zip(moved[one.key].values[:counted], laws[one.key].values, strict=False)
            largest = max(largest, *(abs(new / now - 1.0) if now else 0.0 for new, now in pairs))
    return moved, largest


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
    around: OperatingPoint,
    linear: Linear,
    noises: Sequence[Noise],
    split: Split,
    starts: Sequence[frozenset[Key]],
) -> Fit:
    rows = around.scene.picked(split.deciding & around.scene.kept)
    gram = linear.gram(noises, rows)
    evidence = Evidence(marginalised(gram, linear.first), linear.terms, FLOOR_DOUBT)
    barred: set[Key] = set()
    for _ in range(BARRED_MOST):
        found = MergingSearch(evidence, barred).run(starts)
        if not (bent := _bent_too_far(evidence, linear, found[0])):
            break
        barred |= bent
    return Fit(around, linear, tuple(noises), gram, evidence, decide(evidence, found), rows)


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


def left(fit: Fit, numbers: Sequence[int], drop: Collection[int] = ()) -> Array:
    """What terms of the best set leave of all rows (rows,), refitted beside nuisances, without those of `drop`."""
    linear, scales = fit.linear, dict(fit.best.members)
    at = linear.at(numbers)
    sd = np.concatenate([np.ones(linear.first), *(fit.evidence.scales[k][0][scales[k]] for k in numbers)])
    seen, pull = (part / fit.best.kappa**2 for part in (fit.gram.tip[np.ix_(at, at)], fit.gram.pull[at]))
    size = sd * np.linalg.solve(np.eye(len(sd)) + sd[:, None] * seen * sd, sd * pull)
    kept = [np.full(linear.terms[k].count, k not in drop) for k in numbers]
    size[: linear.first] = np.clip(size[: linear.first], -NUISANCE_MOST, NUISANCE_MOST)
    size *= np.concatenate([np.ones(linear.first), *kept])
    return np.asarray(linear.y - linear.explained(numbers, size))
