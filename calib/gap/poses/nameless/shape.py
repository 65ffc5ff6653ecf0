"""Shapes without a name: what a residual is tested against, so that an effect that is not in the list is noticed.

They are never reported as effects. Where one of them explains what is left, its words say where the gap is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array, frozen

SIZE_rad = 0.003  # typical, at the shape's own scale
SIZE_m = 0.001
STEPS_COUNT = 24  # of times and of angles where something may have changed
WHOLE_ARM = 0  # in place of a joint: the tip moves, whatever the joints do


@dataclass(frozen=True, slots=True)
class Shape:
    """Columns that move joint `joint` (1-based, or WHOLE_ARM) with `variable`; `words` say so."""

    joint: int
    variable: str
    words: str
    slope_rad: Array
    slope_m: Array | None = None

    @property
    def is_still(self) -> bool:
        """Whether it is constant at these poses."""
        moved = float(np.ptp(self.slope_rad, axis=1).max())
        return moved == 0.0 and (self.slope_m is None or float(np.ptp(self.slope_m, axis=1).max()) == 0.0)


def of_joint(n: int, j: int, variable: str, words: str, *courses: Array) -> Shape:
    """`courses` (m,) scaled to SIZE_rad, acting on joint j (0-based) of n."""
    own = np.eye(n)[j]
    scaled = [SIZE_rad * course / max(1e-12, float(np.abs(course).max())) for course in courses]
    columns = frozen(np.stack([course[:, None] * own for course in scaled]))
    return Shape(j + 1, variable, f"joint {j + 1}: {words}", columns)


def of_tip(n: int, variable: str, words: str, *moves: Array) -> Shape:
    """`moves` (m, 3) of the tip, scaled to SIZE_m; an arm of n joints."""
    scaled = [SIZE_m * move / max(1e-12, float(np.abs(move).max())) for move in moves]
    still = np.zeros((len(moves), len(moves[0]), n))
    return Shape(WHOLE_ARM, variable, words, frozen(still), frozen(np.stack(scaled)))


def edges(values: Array, count: int = STEPS_COUNT) -> Array:
    """Quantiles between which a step is looked for."""
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 2)[1:-1]))


def harmonic(angle: Array, order: float) -> tuple[Array, Array]:
    """Sine and cosine of order times the angle."""
    return np.sin(order * angle), np.cos(order * angle)
