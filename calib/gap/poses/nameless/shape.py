"""Shapes without a name: what a residual is tested against, so that an effect that is not in the list is noticed.

They are never reported as effects. Where one of them explains what is left, its words say where the gap is. All shapes of one
thing that moves, one variable and one manner are variants of one block: a joint may do more than one of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.posterior.term import Block, Term, on_joint

SIZE_rad = 0.003  # typical, at the shape's own scale
SIZE_m = 0.001
STEPS_COUNT = 24  # of times and of angles where something may have changed


def of_joint(n: int, j: int, variable: str, words: str, *courses: Array, manner: str = "") -> Term:
    """`courses` (m,) scaled to SIZE_rad, acting on joint j (0-based) of n."""
    scaled = [SIZE_rad * course / max(1e-12, float(np.abs(course).max())) for course in courses]
    key, slope = Block(j + 1, f"{variable} {manner}".strip()), on_joint(np.stack(scaled), j, n)
    return Term(key, f"joint {j + 1}: {words}", len(courses), 0, 1.0, slope_rad=slope)


def smooth_of_joint(n: int, j: int, variable: str, words: str, courses: Array) -> Term:
    """Functions (c, m) of a variable, of one unknown scale, acting on joint j (0-based) of n."""
    slope = SIZE_rad * on_joint(courses, j, n)
    return Term(Block(j + 1, variable), f"joint {j + 1}: {words}", len(courses), 0, 1.0, slope_rad=slope)


def of_tip(
    variable: str,
    words: str,
    *moves: Array,
    manner: str = "",
    beside: Array | None = None,
    turns: Sequence[Array] = (),
) -> Term:
    """`moves` (m, 3) of the tip, whatever the joints do, scaled to SIZE_m; `beside` (c, m, 3): columns that come along.

    `turns` (m, 3) [rad per the move's own unit]: how the last link turns with each move; none: not at all.
    """
    sizes = [SIZE_m / max(1e-12, float(np.abs(move).max())) for move in moves]
    slope = np.stack([size * move for size, move in zip(sizes, moves, strict=True)])
    slope = slope if beside is None else np.concatenate((slope, beside))
    turned = np.zeros_like(slope)
    for k, turn in enumerate(turns):
        turned[k] = sizes[k] * turn
    key = Block(0, f"{variable} {manner}".strip())
    return Term(key, words, len(slope), 0, 1.0, slope_m=slope, turn_rad=turned if turns else None)


def of_turns(variable: str, words: str, turns: Array) -> Term:
    """`turns` (c, m, 3) of the measured orientation alone, of one unknown scale."""
    return Term(Block(0, variable), words, len(turns), 0, 1.0, turn_rad=SIZE_rad * turns)


def is_still(one: Term) -> bool:
    """Whether a shape is constant at these poses."""
    moved = [
        float(np.ptp(slope, axis=1).max())
        for slope in (one.slope_rad, one.slope_m, one.turn_rad)
        if slope is not None
    ]
    return not any(moved)


def edges(values: Array, count: int = STEPS_COUNT) -> Array:
    """Quantiles between which a step is looked for."""
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 2)[1:-1]))


def harmonic(angle: Array, order: float) -> tuple[Array, Array]:
    """Sine and cosine of order times the angle."""
    return np.sin(order * angle), np.cos(order * angle)
