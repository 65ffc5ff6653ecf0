"""A small quadratic programme in a box, by active sets."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arrays import Array

Mask = npt.NDArray[np.bool_]


def step_in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """The d with lower <= d <= upper that minimises gradient . d + d' H d / 2; H (k, k) positive definite.

    Bounded-variable active set (Stark and Parker, Computational Statistics 10, 1995): solve on the free
    variables, stop at the first bound on the way, release the bound whose multiplier has the wrong sign. 0
    must lie in the box.
    """
    d = np.zeros_like(gradient)
    held = ((lower >= 0.0) & (gradient > 0.0)) | ((upper <= 0.0) & (gradient < 0.0))
    for _ in range(20 * len(gradient)):
        target = _free_minimum(hessian, gradient, d, held)
        share, blocking = _way_to_bound(d, target, lower, upper, held)
        d = d + share * (target - d)
        if blocking >= 0:
            d[blocking] = upper[blocking] if target[blocking] > d[blocking] else lower[blocking]
            held[blocking] = True
            continue
        slope = gradient + hessian @ d
        wrong = np.where(held, np.where(d >= upper, slope, -slope), -1.0)
        if np.max(wrong) <= 1e-14 * (1e-300 + float(np.max(np.abs(gradient)))):
            return d
        held[int(np.argmax(wrong))] = False
    return d


def _free_minimum(hessian: Array, gradient: Array, d: Array, held: Mask) -> Array:
    """Minimum over the variables that are not held."""
    target = d.copy()
    free = np.flatnonzero(~held)
    if len(free):
        slope = gradient[free] + hessian[np.ix_(free, np.flatnonzero(held))] @ d[held]
        target[free] = np.linalg.solve(hessian[np.ix_(free, free)], -slope)
    return target


def _way_to_bound(d: Array, target: Array, lower: Array, upper: Array, held: Mask) -> tuple[float, int]:
    """How much of the way from d to target stays inside, and which bound ends it (-1: none)."""
    move = target - d
    room = np.where(move > 0.0, upper - d, lower - d)
    outside = ~held & (np.abs(move) > np.abs(room))
    if not outside.any():
        return 1.0, -1
    shares = np.where(outside, room / np.where(outside, move, 1.0), np.inf)
    first = int(np.argmin(shares))
    return max(0.0, float(shares[first])), first
