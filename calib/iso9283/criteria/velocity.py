"""Path velocity characteristics, ISO 9283:1998 clause 8.6: accuracy, repeatability and fluctuation of the speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, norms
from calib.iso9283.criteria.checks import Iso9283Error, above_zero, track
from calib.iso9283.criteria.pose import SIGMAS


@dataclass(frozen=True, slots=True)
class PathVelocity:
    """AV and RV in % of the commanded speed (RV None for a single cycle), FV in m/s; `mean_m_s` attained."""

    accuracy_percent: float
    repeatability_percent: float | None
    fluctuation_m_s: float
    mean_m_s: float


def path_velocity(commanded_m_s: float, speeds_m_s: Sequence[npt.ArrayLike]) -> PathVelocity:
    """AV, RV and FV (clause 8.6) from the speeds of n cycles, each (m_j,) at constant commanded speed.

    v_bar_j = 1/m sum_i v_ij, v_bar = 1/n sum_j v_bar_j; AV = 100 (v_bar - v_c) / v_c;
    RV = +-100 . 3 S_v / v_c, S_v = sqrt(sum_j (v_bar_j - v_bar)^2 / (n - 1)); FV = max_j (max_i v_ij - min_i v_ij).
    """
    wanted = above_zero(commanded_m_s, "path velocity, commanded")
    cycles = [np.asarray(speeds, dtype=np.float64) for speeds in speeds_m_s]
    if not cycles or any(c.ndim != 1 or not len(c) or not np.isfinite(c).all() for c in cycles):
        raise Iso9283Error("path velocity: expected finite speeds of at least one cycle, none of them empty")
    means = np.array([cycle.mean() for cycle in cycles])
    repeatability = 100.0 * SIGMAS * float(means.std(ddof=1)) / wanted if len(means) > 1 else None
    return PathVelocity(
        100.0 * (float(means.mean()) - wanted) / wanted,
        repeatability,
        max(float(cycle.max() - cycle.min()) for cycle in cycles),
        float(means.mean()),
    )


def speeds(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, window_s: float) -> tuple[Array, Array]:
    """Times (m,) and speeds (m,) [m/s]: slopes of straight lines fitted to the positions within `window_s`.

    A position noise of s per axis leaves about s sqrt(12 / w) / window_s per axis with w samples in the window.
    """
    times, tips = track(time_s, tip_m, "speed along the path", least=3)
    period = float(np.median(np.diff(times)))
    width = max(2, min(len(times), 1 + round(above_zero(window_s, "speed window") / period)))
    t = np.lib.stride_tricks.sliding_window_view(times, width)
    p = np.lib.stride_tricks.sliding_window_view(tips, width, axis=0)
    centre = t.mean(axis=1)
    off = t - centre[:, None]
    slope = np.einsum("iw,iaw->ia", off, p) / np.einsum("iw,iw->i", off, off)[:, None]
    return centre, norms(slope)
