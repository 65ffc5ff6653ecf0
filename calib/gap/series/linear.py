"""All terms around a linearisation as whitened Gram matrices: by cell, so that a friction costs its own rows alone."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from calib.arrays import Array
from calib.gap.posterior.constants import FLOOR_DOUBT, LAW_MOST, NUISANCE_MOST
from calib.gap.posterior.decide import Decision, decide
from calib.gap.posterior.evidence import Evidence, Gram, Places, Weighed
from calib.gap.posterior.search import MergingSearch
from calib.gap.posterior.term import Key
from calib.gap.residuals.scene import OperatingPoint, SeriesScene, SeriesTerm
from calib.gap.residuals.whitening import Noise, fitted
from calib.gap.series.split import Picked, RowSplit
from calib.gap.signals.terms import Law


@dataclass(frozen=True, slots=True)
class Stack:
    """What moves one cell: `columns` (its rows, 1 + c), y first, and the place of each other one among all columns."""

    columns: Array
    places: Places


@dataclass(frozen=True, slots=True)
class SeriesLinear:
    """Terms, and y (rows,): what the arm does beyond what is known, as if no term were in the model yet.

    Columns are counted with those of `nuisances` first. `stacks`: one a cell, of thin rows, as `thin_y` (thin rows,) is.
    """

    scene: SeriesScene
    terms: tuple[SeriesTerm, ...]
    nuisances: tuple[SeriesTerm, ...]
    y: Array
    thin_y: Array
    stacks: tuple[Stack, ...]
    places: tuple[Places, ...]  # of each term's columns

    @classmethod
    def around(cls, around: OperatingPoint, terms: Sequence[SeriesTerm], nuisances: Sequence[SeriesTerm] = ()) -> SeriesLinear:
        """Terms of the model are added to what it leaves, at what they are there."""
        y = -around.residual.copy()
        for one in terms:
            if one.now is not None and one.key in around.found:
                for number, own in one.response.items():
                    y[around.scene.cells[number].rows] += own[:, : len(one.now)] @ one.now
        whole = (*nuisances, *terms)
        ends = np.cumsum([0, *(one.count for one in whole)]).tolist()
        places = [np.arange(first, end) for first, end in itertools.pairwise(ends)]
        stacks = []
        for k, (cell, thin) in enumerate(zip(around.scene.cells, around.scene.thinned, strict=True)):
            moving = [number for number, one in enumerate(whole) if k in one.response]
            parts = (y[cell.rows][:, None], *(whole[number].response[k] for number in moving))
            columns = np.hstack([thin.of(part) for part in parts])
            stacks.append(Stack(columns, np.concatenate([np.zeros(0, np.intp), *(places[number] for number in moving)])))
        thin_y = np.concatenate([stack.columns[:, 0] for stack in stacks])
        own_places = tuple(places[len(nuisances) :])
        return cls(around.scene, tuple(terms), tuple(nuisances), y, thin_y, tuple(stacks), own_places)

    @property
    def first(self) -> int:
        """How many columns nuisances have."""
        return sum(one.count for one in self.nuisances)

    def at(self, numbers: Sequence[int]) -> Places:
        """Places of the columns of terms by number, after the nuisances'."""
        return np.concatenate([np.arange(self.first), *(self.places[number] for number in numbers)])

    def gram(self, noises: Sequence[Noise], rows: Picked) -> Gram:
        """What evidence needs, from the picked thin rows, each cell whitened by its own noise; nuisances are in it, and what
        other recordings tell.
        """
        total = self.first + sum(one.count for one in self.terms)
        seen, pull, left, count = np.zeros((total, total)), np.zeros(total), 0.0, 0
        for k, thin in enumerate(self.scene.thin):
            picked = rows[thin]
            if not picked.any():
                continue
            columns = self.scene.series[k].whitener(noises[k], picked) @ self.stacks[k].columns
            inner, at = columns.T @ columns, self.stacks[k].places
            seen[np.ix_(at, at)] = seen[np.ix_(at, at)] + inner[1:, 1:]
            pull[at] += inner[1:, 0]
            left += float(inner[0, 0])
            count += int(picked.sum())
        found = Gram(seen, pull, np.zeros(seen.shape), np.zeros(total), left, float(count))
        told = self.scene.told
        return found if told is None else told.beside(found, self.terms, self.places)

    def thin_columns(self, places: Places) -> Array:
        """What some columns do to all thin rows, (thin rows, c)."""
        found = np.zeros((len(self.thin_y), len(places)))
        for rows, stack in zip(self.scene.thin, self.stacks, strict=True):
            _, here, there = np.intersect1d(places, stack.places, return_indices=True)
            found[rows, here] = stack.columns[:, 1 + there]
        return found

    def explained(self, numbers: Sequence[int], size: Array) -> Array:
        """What terms by number and nuisances do to all rows, with coefficients of their columns, (rows,)."""
        found, first = np.zeros(len(self.y)), 0
        for one in (*self.nuisances, *(self.terms[number] for number in numbers)):
            for cell, own in one.response.items():
                found[self.scene.cells[cell].rows] += own @ size[first : first + one.count]
            first += one.count
        return found

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
    taken = solve_triangular(root, np.column_stack((gram.tip[:first, first:], gram.pull[:first])), lower=True)
    inner = taken.T @ taken  # of one array with itself: half the products of any other
    seen = gram.tip[first:, first:] - inner[:-1, :-1]
    pull = gram.pull[first:] - inner[:-1, -1]
    left = gram.left - float(inner[-1, -1])
    # what is told of other columns tells nothing of these
    return Gram(seen, pull, gram.current[first:, first:], gram.current_pull[first:], left, gram.freedom)


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
    for group, own in zip(groups, grams, strict=True):
        other = whole - own if len(groups) > 1 else whole
        inner = np.eye(len(sd)) + sd[:, None] * other[:-1, :-1] * sd
        size = sd * np.linalg.solve(inner, sd * other[:-1, -1]) if len(sd) else np.zeros(0)
        rest[group] = linear.thin_y[group] - columns[group] @ size
    return rest


def noises_of(scene: SeriesScene, rest: Array, rows: Picked) -> list[Noise]:
    """Each cell's noise from what is left on the picked thin rows."""
    found = []
    for k, thin in enumerate(scene.thin):
        picked = rows[thin]
        found.append(fitted(scene.series[k], rest[thin], picked) if picked.any() else Noise.white(len(scene.recording.runs)))
    return found


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
        found = {}
        for number, own in self.evidence.sizes(self.best).items():
            one = self.linear.terms[number]
            if one.law is not None and (names is None or one.key in names):
                found[one.key] = one.law(own).bounded()
        return found


def weighed(
    around: OperatingPoint, linear: SeriesLinear, noises: Sequence[Noise], split: RowSplit, starts: Sequence[frozenset[Key]]
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
    return SeriesFit(around, linear, tuple(noises), gram, evidence, tuple(found), decide(evidence, found, 0.0), rows)


def _bent_too_far(evidence: Evidence, linear: SeriesLinear, best: Weighed, around: OperatingPoint) -> set[Key]:
    """Names of a set that depart from their law more than real parts do: another law is behind them.

    Every gear has friction: what departs from Coulomb's or the viscous law is that friction all the same. How far a law departs
    that the rows follow in no straight line is known around itself alone: elsewhere its departures stand for its bend, too.
    """
    found = set()
    for number, own in evidence.sizes(best).items():
        one = linear.terms[number]
        is_known = one.curve is None or one.key in around.found
        if one.is_name and not one.is_common and is_known and one.departed_by(own) > LAW_MOST:
            found.add(one.key)
    return found


def refitted(fit: SeriesFit, numbers: Sequence[int]) -> tuple[Array, Array]:
    """Coefficients of nuisances and terms of the best set, and their covariance."""
    at, scales = fit.linear.at(numbers), dict(fit.best.members)
    sd = np.concatenate([np.ones(fit.linear.first), *(fit.evidence.scales[k][0][scales[k]] for k in numbers)])
    inner = np.eye(len(sd)) + sd[:, None] * fit.gram.among(at, at, fit.best.kappa) * sd
    covariance = sd[:, None] * np.linalg.inv(inner) * sd
    return covariance @ fit.gram.drawn(at, fit.best.kappa), covariance


def without_each(fit: SeriesFit, groups: Sequence[Picked]) -> Array:
    """`refitted` of the best set without one of some groups of rows (k,) in turn: coefficients, (groups, c)."""
    linear, scene, at = fit.linear, fit.around.scene, fit.linear.at(fit.numbers)
    scales, across, noise = fit.evidence.scales, np.ix_(at, at), fit.best.kappa**2
    sd = np.concatenate([np.ones(linear.first), *(scales[k][0][h] for k, h in fit.best.members)])
    white = linear.whitened(np.column_stack((linear.thin_columns(at), linear.thin_y)), fit.noises)
    found = []
    for group in groups:
        rows = white[scene.picked(group & scene.kept)]
        own = rows.T @ rows
        seen = (fit.gram.tip[across] - own[:-1, :-1]) / noise + fit.gram.current[across]
        pull = (fit.gram.pull[at] - own[:-1, -1]) / noise + fit.gram.current_pull[at]
        inner = np.eye(len(sd)) + sd[:, None] * seen * sd
        found.append(sd * np.linalg.solve(inner, sd * pull))
    return np.array(found)


def left(fit: SeriesFit, numbers: Sequence[int], drop: Collection[int] = ()) -> Array:
    """What terms of the best set leave of all rows (rows,), refitted beside nuisances, without those of `drop`."""
    linear, (size, _) = fit.linear, refitted(fit, numbers)
    kept = [np.full(linear.terms[k].count, k not in drop) for k in numbers]
    size[: linear.first] = np.clip(size[: linear.first], -NUISANCE_MOST, NUISANCE_MOST)
    size *= np.concatenate([np.ones(linear.first), *kept])
    return np.asarray(linear.y - linear.explained(numbers, size))
