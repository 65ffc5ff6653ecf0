"""A term of the series' model: an effect or a nameless block in one variant, as what it does to the rows of every channel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.arrays import Array
from calib.gap.posterior.constants import BENDS_LEAST, BLOCK_PRIOR, COMMON_PRIOR, NAME_PRIOR
from calib.gap.posterior.term import Term
from calib.gap.residuals.scene import Response
from calib.gap.signals.terms import Law

HELD_TURNS = 4
TURN_DOUBT = 0.1  # of a turn: to this a secant between two others follows from them


@dataclass(frozen=True, slots=True)
class SeriesTerm(Term):
    """Columns by cell, each (its rows, c): laws first, then departures, then nuisances, as of every Term.

    `law`: the physics' term for coefficients (c,) of all columns, in usual sizes; None for blocks.
    """

    response: Response = field(default_factory=dict)
    law: Callable[[Array], Law] | None = None
    now: Array | None = None  # coefficients at which the model of this linearisation has it
    is_common: bool = False  # every gear has it, and the file says nothing of it
    curve: Curve | None = None
    alike: Array = field(
        default_factory=lambda: np.zeros((0, 1, 1))
    )  # see `departed`: no data tell this from the law

    @property
    def count(self) -> int:
        """How many columns."""
        return next((own.shape[1] for own in self.response.values()), 0)

    def departed_by(self, size: Array) -> float:
        """What the departures do together, with coefficients of all columns (c,), over what the law does, in all rows.

        Those of one variable look alike, and may take each other's place; those of a channel that hardly shows the law are noise.
        """
        ends = self.laws, self.laws + self.departures
        law = sum(float(np.sum((own[:, : ends[0]] @ size[: ends[0]]) ** 2)) for own in self.response.values())
        bent = slice(*ends)
        departs = sum(float(np.sum((own[:, bent] @ size[bent]) ** 2)) for own in self.response.values())
        return math.sqrt(departs / law) if law > 0.0 else 0.0

    @property
    def log_odds(self) -> float:
        """Of its key, before any data."""
        prior = COMMON_PRIOR if self.is_common else NAME_PRIOR if self.is_name else BLOCK_PRIOR
        return float(np.log(prior / (1.0 - prior)))


@dataclass(frozen=True, slots=True)
class Curve:
    """Of a law whose first value v bends its response: v is coefficient 0 times `size`, the coefficient at `place` says how the
    secant at `start` turns towards that at `near`; both follow from v.
    """

    place: int
    start: float
    near: float
    size: float

    def turned(self, first: float) -> tuple[float, float]:
        """The second of the two coefficients for the first, and its slope."""
        value = first * self.size
        scale = 1.0 / ((self.near - self.start) * self.start)
        return value * (value - self.start) * scale, (2.0 * value - self.start) * self.size * scale

    def held(self, mean: Array, covariance: Array) -> tuple[Array, Array]:
        """Coefficients (c,) and their covariance given that one value is behind both (the iterated update of a Kalman filter)."""
        found, spread = mean, covariance
        for _ in range(HELD_TURNS):
            second, slope = self.turned(float(found[0]))
            along = np.zeros(len(mean))
            along[[0, self.place]] = -slope, 1.0
            gain = covariance @ along / (float(along @ covariance @ along) + TURN_DOUBT**2)
            missed = float(found[self.place]) - second - float(along @ (found - mean))
            found, spread = mean - gain * missed, covariance - np.outer(gain, along @ covariance)
        return found, spread


def stacked(parts: Sequence[Response]) -> dict[int, Array]:
    """Responses side by side, nought where one has nothing."""
    cells = sorted({cell for part in parts for cell in part})
    widths = [next((own.shape[1] for own in part.values()), 1) for part in parts]
    found = {}
    for cell in cells:
        rows = next(part[cell].shape[0] for part in parts if cell in part)
        found[cell] = np.hstack(
            [
                part[cell] if cell in part else np.zeros((rows, width))
                for part, width in zip(parts, widths, strict=True)
            ]
        )
    return found


def scaled(response: Response, factor: float) -> dict[int, Array]:
    """All columns times a factor."""
    return {cell: own * factor for cell, own in response.items()}


def size_of(response: Response) -> Array:
    """Euclidean norm of each column over all cells, (c,)."""
    total: Array | float = 0.0
    for own in response.values():
        total = total + np.sum(own**2, axis=0)
    return np.asarray(np.sqrt(np.atleast_1d(total)))


def departed(law: Response, shapes: Mapping[int, Array]) -> tuple[dict[int, Array], Array]:
    """Each law's column times each shape (c, rows of a cell), what is the law itself taken off, as large as the law; and what
    was taken off: by how much each law's coefficients change with a departure as large as the law, (c, laws, laws).
    """
    products: dict[int, Array] = {}
    for cell, own in law.items():
        shape = shapes[cell]
        products[cell] = np.hstack([own * one[:, None] for one in shape])
    width = next(iter(products.values())).shape[1] if products else 0
    count = next(iter(law.values())).shape[1]
    if not width:
        return {}, np.zeros((0, count, count))
    across: Array = np.zeros((count, width))
    gram = np.zeros((len(across), len(across)))
    for cell, own in law.items():
        across = across + own.T @ products[cell]
        gram = gram + own.T @ own
    whole = float(np.sqrt(np.trace(gram) / len(gram)))
    share = np.linalg.lstsq(gram, across, rcond=None)[0]
    rest = {cell: products[cell] - own @ share for cell, own in law.items()}
    sizes = size_of(rest)
    kept = sizes > BENDS_LEAST * whole
    columns = {cell: own[:, kept] * (whole / sizes[kept]) for cell, own in rest.items()} if kept.any() else {}
    taken = share / np.maximum(size_of(products), 1e-300) * whole
    return columns, np.moveaxis(taken.reshape(count, -1, count), 1, 0)
