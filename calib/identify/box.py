"""Small box-constrained quadratic programmes by active sets."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arrays import Array

Mask = npt.NDArray[np.bool_]
PATIENCE = 3  # exchanges of whole blocks without progress, before variables are exchanged one by one
ROUNDING = 1e-13  # of the largest slope: a smaller multiplier counts as zero


def step_in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """The d with lower <= d <= upper that minimises gradient . d + d' H d / 2; H (k, k) positive definite.

    Block principal pivoting (Judice and Pires, Computers and Operations Research 21 (1994) 587): solve on the free
    variables, then exchange all that are on the wrong side, bound or free, at once; without progress, exchange only
    the last of them, which guarantees termination.
    """
    at_lower, at_upper = (lower >= 0.0) & (gradient > 0.0), (upper <= 0.0) & (gradient < 0.0)
    fewest, patience = len(gradient) + 1, PATIENCE
    d = np.zeros_like(gradient)
    for _ in range(50 * len(gradient)):
        d, slope = _solved(hessian, gradient, np.where(at_lower, lower, upper), at_lower | at_upper)
        rounding = ROUNDING * float(np.max(np.abs(gradient))) + 1e-300
        free = ~(at_lower | at_upper)
        below, above = free & (d < lower), free & (d > upper)
        released = (at_lower & (slope < -rounding)) | (at_upper & (slope > rounding))
        wrong = np.flatnonzero(below | above | released)
        if not len(wrong):
            break
        if len(wrong) < fewest:
            fewest, patience = len(wrong), PATIENCE
        elif patience:
            patience -= 1
        else:
            wrong = wrong[-1:]
        at_lower[wrong], at_upper[wrong] = below[wrong], above[wrong]
    return np.asarray(np.clip(d, lower, upper))


def _solved(hessian: Array, gradient: Array, bound: Array, is_held: Mask) -> tuple[Array, Array]:
    """The minimum over the free variables, and the gradient there; 0 along the free ones."""
    if not is_held.any():
        return _newton(hessian, gradient), np.zeros_like(gradient)
    d = np.where(is_held, bound, 0.0)
    free = np.flatnonzero(~is_held)
    slope = gradient + hessian @ d
    if len(free):
        d[free] = _newton(hessian[free[:, None], free], slope[free])
        slope = gradient + hessian @ d
    return d, slope


def _newton(hessian: Array, gradient: Array) -> Array:
    """The step to the minimum; along what the points do not determine, none."""
    try:
        return np.asarray(np.linalg.solve(hessian, -gradient))
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.lstsq(hessian, -gradient, rcond=None)[0])
