"""Measured maps of an arm along many poses or samples: the controller's spline as arrays, and as what is linear in its unknowns.

A table's spline is a sum of uniform cubic B-splines, one a node, mirrored at the ends (de Boor, A Practical Guide to Splines,
ch. IX).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calib.arrays import Array
from control.kinematics.smooth_table import pieces
from control.model.maps import CorrectionMap

if TYPE_CHECKING:
    from scipy import sparse


def spline_columns(count: int, lower: float, upper: float, is_periodic: bool, x: Array) -> sparse.csr_array:
    """What the B-spline of each node does at places x (m,), (m, count)."""
    from scipy import sparse

    piece, t = _place(count, lower, upper, is_periodic, x)
    weights = (
        np.array(
            [(1.0 - t) ** 3, 3.0 * t**3 - 6.0 * t**2 + 4.0, -3.0 * t**3 + 3.0 * t**2 + 3.0 * t + 1.0, t**3]
        )
        / 6.0
    )
    nodes = piece + np.arange(-1, 3)[:, None]
    rows = np.broadcast_to(np.arange(len(x)), nodes.shape)
    return sparse.csr_array(
        (weights.ravel(), (rows.ravel(), _inside(nodes, count, is_periodic).ravel())), (len(x), count)
    )


def node_values(coefficients: Array, is_periodic: bool) -> Array:
    """A table's values at its nodes from the coefficients of their B-splines."""
    count = len(coefficients)
    beside = _inside(np.arange(count) + np.array([[-1], [0], [1]]), count, is_periodic)
    return np.asarray(np.array([1.0, 4.0, 1.0]) / 6.0 @ coefficients[beside])


def along(one: CorrectionMap, x: Array, direction: Array) -> Array:
    """What a map adds at x (m,), with the direction of motion (m,), -1 to 1."""
    piece, t = _place(len(one.values), one.lower, one.upper, one.is_periodic, x)
    added = _value(one.values, one.is_periodic, piece, t)
    if one.by_direction:
        added = added + direction * _value(one.by_direction, one.is_periodic, piece, t)
    return added


def _value(values: tuple[float, ...], is_periodic: bool, piece: Array, t: Array) -> Array:
    a, b, c, d = np.array(pieces(values, is_periodic))[piece].T
    return np.asarray(a + t * (b + t * (c + t * d)))


def _place(count: int, lower: float, upper: float, is_periodic: bool, x: Array) -> tuple[Array, Array]:
    """Piece of each x and place in it, 0 to 1; beyond its ends a table is its end."""
    steps = count if is_periodic else count - 1
    at = (x - lower) * (steps / (upper - lower))
    at = np.mod(at, count) if is_periodic else np.clip(at, 0.0, steps)
    piece = np.minimum(at.astype(np.intp), steps - 1)
    return piece, at - piece


def _inside(nodes: Array, count: int, is_periodic: bool) -> Array:
    """Nodes beyond the ends as those that stand for them."""
    if is_periodic:
        return np.asarray(nodes % count)
    last = count - 1
    return np.asarray(last - np.abs(last - np.abs(nodes)))
