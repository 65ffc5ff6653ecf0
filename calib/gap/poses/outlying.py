"""Poses that no model explains and that are few: swapped rows, a marker that was lost. They are left out, and said.

Looked for beside everything that the list knows, fitted at once, so that a joint's play is no outlier; and only where the rest
agrees, so that an effect that nobody knows is none either. Which flank a loose gear lies on is not known at a few poses: of all
its variants the one counts that leaves the fewest poses out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.poses.linear import Linear, moved_by
from calib.gap.posterior.term import Term

FAR = 7.0  # times the scatter of the others
SHARE_MOST = 0.05  # more than these are no outliers but another arm
LOOKS = 8
MEDIAN = 1.5382  # of the length of three unit normals


def outlying(linear: Linear, variants: Sequence[Sequence[Term]], by_joint: Array, noise_m: float) -> Mask:
    """The poses (m,) that are to be left out; none where many or none are far off.

    `variants` of each term of `linear`, which has the middle ones; by_joint (m, 3, n): how the tip follows each joint;
    noise_m: a first idea of the noise.
    """
    terms, columns = [middle(same) for same in variants], linear.columns
    out = _far(linear, columns, terms, by_joint, noise_m)
    if not 0.0 < out.mean() <= SHARE_MOST:
        return np.zeros_like(out)
    for number, same in enumerate(variants):
        for one in same if len(same) > 1 else ():
            tried, others = columns.copy(), [*terms[:number], one, *terms[number + 1 :]]
            tried[:, linear.places[number]] = moved_by(one, by_joint).reshape(one.count, -1).T
            far = _far(linear, tried, others, by_joint, noise_m)
            if far.sum() < out.sum():
                out, columns, terms = far, tried, others
    return out


def middle(variants: Sequence[Term]) -> Term:
    """The variant that is tried first."""
    return variants[len(variants) // 2]


def _far(linear: Linear, columns: Array, terms: Sequence[Term], by_joint: Array, noise_m: float) -> Mask:
    """Poses (m,) that columns (3m, p) beside the geometry leave far off, both fitted to the other poses."""
    whole, y = np.hstack((linear.base, columns)) / noise_m, linear.y / noise_m
    out = np.zeros(len(y) // 3, dtype=bool)
    for _ in range(LOOKS):
        keep = np.repeat(~out, 3)
        size = _fitted(whole[keep], y[keep])
        left = (y - whole @ size).reshape(-1, 3)
        flanks = _uncertain(linear, terms, size[linear.base.shape[1] :], by_joint / noise_m)
        far = np.sqrt(np.einsum("mi,mij,mj->m", left, np.linalg.inv(np.eye(3) + flanks), left))
        scatter = float(np.median(far)) / MEDIAN
        now = far > FAR * max(scatter, 1.0)  # few poses are fitted too well
        if (now == out).all():
            break
        out = now
    return out


def _uncertain(linear: Linear, terms: Sequence[Term], size: Array, by_joint: Array) -> Array:
    """Covariance (m, 3, 3) of the tip, in variances of the noise, from gears that may lie on the other flank."""
    total = np.zeros((len(by_joint), 3, 3))
    for one, place in zip(terms, linear.places, strict=True):
        if one.doubt is not None and isinstance(one.key, EffectName) and one.key.joint is not None:
            lever = by_joint[:, :, one.key.joint - 1] * (one.size * size[place.start])
            total += one.doubt[:, None, None] * lever[:, :, None] * lever[:, None, :]
    return total


def _fitted(columns: Array, y: Array) -> Array:
    """Coefficients of a ridge."""
    return np.asarray(np.linalg.solve(columns.T @ columns + np.eye(columns.shape[1]), columns.T @ y))
