"""All terms around a linearisation as whitened Gram matrices: by cell, so that a friction costs its own rows alone."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from calib.arrays import Array
from calib.gap.posterior.constants import FLOOR_DOUBT, LAW_MOST, SURE_sd
from calib.gap.posterior.decide import Decision, included
from calib.gap.posterior.evidence import Evidence, Gram, Places, Weighed
from calib.gap.posterior.search import MergingSearch
from calib.gap.posterior.term import Key
from calib.gap.residuals.scene import OperatingPoint, SeriesScene, SeriesTerm
from calib.gap.residuals.whitening import Noise, fitted
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law


@dataclass(frozen=True, slots=True)
class SeriesLinear:
    """Terms, and y (rows,): what the arm does beyond what is known, as if no term were in the model yet.

    Columns are counted with those of `nuisances` first; `thin_y` (thin rows,) as evidence counts rows. Terms' columns are put
    side by side where they are asked for: kept so, each linearisation would have a copy of what it shares with the others.
    """

    scene: SeriesScene
    terms: tuple[SeriesTerm, ...]
    nuisances: tuple[SeriesTerm, ...]
    y: Array
    thin_y: Array
    places: tuple[Places, ...]  # of each term's columns

    @classmethod
    def around(cls, point: OperatingPoint, terms: Sequence[SeriesTerm], nuisances: Sequence[SeriesTerm] = ()) -> SeriesLinear:
        """Terms of the model are added to what it leaves, at what they are there."""
        y = -point.residual.copy()
        for term in terms:
            if term.now is not None and term.key in point.laws:
                for number, response in term.response.items():
                    y[point.scene.cells[number].rows] += response[:, : len(term.now)] @ term.now
        thin = zip(point.scene.cells, point.scene.thinned, strict=True)
        thin_y = np.concatenate([thinned.of(y[cell.rows]) for cell, thinned in thin])
        ends = np.cumsum([sum(term.count for term in nuisances), *(term.count for term in terms)]).tolist()
        places = tuple(np.arange(first, end) for first, end in itertools.pairwise(ends))
        return cls(point.scene, tuple(terms), tuple(nuisances), y, thin_y, places)

    def _moving(self, k: int) -> Iterator[tuple[Array, Places]]:
        """Columns (rows, c) of each term that moves a cell, and their places among all."""
        ends = np.cumsum([0, *(term.count for term in self.nuisances)]).tolist()
        own = (np.arange(first, end) for first, end in itertools.pairwise(ends))
        for term, places in zip((*self.nuisances, *self.terms), (*own, *self.places), strict=True):
            if k in term.response:
                yield term.response[k], places

    @property
    def first(self) -> int:
        """How many columns nuisances have."""
        return sum(term.count for term in self.nuisances)

    @property
    def count(self) -> int:
        """How many columns there are."""
        return self.first + sum(term.count for term in self.terms)

    def at(self, numbers: Sequence[int]) -> Places:
        """Places of the columns of terms by number, after the nuisances'."""
        return np.concatenate([np.arange(self.first), *(self.places[number] for number in numbers)])

    def gram(self, noises: Sequence[Noise], rows: Picked) -> Gram:
        """What evidence needs, from the picked thin rows, each cell whitened by its own noise; nuisances are in it, and what
        other recordings tell.
        """
        total, squares, count = self.count, 0.0, 0
        seen, pull = np.zeros((total, total)), np.zeros(total)
        for k, thin in enumerate(self.scene.thin):
            picked = rows[thin]
            if not picked.any():
                continue
            moving, thinned = list(self._moving(k)), self.scene.thinned[k]
            beside = np.column_stack([self.thin_y[thin], *(thinned.of(columns) for columns, _ in moving)])
            white = self.scene.series[k].whitener(noises[k], picked) @ beside
            inner, at = white.T @ white, np.concatenate([np.zeros(0, np.intp), *(places for _, places in moving)])
            seen[np.ix_(at, at)] = seen[np.ix_(at, at)] + inner[1:, 1:]
            pull[at] += inner[1:, 0]
            squares += float(inner[0, 0])
            count += int(picked.sum())
        gram = Gram(seen, pull, None, np.zeros(total), squares, float(count))
        prior = self.scene.told
        return gram if prior is None else prior.beside(gram, self.terms, self.places)

    def thin_columns(self, places: Places) -> Array:
        """What some columns do to all thin rows, (thin rows, c)."""
        columns, number = np.zeros((len(self.thin_y), len(places))), np.full(self.count, -1)
        number[places] = np.arange(len(places))
        for k, rows in enumerate(self.scene.thin):
            for response, own in self._moving(k):
                asked = number[own] >= 0
                if asked.any():
                    columns[rows, number[own][asked]] = self.scene.thinned[k].of(response[:, asked])
        return columns

    def explained(self, numbers: Sequence[int], size: Array) -> Array:
        """What terms by number and nuisances do to all rows, with coefficients of their columns, (rows,)."""
        rows, first = np.zeros(len(self.y)), 0
        for term in (*self.nuisances, *(self.terms[number] for number in numbers)):
            for cell, columns in term.response.items():
                rows[self.scene.cells[cell].rows] += columns @ size[first : first + term.count]
            first += term.count
        return rows

    def whitened(self, values: Array, noises: Sequence[Noise]) -> Array:
        """Values (thin rows, c), each cell by its own noise."""
        result = np.empty_like(values)
        for k, thin in enumerate(self.scene.thin):
            result[thin] = self.scene.series[k].whitened(values[thin], noises[k])
        return result


def marginalised(gram: Gram, first: int) -> Gram:
    """The first columns, of prior standard deviation one, integrated out."""
    if not first:
        return gram
    root = np.linalg.cholesky(np.eye(first) + gram.tip[:first, :first])
    projected = solve_triangular(root, np.column_stack((gram.tip[:first, first:], gram.pull[:first])), lower=True)
    inner = projected.T @ projected  # of one array with itself: half the products of any other
    seen = gram.tip[first:, first:] - inner[:-1, :-1]
    pull = gram.pull[first:] - inner[:-1, -1]
    squares = gram.left - float(inner[-1, -1])
    # what is told of other columns tells nothing of these
    current = None if gram.current is None else gram.current[first:, first:]
    return Gram(seen, pull, current, gram.current_pull[first:], squares, gram.freedom)


def cross_validated(
    linear: SeriesLinear, numbers: Sequence[int], sd: Array, noises: Sequence[Noise], groups: Sequence[Picked]
) -> Array:
    """What a set leaves of every group of thin rows with the coefficients that the other groups give: (rows,).

    What a set only soaks up is left here, so that it is noise; what it explains is not. Rows of no group are nought.
    """
    columns = linear.thin_columns(linear.at(numbers))
    sd = np.concatenate((np.ones(linear.first), sd))
    white = linear.whitened(np.column_stack((columns, linear.thin_y)), noises)
    rest = np.zeros(len(linear.thin_y))
    grams = [white[g].T @ white[g] for g in groups]
    whole = np.sum(grams, axis=0)
    for group, gram in zip(groups, grams, strict=True):
        fitted_gram = whole - gram if len(groups) > 1 else whole
        inner = np.eye(len(sd)) + sd[:, None] * fitted_gram[:-1, :-1] * sd
        size = sd * np.linalg.solve(inner, sd * fitted_gram[:-1, -1]) if len(sd) else np.zeros(0)
        rest[group] = linear.thin_y[group] - columns[group] @ size
    return rest


def noises_of(scene: SeriesScene, rest: Array, rows: Picked) -> list[Noise]:
    """Each cell's noise from what is left on the picked thin rows."""
    noises = []
    for k, thin in enumerate(scene.thin):
        picked = rows[thin]
        noises.append(fitted(scene.series[k], rest[thin], picked) if picked.any() else Noise.white(len(scene.recording.runs)))
    return noises


BARRED_MOST = 4  # times that is searched, each without the laws that the one before bent too far


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """One linearisation, the noise around it, and what was decided; `gram` with nuisances, on the rows; `sets`: all sets that
    were weighed, best first.
    """

    point: OperatingPoint
    linear: SeriesLinear
    noises: tuple[Noise, ...]
    gram: Gram
    evidence: Evidence
    sets: tuple[Weighed, ...]
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
        laws = {}
        for number, coefficients in self.evidence.sizes(self.best).items():
            term = self.linear.terms[number]
            if term.law is not None and (names is None or term.key in names):
                laws[term.key] = term.law(coefficients).bounded()
        return laws


def weighed(
    point: OperatingPoint, linear: SeriesLinear, noises: Sequence[Noise], split: RowSplit, starts: Sequence[frozenset[Key]]
) -> SeriesFit:
    """The sets of effects around an operating point, weighed on the rows that decide; `starts`: sets to begin with."""
    rows = point.scene.picked(split.deciding & point.scene.usable)
    gram = linear.gram(noises, rows)
    evidence = Evidence(marginalised(gram, linear.first), linear.terms, FLOOR_DOUBT)
    search, begin = MergingSearch(evidence), list(starts)
    sets = search.run(begin)
    for _ in range(BARRED_MOST - 1):
        if not (bent := _bent_too_far(evidence, linear, sets[0], point)):
            break
        search.bar(bent)
        sets = search.run([search.keys(sets[0].members), *begin])
    return SeriesFit(point, linear, tuple(noises), gram, evidence, tuple(sets), included(evidence, sets), rows)


def _bent_too_far(evidence: Evidence, linear: SeriesLinear, best: Weighed, point: OperatingPoint) -> set[Key]:
    """Names of a set that depart from their law more than real parts do: another law is behind them.

    Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same. How far a law departs
    that the rows follow in no straight line is known around itself alone: elsewhere its departures stand for its bend, too.
    """
    barred = set()
    for number, coefficients in evidence.sizes(best).items():
        term = linear.terms[number]
        is_known = term.curve is None or term.key in point.laws
        if term.is_name and not term.is_common and is_known and term.departed_by(coefficients) > LAW_MOST:
            barred.add(term.key)
    return barred


def refitted(fit: SeriesFit, numbers: Sequence[int]) -> tuple[Array, Array]:
    """Coefficients of nuisances and terms of the best set, and their covariance."""
    at, scales = fit.linear.at(numbers), dict(fit.best.members)
    sd = np.concatenate([np.ones(fit.linear.first), *(fit.evidence.scales[k][0][scales[k]] for k in numbers)])
    inner = np.eye(len(sd)) + sd[:, None] * fit.gram.among(at, at, fit.best.kappa) * sd
    covariance = sd[:, None] * np.linalg.inv(inner) * sd
    return covariance @ fit.gram.drawn(at, fit.best.kappa), covariance


def without_each(fit: SeriesFit, groups: Sequence[Picked]) -> Array:
    """`refitted` of the best set without one of some groups of rows (k,) in turn: coefficients, (groups, c)."""
    linear, scene, at = fit.linear, fit.point.scene, fit.linear.at(fit.numbers)
    scales, kappa = fit.evidence.scales, fit.best.kappa
    sd = np.concatenate([np.ones(linear.first), *(scales[k][0][h] for k, h in fit.best.members)])
    white = linear.whitened(np.column_stack((linear.thin_columns(at), linear.thin_y)), fit.noises)
    coefficients = []
    for group in groups:
        rows = white[scene.picked(group & scene.usable)]
        gram = rows.T @ rows
        seen = fit.gram.among(at, at, kappa) - gram[:-1, :-1] / kappa**2
        pull = fit.gram.drawn(at, kappa) - gram[:-1, -1] / kappa**2
        inner = np.eye(len(sd)) + sd[:, None] * seen * sd
        coefficients.append(sd * np.linalg.solve(inner, sd * pull))
    return np.array(coefficients)


def residual_of(fit: SeriesFit, numbers: Sequence[int], drop: Collection[int] = ()) -> Array:
    """What terms of the best set leave of all rows (rows,), refitted beside nuisances, without those of `drop`."""
    linear, (size, _) = fit.linear, refitted(fit, numbers)
    factors = [np.full(linear.terms[k].count, k not in drop) for k in numbers]
    size[: linear.first] = np.clip(size[: linear.first], -SURE_sd, SURE_sd)
    size *= np.concatenate([np.ones(linear.first), *factors])
    return np.asarray(linear.y - linear.explained(numbers, size))
