"""What evidence needs of any number of measurements: the Gram matrix of all columns, and how the residual pulls at each."""

from __future__ import annotations

from dataclasses import dataclass

from calib.arrays import Array


@dataclass(frozen=True, slots=True)
class Gram:
    """G (p, p) and h (p,) of tips and of currents, in standard deviations; y'My of the tips, and their degrees of freedom."""

    tip: Array
    pull: Array
    current: Array
    current_pull: Array
    left: float
    freedom: float
