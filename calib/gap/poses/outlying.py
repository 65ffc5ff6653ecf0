"""Poses that no model explains and that are few: swapped rows, a marker that was lost. They are left out, and said.

Looked for beside everything that the list knows, fitted at once, so that a joint's play is no outlier; and only where the rest
agrees, so that an effect that nobody knows is none either.
"""

from __future__ import annotations

import numpy as np

from calib.arrays import Array, Mask, norms
from calib.gap.poses.linear import Linear

FAR = 7.0  # times the scatter of the others
SHARE_MOST = 0.05  # more than these are no outliers but another arm
LOOKS = 8
MEDIAN = 1.5382  # of the length of three unit normals


def outlying(linear: Linear, noise_m: float) -> Mask:
    """The poses (m,) that are to be left out; none where many or none are far off. noise_m: a first idea of it."""
    whole, y = np.hstack((linear.base, linear.columns)) / noise_m, linear.y / noise_m
    count = len(y) // 3
    out = np.zeros(count, dtype=bool)
    for _ in range(LOOKS):
        left = norms(_left(whole, y, np.repeat(~out, 3)).reshape(-1, 3))
        scatter = float(np.median(left)) / MEDIAN
        now = left > FAR * max(scatter, 1.0)  # few poses are fitted too well
        if (now == out).all():
            break
        out = now
    return out if out.mean() <= SHARE_MOST else np.zeros(count, dtype=bool)


def _left(columns: Array, y: Array, keep: Mask) -> Array:
    """What a ridge over the rows `keep` leaves of all rows."""
    some = columns[keep]
    inner = some.T @ some + np.eye(columns.shape[1])
    return np.asarray(y - columns @ np.linalg.solve(inner, some.T @ y[keep]))
