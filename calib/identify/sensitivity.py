"""What the points show of the unknowns, block by block: of a million poses the whole would take gigabytes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Final

import numpy as np

from calib.arm_problem.expansion import Problem
from calib.arrays import Array, Mask

BLOCK: Final = 20_000  # poses: 8 MB for 16 unknowns


class Sensitivity:
    """The sensitivity (m, 3, k) of m poses."""

    def __init__(self, block: Callable[[slice], Array], count: int) -> None:
        """`block` gives the part (b, 3, k) of a slice of the `count` poses."""
        self._block, self._count = block, count

    @classmethod
    def at(cls, problem: Problem, x: Array) -> Sensitivity:
        """Of a problem at unknowns x (k,)."""
        return cls(lambda rows: problem.sensitivity(x, rows), len(problem))

    @classmethod
    def of(cls, whole: Array) -> Sensitivity:
        """Of an array (m, 3, k)."""
        return cls(lambda rows: whole[rows], len(whole))

    def blocks(self) -> Iterator[tuple[slice, Array]]:
        """Slices of the poses, and their parts."""
        for start in range(0, self._count, BLOCK):
            rows = slice(start, min(start + BLOCK, self._count))
            yield rows, self._block(rows)

    def chosen(self, rows: Mask) -> Array:
        """The rows of a mask (m, 3) of coordinates, (chosen, k)."""
        return np.concatenate([part[rows[block]] for block, part in self.blocks()])

    def pulled(self, pull: Array) -> Array:
        """Sum of pull (m, 3) times the sensitivity, (k,)."""
        return np.asarray(sum(np.einsum("ij,ijk->k", pull[rows], part) for rows, part in self.blocks()))

    @cached_property
    def compact(self) -> Array:
        """Another sensitivity (n, 1, k) of few rows with the same products of its columns: R of QR, block after block."""
        found: Array | None = None
        for _, part in self.blocks():
            rows = part.reshape(-1, part.shape[2])
            found = triangle(rows if found is None else np.concatenate((found, rows)))
        whole = np.zeros((0, 0)) if found is None else found
        return whole[:, None, :]


def triangle(rows: Array) -> Array:
    """R of rows (n, k), (k, k); the rows themselves if there are no more."""
    return np.asarray(np.linalg.qr(rows, mode="r")) if len(rows) > rows.shape[1] else rows
