"""All terms around a linearisation as whitened Gram matrices: by cell, so that a friction costs its own rows alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from calib.arrays import Array
from calib.gap.dynamic.split import Picked
from calib.gap.posterior.gram import Gram
from calib.gap.series.effects import Around
from calib.gap.series.scene import Scene
from calib.gap.series.term import SeriesTerm
from calib.gap.series.whitening import Noise, fitted


@dataclass(frozen=True, slots=True)
class Linear:
    """Terms, and y (rows,): what the arm does beyond what is known, as if no term were in the model yet."""

    scene: Scene
    terms: tuple[SeriesTerm, ...]
    always: tuple[SeriesTerm, ...]
    y: Array

    @classmethod
    def around(cls, around: Around, terms: Sequence[SeriesTerm], always: Sequence[SeriesTerm] = ()) -> Linear:
        """Terms of the model are added to what it leaves, at what they are there."""
        y = -around.residual.copy()
        for one in terms:
            if one.now is not None:
                for cell, own in one.response.items():
                    y[around.scene.cells[cell].rows] += own[:, : len(one.now)] @ one.now
        return cls(around.scene, tuple(terms), tuple(always), y)

    def gram(self, noises: Sequence[Noise], rows: Picked) -> Gram:
        """What evidence needs, from the picked rows; each cell whitened by its own noise, what is always there integrated out."""
        terms = (*self.always, *self.terms)
        ends = np.cumsum([one.count for one in terms])
        places = [np.arange(end - one.count, end) for one, end in zip(terms, ends.tolist(), strict=True)]
        total = int(ends[-1])
        seen, pull, left, count = np.zeros((total, total)), np.zeros(total), 0.0, 0
        for k, cell in enumerate(self.scene.cells):
            picked = rows[cell.rows]
            if not picked.any():
                continue
            own = [number for number, one in enumerate(terms) if k in one.response]
            columns = np.hstack([self.y[cell.rows][:, None], *(terms[number].response[k] for number in own)])
            columns = self.scene.series[k].whitened(columns, noises[k])[picked]
            inner = columns.T @ columns
            at = np.concatenate([np.zeros(0, dtype=int), *(places[number] for number in own)])
            seen[np.ix_(at, at)] += inner[1:, 1:]
            pull[at] += inner[1:, 0]
            left += float(inner[0, 0])
            count += int(picked.sum())
        first = sum(one.count for one in self.always)
        if not first:
            return Gram(seen, pull, np.zeros_like(seen), np.zeros(len(pull)), left, float(count))
        root = np.linalg.cholesky(np.eye(first) + seen[:first, :first])
        taken = solve_triangular(root, np.column_stack((seen[:first, first:], pull[:first])), lower=True)
        seen = seen[first:, first:] - taken[:, :-1].T @ taken[:, :-1]
        pull = pull[first:] - taken[:, :-1].T @ taken[:, -1]
        left -= float(taken[:, -1] @ taken[:, -1])
        return Gram(seen, pull, np.zeros_like(seen), np.zeros(len(pull)), left, float(count))

    def columns_of(self, terms: Sequence[SeriesTerm]) -> Array:
        """What some terms do to all rows, (rows, c)."""
        found = np.zeros((len(self.y), sum(one.count for one in terms)))
        first = 0
        for one in terms:
            for cell, own in one.response.items():
                found[self.scene.cells[cell].rows, first : first + one.count] = own
            first += one.count
        return found

    def columns(self, numbers: Sequence[int]) -> Array:
        """`columns_of` terms by number."""
        return self.columns_of([self.terms[number] for number in numbers])

    def whitened(self, values: Array, noises: Sequence[Noise]) -> Array:
        """Values (rows, c), each cell by its own noise."""
        result = np.empty_like(values)
        for k, cell in enumerate(self.scene.cells):
            result[cell.rows] = self.scene.series[k].whitened(values[cell.rows], noises[k])
        return result


def foretold(
    linear: Linear, numbers: Sequence[int], sd: Array, noises: Sequence[Noise], groups: Sequence[Picked]
) -> Array:
    """What a set leaves of every group of rows with the coefficients that the other groups give: (rows,).

    What a set only soaks up is left here, so that it is noise; what it explains is not. Rows of no group are nought.
    """
    columns = np.hstack((linear.columns(numbers), linear.columns_of(linear.always)))
    sd = np.concatenate((sd, np.ones(columns.shape[1] - len(sd))))
    white = linear.whitened(np.column_stack((columns, linear.y)), noises)
    rest = np.zeros(len(linear.y))
    grams = [white[g].T @ white[g] for g in groups]
    whole = np.sum(grams, axis=0)
    for group, own in zip(groups, grams, strict=True):
        other = whole - own if len(groups) > 1 else whole
        inner = np.eye(len(sd)) + sd[:, None] * other[:-1, :-1] * sd
        size = sd * np.linalg.solve(inner, sd * other[:-1, -1]) if len(sd) else np.zeros(0)
        rest[group] = linear.y[group] - columns[group] @ size
    return rest


def noises_of(scene: Scene, rest: Array, rows: Picked) -> list[Noise]:
    """Each cell's noise from what is left on the picked rows."""
    found = []
    for k, cell in enumerate(scene.cells):
        picked = rows[cell.rows]
        found.append(
            fitted(scene.series[k], rest[cell.rows], picked)
            if picked.any()
            else Noise.white(len(scene.recording.runs))
        )
    return found
