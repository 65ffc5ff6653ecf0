"""All terms around a linearisation as whitened Gram matrices: by cell, so that a friction costs its own rows alone."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from calib.arrays import Array
from calib.gap.posterior.constants import FLOOR_DOUBT, LAW_MOST, SURE_sd
from calib.gap.posterior.decide import Decision, included
from calib.gap.posterior.evidence import Evidence, Gram, Places, Weighed
from calib.gap.posterior.search import MergingSearch
from calib.gap.posterior.term import Key
from calib.gap.residuals.scene import Columns, OperatingPoint, SeriesScene, SeriesTerm
from calib.gap.residuals.whitening import Noise, RowOrder, fitted
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law

AT_ONCE = 2**20  # numbers that are whitened for a Gram matrix, or of it are changed: 8 MB


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
                    y[point.scene.cells[number].rows] += response[:][:, : len(term.now)] @ term.now
        thin = zip(point.scene.cells, point.scene.thinned, strict=True)
        thin_y = np.concatenate([thinned.of(y[cell.rows]) for cell, thinned in thin])
        ends = np.cumsum([sum(term.count for term in nuisances), *(term.count for term in terms)]).tolist()
        places = tuple(np.arange(first, end) for first, end in itertools.pairwise(ends))
        return cls(point.scene, tuple(terms), tuple(nuisances), y, thin_y, places)

    def only(self, numbers: Sequence[int]) -> SeriesLinear:
        """With some of its terms."""
        terms = tuple(self.terms[number] for number in numbers)
        ends = itertools.accumulate((term.count for term in terms), initial=self.first)
        return replace(self, terms=terms, places=tuple(np.arange(*ends_of) for ends_of in itertools.pairwise(ends)))

    def _moving(self, k: int) -> Iterator[tuple[Columns, Places]]:
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

    def gram(self, noises: Sequence[Noise], rows: Picked, series: Sequence[RowOrder] | None = None) -> Gram:
        """What evidence needs, from the picked thin rows, each cell whitened by its own noise; nuisances are in it, and what
        other recordings tell. Some rows after the others: all columns at once would take more memory than all else. `series`: how
        the rows follow each other, by default as they do now.
        """
        total, squares, count = self.count, 0.0, 0
        seen, pull = np.zeros((total, total)), np.zeros(total)
        for k, thin in enumerate(self.scene.thin):
            picked = rows[thin]
            if not picked.any():
                continue
            moving, whitener = list(self._moving(k)), (series or self.scene.series)[k].whitener(noises[k], picked)
            at = np.concatenate([np.zeros(0, np.intp), *(places for _, places in moving)])
            white_y, side_by_side = whitener @ self.thin_y[thin], Columns.of(columns for columns, _ in moving)
            inner, own = np.zeros((len(at), len(at))), np.zeros(len(at))
            for rows_of in _blocks(len(picked), len(at)):
                some = slice(*np.searchsorted(np.flatnonzero(picked), (rows_of.start, rows_of.stop)).tolist())
                if not moving or some.start == some.stop:
                    continue
                part = whitener[some]
                needed = slice(int(part.indices.min()), int(part.indices.max()) + 1)
                white = part[:, needed] @ self.scene.thinned[k].rows(side_by_side, needed)
                inner += white.T @ white
                own += white.T @ white_y[some]
            for block in _blocks(len(at), len(at)):
                seen[np.ix_(at[block], at)] += inner[block]
            pull[at] += own
            squares += float(white_y @ white_y)
            count += int(picked.sum())
        gram = Gram(seen, pull, None, np.zeros(total), squares, float(count))
        prior = self.scene.told
        return gram if prior is None else prior.beside(gram, self.terms, self.places)

    def beside(self, places: Places, noises: Sequence[Noise]) -> Iterator[tuple[slice, Array, Array]]:
        """Of each cell its thin rows (m,), what some columns do to them beside what is to be explained, (m, c + 1), and the same
        whitened: all cells together would take as many columns as any of them has.
        """
        number = np.full(self.count, -1)
        number[places] = np.arange(len(places))
        for k, rows in enumerate(self.scene.thin):
            columns = np.zeros((rows.stop - rows.start, len(places) + 1))
            columns[:, -1] = self.thin_y[rows]
            for response, own in self._moving(k):
                asked = number[own] >= 0
                if asked.any():
                    columns[:, number[own][asked]] = self.scene.thinned[k].of(response[:][:, asked])
            yield rows, columns, self.scene.series[k].whitened(columns, noises[k])

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


def _blocks(count: int, columns: int) -> Iterator[slice]:
    """Some rows of so many columns after the others."""
    some = max(1, AT_ONCE // max(columns, 1))
    return (slice(first, min(first + some, count)) for first in range(0, count, some))


@dataclass(frozen=True, slots=True)
class Marginal:
    """A Gram matrix of which the first n columns, of prior standard deviation one, are integrated out: G - T'T and h - T't of the
    others, `apart`, beside these columns' own G with all (n, p) and h (n,), T and t.
    """

    apart: Gram
    seen: Array
    pull: Array
    taken: Array
    drawn: Array

    @classmethod
    def of(cls, gram: Gram, first: int) -> Marginal:
        """Without the first columns, in the place of G: both would take twice as much."""
        seen, pull = gram.tip[:first].copy(), gram.pull[:first].copy()
        root = np.linalg.cholesky(np.eye(first) + seen[:, :first])
        taken, drawn = solve_triangular(root, seen[:, first:], lower=True), solve_triangular(root, pull, lower=True)
        left = gram.tip[first:, first:]
        for block in _blocks(len(left), len(left)):
            left[block] -= taken[:, block].T @ taken
        # what is told of other columns tells nothing of these
        current = None if gram.current is None else gram.current[first:, first:].copy()
        squares = gram.left - float(drawn @ drawn)
        apart = Gram(left, gram.pull[first:] - taken.T @ drawn, current, gram.current_pull[first:], squares, gram.freedom)
        return cls(apart, seen, pull, taken, drawn)

    def beside(self, others: Places, with_first: bool = True) -> Gram:
        """Of some of the others by their places among all columns, after the first ones; without these as if they were nought."""
        count = len(self.pull)
        own = self.apart.of(others - count)
        took = self.taken[:, others - count]
        first = count if with_first else 0
        tip, pull = np.empty((first + len(others),) * 2), np.concatenate((self.pull[:first], own.pull + took.T @ self.drawn))
        tip[:first, :first], tip[:first, first:] = self.seen[:first, :first], self.seen[:first, others]
        tip[first:, :first], tip[first:, first:] = tip[:first, first:].T, own.tip + took.T @ took
        current = None if own.current is None else np.pad(own.current, ((first, 0), (first, 0)))
        squares = self.apart.left + float(self.drawn @ self.drawn)
        return Gram(tip, pull, current, np.pad(own.current_pull, (first, 0)), squares, own.freedom)


def cross_validated(
    linear: SeriesLinear, numbers: Sequence[int], sd: Array, noises: Sequence[Noise], groups: Sequence[Picked]
) -> Array:
    """What a set leaves of every group of thin rows with the coefficients that the other groups give: (rows,).

    What a set only soaks up is left here, so that it is noise; what it explains is not. Rows of no group are nought.
    """
    at, sd = linear.at(numbers), np.concatenate((np.ones(linear.first), sd))
    grams = np.zeros((len(groups), len(at) + 1, len(at) + 1))
    for rows, _, white in linear.beside(at, noises):
        for gram, group in zip(grams, groups, strict=True):
            part = white[group[rows]]
            gram += part.T @ part
    whole, sizes = np.sum(grams, axis=0), []
    for gram in grams:
        fitted_gram = whole - gram if len(groups) > 1 else whole
        inner = np.eye(len(sd)) + sd[:, None] * fitted_gram[:-1, :-1] * sd
        sizes.append(sd * np.linalg.solve(inner, sd * fitted_gram[:-1, -1]) if len(sd) else np.zeros(0))
    rest = np.zeros(len(linear.thin_y))
    for rows, columns, _ in linear.beside(at, noises):
        for size, group in zip(sizes, groups, strict=True):
            picked = group[rows]
            rest[rows][picked] = columns[picked, -1] - columns[picked, :-1] @ size
    return rest


def noises_of(scene: SeriesScene, rest: Array, rows: Picked) -> list[Noise]:
    """Each cell's noise from what is left on the picked thin rows."""
    noises = []
    for k, thin in enumerate(scene.thin):
        picked = rows[thin]
        noises.append(fitted(scene.series[k], rest[thin], picked) if picked.any() else Noise.white(len(scene.recording.runs)))
    return noises


BARRED_MOST = 4  # times that is searched, each without the laws that stood for something else in the one before
GONE_BY_s = 1e-9  # time constant of a drift that is over at once


class Weighing:
    """What thin rows tell of a linearisation's terms. Its Gram matrix is large: of all weighings of a scene that one alone has it
    which was asked last, and what is asked of another makes its own anew.
    """

    def __init__(self, linear: SeriesLinear, noises: Sequence[Noise], rows: Picked) -> None:
        self.linear, self.noises, self.rows, self._series = linear, tuple(noises), rows, linear.scene.series
        self._made: tuple[Marginal, Evidence] | None = None

    @property
    def gram(self) -> Marginal:
        """With nuisances as its first columns."""
        return self._of_rows()[0]

    @property
    def evidence(self) -> Evidence:
        """Of sets of terms beside the nuisances."""
        return self._of_rows()[1]

    def forget(self) -> None:
        """Give the memory back."""
        self._made = None

    def _of_rows(self) -> tuple[Marginal, Evidence]:
        if self._made is None:
            self.linear.scene.makes_room_for(self)
            gram = Marginal.of(self.linear.gram(self.noises, self.rows, self._series), self.linear.first)
            self._made = gram, Evidence(gram.apart, self.linear.terms, FLOOR_DOUBT)
        return self._made


@dataclass(frozen=True, slots=True)
class SeriesFit:
    """One linearisation, the noise around it, and what was decided; `sets`: all that were weighed, best first."""

    point: OperatingPoint
    weighing: Weighing
    sets: tuple[Weighed, ...]
    decision: Decision

    @property
    def linear(self) -> SeriesLinear:
        """The terms."""
        return self.weighing.linear

    @property
    def noises(self) -> tuple[Noise, ...]:
        """Of each cell."""
        return self.weighing.noises

    @property
    def rows(self) -> Picked:
        """The thin rows that were looked at."""
        return self.weighing.rows

    @property
    def gram(self) -> Marginal:
        """Of these rows, with nuisances as its first columns."""
        return self.weighing.gram

    @property
    def evidence(self) -> Evidence:
        """Of sets of terms."""
        return self.weighing.evidence

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
    weighing = Weighing(linear, noises, point.scene.picked(split.deciding & point.scene.usable))
    evidence = weighing.evidence
    search, begin = MergingSearch(evidence), list(starts)
    sets = search.run(begin)
    for _ in range(BARRED_MOST - 1):
        if not (others := _bent_too_far(evidence, linear, sets[0], point) | _gone_by(evidence, linear, sets[0], point)):
            break
        search.bar(others)
        sets = search.run([search.keys(sets[0].members), *begin])
    return SeriesFit(point, weighing, tuple(sets), included(evidence, sets))


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
    gram, scales = fit.gram.beside(fit.linear.at(numbers)[fit.linear.first :]), dict(fit.best.members)
    sd = np.concatenate([np.ones(fit.linear.first), *(fit.evidence.scales[k][0][scales[k]] for k in numbers)])
    inner = np.eye(len(sd)) + sd[:, None] * gram.among(slice(None), slice(None), fit.best.kappa) * sd
    covariance = sd[:, None] * np.linalg.inv(inner) * sd
    return covariance @ gram.drawn(slice(None), fit.best.kappa), covariance


def without_each(fit: SeriesFit, groups: Sequence[Picked]) -> Array:
    """`refitted` of the best set without one of some groups of rows (k,) in turn: coefficients, (groups, c)."""
    linear, scene, at = fit.linear, fit.point.scene, fit.linear.at(fit.numbers)
    scales, kappa = fit.evidence.scales, fit.best.kappa
    sd = np.concatenate([np.ones(linear.first), *(scales[k][0][h] for k, h in fit.best.members)])
    whole, everything = fit.gram.beside(at[linear.first :]), slice(None)
    picked = [scene.picked(group & scene.usable) for group in groups]
    grams = np.zeros((len(groups), len(at) + 1, len(at) + 1))
    for rows, _, white in linear.beside(at, fit.noises):
        for gram, group in zip(grams, picked, strict=True):
            part = white[group[rows]]
            gram += part.T @ part
    coefficients = []
    for gram in grams:
        seen = whole.among(everything, everything, kappa) - gram[:-1, :-1] / kappa**2
        pull = whole.drawn(everything, kappa) - gram[:-1, -1] / kappa**2
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


def _gone_by(evidence: Evidence, linear: SeriesLinear, best: Weighed, point: OperatingPoint) -> set[Key]:
    """Drifts of a set that had gone by before the rows begin: what such a one does is a zero of its joint, the geometry's."""
    barred, scene = set(), point.scene
    for number, coefficients in evidence.sizes(best).items():
        term = linear.terms[number]
        law = None if term.law is None else term.law(coefficients)
        if law is None or not law.form.is_by_time:
            continue
        base, at = point.without(law.name)
        final = law.at((law.values[0], GONE_BY_s))
        drift, zero = ((scene.columns.residual((*base, one)) - at)[scene.usable] for one in (law, final))
        if float(np.linalg.norm(drift - zero)) < SURE_sd:
            barred.add(term.key)
    return barred
