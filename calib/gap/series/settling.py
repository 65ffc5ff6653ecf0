"""The values of laws that the rows follow in no straight line: refitted until they stay."""

from __future__ import annotations

import numpy as np

from calib.arrays import Array
from calib.gap.effects.catalogue import series_terms
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import DEPARTURES, SIZE_LEVELS
from calib.gap.posterior.term import Key
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.term import SeriesTerm
from calib.gap.series.fit import SeriesFit
from calib.gap.series.linear import SeriesLinear
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law

SETTLINGS = 5  # refits of laws that bend
SETTLED = 0.01  # of a value


def remains(around: OperatingPoint, fit: SeriesFit) -> float:
    """What a model leaves of the rows that decide, each cell by its noise; blocks are in no model."""
    thin = zip(around.scene.thinned, around.scene.cells, strict=True)
    left = np.concatenate([one.of(around.residual[cell.rows]) for one, cell in thin])
    white = fit.linear.whitened(left[:, None], fit.noises)[fit.rows]
    return float(np.sum(white**2))


def settled(fit: SeriesFit, split: RowSplit) -> OperatingPoint:
    """Around the best set, its laws' values refitted until those that the rows follow in no straight line stay.

    Of all turns the one that leaves least: what a play does to the rows bends so much that a refit may lead away.
    """
    scene, known, laws = fit.around.scene, fit.around.known, fit.laws()
    best: tuple[float, OperatingPoint, Picked] | None = None
    change = np.inf
    for turn in range(SETTLINGS):
        scene.keep(scene.rows.resting((*known, *laws.values())))
        around = OperatingPoint.of(scene, known, laws)
        left = remains(around, fit)
        if best is None or left < best[0]:
            best = left, around, scene.kept
        if change < SETTLED or turn == SETTLINGS - 1 or all(law.form.is_straight for law in laws.values()):
            break
        laws, change = _refitted(fit, around, split)
    assert best is not None  # there is a first turn
    scene.keep(best[2])
    return best[1]


def _refitted(fit: SeriesFit, around: OperatingPoint, split: RowSplit) -> tuple[dict[Key, Law], float]:
    """The laws of a model one step further, and by what share the values of those that bend changed, at most."""
    scene, laws = around.scene, around.found
    blocks = [fit.linear.terms[k] for k in fit.numbers if fit.linear.terms[k].law is None]
    terms = [one for one in series_terms(around, keys=laws.keys()) if one.now is not None]
    linear = SeriesLinear.around(around, [*terms, *blocks])
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
