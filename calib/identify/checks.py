"""Points that no calibration can be made of are refused before a solver sees them."""

from __future__ import annotations

import math

import numpy as np

from calib.arrays import Array
from calib.errors import UnusablePointsError

POINTS_MINIMUM_COUNT = 4
LINE_TOLERANCE = 5e-3  # spread across the best line, as a share of the spread along it: 1 mm for 0.2 m


def require_usable(q_rad: Array, tip_m: Array, joint_count: int | None = None) -> None:
    """UnusablePointsError that says what is wrong with q_rad (m, n) or tip_m (m, 3), if anything is."""
    if q_rad.ndim != 2 or tip_m.shape != (len(q_rad), 3):
        raise UnusablePointsError(
            f"joint angles {q_rad.shape} and tips {tip_m.shape}: expected (m, n) and (m, 3)"
        )
    if joint_count is not None and q_rad.shape[1] != joint_count:
        raise UnusablePointsError(
            f"the points have {q_rad.shape[1]} joint angles each, the arm has {joint_count} joints"
        )
    _require_finite(q_rad, "joint angle")
    _require_finite(tip_m, "tip position")
    _require_spread(q_rad, tip_m)
    _require_radians(q_rad)


def _require_finite(values: Array, what: str) -> None:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise UnusablePointsError(
            f"{what} of point {bad[0] + 1} (of {len(values)}) is not a finite number ({len(bad)} such)"
        )


def _require_spread(q_rad: Array, tip_m: Array) -> None:
    poses = len(np.unique(np.hstack((q_rad, tip_m)), axis=0))
    if poses < POINTS_MINIMUM_COUNT:
        raise UnusablePointsError(
            f"{poses} different points are too few: take {POINTS_MINIMUM_COUNT} or more, or the whole board"
        )
    spread = np.linalg.svd(tip_m - tip_m.mean(axis=0), compute_uv=False)
    if spread[1] <= LINE_TOLERANCE * spread[0]:
        raise UnusablePointsError(
            "all points lie on one straight line: take some that span an area, such as the circle"
        )


def _require_radians(q_rad: Array) -> None:
    """No joint turns more than three times; beyond, somebody wrote degrees or counts."""
    largest = float(np.max(np.abs(q_rad)))
    if largest > 6 * math.pi:
        joint = int(np.argmax(np.max(np.abs(q_rad), axis=0))) + 1
        raise UnusablePointsError(
            f"q{joint}_rad reaches {largest:.6g}, more than three turns: degrees or counts? Expected radians"
        )
