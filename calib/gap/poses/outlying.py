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
from calib.gap.poses.linear import Linear
from calib.gap.poses.measured import Measured
from calib.gap.posterior.term import Term

FAR = 7.0  # times the scatter of the others
SHARE_MOST = 0.05  # more than these are no outliers but another arm
LOOKS = 8
MEDIAN = 1.5382  # of the length of three unit normals


def outlying(linear: Linear, variants: Sequence[Sequence[Term]], noise_m: float) -> Mask:
    """The poses (m,) that are to be left out; none where many or none are far off.

    `variants` of each term of `linear`, which has the middle ones; noise_m: a first idea of the noise.
    """
    terms, columns = [middle(same) for same in variants], linear.columns
    out = _far(linear, columns, terms, noise_m)
    if not 0.0 < out.mean() <= SHARE_MOST:
        return np.zeros_like(out)
    for number, same in enumerate(variants):
        for one in same if len(same) > 1 else ():
            tried, others = columns.copy(), [*terms[:number], one, *terms[number + 1 :]]
            tried[:, linear.places[number]] = linear.measured.moved_by(one).reshape(one.count, -1).T
            far = _far(linear, tried, others, noise_m)
            if far.sum() < out.sum():
                out, columns, terms = far, tried, others
    return out


def middle(variants: Sequence[Term]) -> Term:
    """The variant that is tried first."""
    return variants[len(variants) // 2]


def _far(linear: Linear, columns: Array, terms: Sequence[Term], noise_m: float) -> Mask:
    """Poses (m,) that columns (3R, p) beside the geometry leave far off, both fitted to the other poses."""
    whole, y, pose = np.hstack((linear.base, columns)) / noise_m, linear.y / noise_m, linear.measured.pose
    out = np.zeros(int(pose.max()) + 1, dtype=bool)
    kinds = np.arange(len(pose)) < len(out)  # of tips; the other rows are orientations
    for _ in range(LOOKS):
        keep = np.repeat(~out[pose], 3)
        size = _fitted(whole[keep], y[keep])
        left = (y - whole @ size).reshape(-1, 3)
        flanks = _uncertain(linear, terms, size[linear.base.shape[1] :], noise_m)
        far = np.sqrt(np.einsum("mi,mij,mj->m", left, np.linalg.inv(np.eye(3) + flanks), left))
        now = np.zeros_like(out)
        for kind in (kinds, ~kinds) if not kinds.all() else (kinds,):
            scatter = float(np.median(far[kind])) / MEDIAN
            now[pose[kind][far[kind] > FAR * max(scatter, 1.0)]] = True  # few poses are fitted too well
        if (now == out).all():
            break
        out = now
    return out


def _uncertain(linear: Linear, terms: Sequence[Term], size: Array, noise_m: float) -> Array:
    """Covariance (R, 3, 3) of the rows, in variances of the noise, from gears that may lie on the other flank."""
    measured = linear.measured
    total = np.zeros((len(measured.pose), 3, 3))
    for one, place in zip(terms, linear.places, strict=True):
        total += flank_covariance(measured, one, float(size[place.start]) / noise_m)
    return total


def flank_covariance(measured: Measured, one: Term, coefficient: float) -> Array:
    """Covariance (R, 3, 3) of rows whose joint may lie on the other flank; 0 where nothing is uncertain."""
    if one.doubt is None or not isinstance(one.key, EffectName) or one.key.joint is None:
        return np.zeros((1, 3, 3))
    lever = measured.by_joint[:, :, one.key.joint - 1] * (one.size * coefficient)
    return np.asarray(one.doubt[measured.pose, None, None] * lever[:, :, None] * lever[:, None, :])


def _fitted(columns: Array, y: Array) -> Array:
    """Coefficients of a ridge."""
    return np.asarray(np.linalg.solve(columns.T @ columns + np.eye(columns.shape[1]), columns.T @ y))
