"""One linearisation with the sets of effects weighed around it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.posterior.constants import FLOOR_DOUBT, LAW_MOST, NUISANCE_MOST
from calib.gap.posterior.decide import Decision, decide
from calib.gap.posterior.evidence import Evidence, Gram
from calib.gap.posterior.search import MergingSearch, Weighed
from calib.gap.posterior.term import Key
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.whitening import Noise
from calib.gap.series.linear import SeriesLinear, marginalised
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law

BARRED_MOST = 4  # searches, each without the laws that the one before bent too far


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """One linearisation, the noise around it, and what was decided; `gram` with nuisances, on the rows; `found`: all sets that
    were weighed, best first.
    """

    around: OperatingPoint
    linear: SeriesLinear
    noises: tuple[Noise, ...]
    gram: Gram
    evidence: Evidence
    found: tuple[Weighed, ...]
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

    @property
    def names(self) -> frozenset[Key]:
        """Keys of the best set."""
        return frozenset(self.linear.terms[number].key for number in self.numbers)

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


def weighed(
    around: OperatingPoint,
    linear: SeriesLinear,
    noises: Sequence[Noise],
    split: RowSplit,
    starts: Sequence[frozenset[Key]],
) -> SeriesFit:
    """The sets of effects around an operating point, weighed on the rows that decide; `starts`: sets to begin with."""
    rows = around.scene.picked(split.deciding & around.scene.kept)
    gram = linear.gram(noises, rows)
    evidence = Evidence(marginalised(gram, linear.first), linear.terms, FLOOR_DOUBT)
    barred: set[Key] = set()
    for _ in range(BARRED_MOST):
        found = MergingSearch(evidence, barred).run(starts)
        if not (bent := _bent_too_far(evidence, linear, found[0], around)):
            break
        barred |= bent
    return SeriesFit(
        around, linear, tuple(noises), gram, evidence, tuple(found), decide(evidence, found), rows
    )


def _bent_too_far(
    evidence: Evidence, linear: SeriesLinear, best: Weighed, around: OperatingPoint
) -> set[Key]:
    """Names of a set that depart from their law more than real parts do: another law is behind them.

    Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same. How far a law departs
    that the rows follow in no straight line is known around itself alone: elsewhere its departures stand for its bend, too.
    """
    size, first, found = evidence.estimate(best.members, best.kappa)[0], 0, set()
    for number, _ in best.members:
        one = linear.terms[number]
        own = size[first : first + one.count]
        first += one.count
        is_known = one.curve is None or one.key in around.found
        if one.is_name and not one.is_common and is_known and one.departed_by(own) > LAW_MOST:
            found.add(one.key)
    return found


def left(fit: SeriesFit, numbers: Sequence[int], drop: Collection[int] = ()) -> Array:
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
