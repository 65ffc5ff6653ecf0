"""The fit: linearise around what was found, weigh sets of effects, and again until the answer stays."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.gap.effects.catalogue import series_terms
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import REMAINS, UNTOLD
from calib.gap.posterior.term import Key
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.scene import SeriesScene
from calib.gap.residuals.term import SeriesTerm
from calib.gap.residuals.whitening import Noise
from calib.gap.series.blocks import blocks_of
from calib.gap.series.fit import SeriesFit, weighed
from calib.gap.series.linear import SeriesLinear, cross_validated, noises_of
from calib.gap.series.nuisances import nuisances
from calib.gap.series.rivals import against_rivals
from calib.gap.series.settling import remains, settled
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law
from control.progress import Advance

LINEARISATIONS = 3  # linearisations, at most


@dataclass(frozen=True, slots=True)
class Validated:
    """A fit, and how well its best set predicts recordings that it was not fitted to.

    `noises`: what is left there, of every cell; `missed`: the mean logarithm of its prediction errors' variance; `kept`: the
    rows that were looked at.
    """

    fit: SeriesFit
    noises: tuple[Noise, ...]
    missed: float
    kept: Picked

    @classmethod
    def of(cls, fit: SeriesFit, split: RowSplit) -> Validated:
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
    scene: SeriesScene, known: Sequence[Law], split: RowSplit, names: Collection[str] | None, advance: Advance
) -> SeriesFit:
    """The last fit that predicts recordings no worse than those before it."""
    around = OperatingPoint.of(scene, known, {})
    last: Validated | None = None
    starts: list[frozenset[Key]] = []
    noises = [Noise.white(len(scene.recording.runs)) for _ in scene.cells]
    first: list[SeriesTerm] = []
    blocks = list(blocks_of(around))

    def linearised(point: OperatingPoint) -> SeriesLinear:
        terms = [*series_terms(point, names, first), *blocks]
        return SeriesLinear.around(point, terms, tuple(nuisances(point, terms)))

    for count in range(LINEARISATIONS):
        advance("what every effect would do", 0.1 + 0.28 * count)
        linear = linearised(around)
        first = first or list(linear.terms)
        advance("weighing effects", 0.2 + 0.28 * count)
        judged = Validated.of(weighed(around, linear, noises, split, starts), split)
        if count or judged.fit.best.kappa > UNTOLD:
            again = Validated.of(weighed(around, linear, judged.noises, split, starts), split)
            judged = again.unless_worse_than(judged)
        fit, noises = judged.fit, list(judged.noises)
        last = judged.unless_worse_than(last)
        keys = fit.names
        laws = fit.laws()
        if last is not judged or not laws or (count and starts[:1] == [keys]) or count == LINEARISATIONS - 1:
            break
        starts = [keys, frozenset(key for key in keys if isinstance(key, EffectName))]
        advance("settling what bends", 0.36 + 0.28 * count)
        after = settled(fit, split)
        if remains(after, fit) > remains(around, fit):  # no better point of linearisation
            break
        around = after
    assert last is not None  # the first is taken
    scene.keep(last.kept)
    advance("rivals of what was found", 0.94)
    return against_rivals(last.fit, split, linearised)
