"""A term of the series' model: an effect or a nameless block in one variant, as what it does to the rows of every channel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.arrays import Array
from calib.gap.posterior.constants import BLOCK_PRIOR, NAME_PRIOR
from calib.gap.posterior.term import Term
from calib.gap.series.constants import BENDS_LEAST, COMMON_PRIOR
from calib.gap.series.scene import Response
from calib.gap.signals.terms import Term as Law


@dataclass(frozen=True, slots=True)
class SeriesTerm(Term):
    """Columns by cell, each (its rows, c): laws first, then departures, then nuisances, as of every Term.

    `law`: the physics' term for coefficients (c,) of all columns, in usual sizes; None for blocks.
    """

    response: Response = field(default_factory=dict)
    width: int = 0
    law: Callable[[Array], Law] | None = None
    now: Array | None = None  # coefficients at which the model of this linearisation has it
    is_common: bool = False  # every gear has it, and the file says nothing of it

    @property
    def count(self) -> int:
        """How many columns."""
        return self.width

    @property
    def log_odds(self) -> float:
        """Of its key, before any data."""
        prior = COMMON_PRIOR if self.is_common else NAME_PRIOR if self.is_name else BLOCK_PRIOR
        return float(np.log(prior / (1.0 - prior)))


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


def departed(law: Response, shapes: Mapping[int, Array]) -> dict[int, Array]:
    """Each law's column times each shape (c, rows of a cell), what is the law itself taken off, as large as the law."""
    products: dict[int, Array] = {}
    for cell, own in law.items():
        shape = shapes[cell]
        products[cell] = np.hstack([own * one[:, None] for one in shape])
    width = next(iter(products.values())).shape[1] if products else 0
    if not width:
        return {}
    across: Array = np.zeros((next(iter(law.values())).shape[1], width))
    gram = np.zeros((len(across), len(across)))
    for cell, own in law.items():
        across = across + own.T @ products[cell]
        gram = gram + own.T @ own
    whole = float(np.sqrt(np.trace(gram) / len(gram)))
    share = np.linalg.lstsq(gram, across, rcond=None)[0]
    rest = {cell: products[cell] - own @ share for cell, own in law.items()}
    sizes = size_of(rest)
    kept = sizes > BENDS_LEAST * whole
    return {cell: own[:, kept] * (whole / sizes[kept]) for cell, own in rest.items()} if kept.any() else {}
