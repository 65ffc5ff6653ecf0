"""What is left when everything named is in the model: a test against shapes that have no name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Mask
from calib.gap.poses.evidence import Evidence
from calib.gap.poses.model import Fitted
from calib.gap.poses.shape import Shape
from calib.gap.static.linearised import Linearised

CLEAR = 9.0  # log evidence, some 700 shapes being tried: by chance once in a thousand data sets


@dataclass(frozen=True, slots=True)
class Remainder:
    """A shape that explains something of what is left: its log evidence, and the mean square that it takes away."""

    shape: Shape
    evidence: float
    square: float


def remainders(fit: Fitted, rows: Mask, shapes: Sequence[Shape], noise_m: float) -> list[Remainder]:
    """Shapes that clearly pay beside the fitted model, best first."""
    around = Linearised.around(fit.problem, fit.x, noise_m)
    keep = np.repeat(fit.sure(rows), 3)
    columns = [around.columns(shape)[keep] for shape in shapes]
    ends = np.cumsum([column.shape[1] for column in columns])
    evidence = Evidence.of(around.base[keep], np.concatenate(columns, axis=1), around.y[keep])
    found = []
    for shape, column, end in zip(shapes, columns, ends, strict=True):
        places = range(end - column.shape[1], end)
        paid = evidence.log(places)
        if paid > CLEAR:
            square = (evidence.left - evidence.left_with(places)) / evidence.count
            found.append(Remainder(shape, paid, float(square)))
    return sorted(found, key=lambda one: -one.evidence)
