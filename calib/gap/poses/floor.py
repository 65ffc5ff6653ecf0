"""The noise floor of static poses: what one measurement of the tip scatters by, and who says so."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calib.arrays import Array, Mask
from calib.points.points import Points
from control.model.arm import Arm

SAME_POSE_rad = 0.03
REPEATS_LEAST = 12  # pairs below which a scatter is worth less than the data sheet
QUARTILE = 1.212533  # of chi-square with three degrees of freedom
QUARTILE_CHANCE = (
    3.0 * 0.745
)  # three standard deviations of its root, as a share, times the root of the count
AGREE = 0.2  # share by which two estimates of the same may differ
FINEST_m = 1e-7  # repeats that are closer are copies of each other: no camera or tracker measures finer
SHEET_WORTH = 200  # pairs that a data sheet counts for, where repeats bear it out


@dataclass(frozen=True, slots=True)
class Floor:
    """Standard deviation of one axis of the tip, and where the figure comes from; NaN where nothing tells it.

    `doubt`: the figure's own standard deviation, as a share of it, as far as it rests on repeats.
    """

    tip_m: float
    source: str
    doubt: float = 0.0


def noise_floor(arm: Arm, points: Points, residual_m: Array, out: Mask | None = None) -> Floor:
    """From repeats: poses of one point with the same payload and approach; else from the camera's data sheet.

    residual_m (m, 3) of any fitted model: what it lacks is the same for all repeats of a point, and drops out. `out` (m,):
    poses that do not count.
    """
    groups: dict[tuple[object, ...], list[int]] = {}
    for k in range(len(points)) if out is None else np.flatnonzero(~out).tolist():
        key = (
            points.setup[k],
            points.point[k],
            float(points.payload_kg[k]) if math.isfinite(points.payload_kg[k]) else None,
            *points.direction[k].tolist(),
        )
        groups.setdefault(key, []).append(k)
    pairs = [pair for rows in groups.values() for pair in pairwise(rows) if _is_same_pose(points, *pair)]
    sheet_m = arm.camera.position_noise_m if arm.camera is not None else 0.0
    if len(pairs) < REPEATS_LEAST:
        if sheet_m > 0.0:
            return Floor(sheet_m, "the camera's data sheet in arm.toml; there are too few repeats")
        return Floor(math.nan, "nothing: too few repeats, and no camera noise in arm.toml")
    if sheet_m > 0.0 and not points.direction.any():
        return Floor(
            sheet_m, "the camera's data sheet in arm.toml; repeats whose approach is unknown may hold play"
        )
    apart = residual_m[[a for a, _ in pairs]] - residual_m[[b for _, b in pairs]]
    scatter_m = _scatter_m(apart)
    if scatter_m < FINEST_m:
        copies = f"the {len(pairs)} repeats are copies of each other"
        if sheet_m > 0.0:
            return Floor(sheet_m, f"the camera's data sheet in arm.toml; {copies}")
        return Floor(math.nan, f"nothing: {copies}, and there is no camera noise in arm.toml")
    return _with_sheet(scatter_m, len(pairs), sheet_m)


def _is_same_pose(points: Points, a: int, b: int) -> bool:
    """One place in another posture is no repeat: what the model lacks differs there."""
    return float(np.abs(points.q_rad[a] - points.q_rad[b]).max()) < SAME_POSE_rad


def _with_sheet(scatter_m: float, pairs_count: int, sheet_m: float) -> Floor:
    """The repeats' scatter; where the data sheet agrees with it, both, since some dozen pairs know it to 5 % only."""
    said, doubt = (
        f"{pairs_count} repeats",
        1.0 / math.sqrt(6.0 * pairs_count),
    )  # of a root of 3 squares a pair
    if not abs(scatter_m - sheet_m) <= AGREE * sheet_m:
        return Floor(scatter_m, said, doubt)
    weight = pairs_count / (pairs_count + SHEET_WORTH)
    both = math.sqrt(weight * scatter_m**2 + (1.0 - weight) * sheet_m**2)
    return Floor(both, f"{said} and the camera's data sheet, which agree", weight * doubt)


def _scatter_m(apart_m: Array) -> float:
    """Standard deviation of one axis, from differences (pairs, 3) between two measurements of the same.

    Root mean square, unless the lower quartile says that most of it is not noise: a joint that slips in a session parts half
    of the pairs and must not pass for the floor.
    """
    square = np.einsum("ij,ij->i", apart_m, apart_m) / 2.0
    rms, chance = math.sqrt(float(square.mean()) / 3.0), QUARTILE_CHANCE / math.sqrt(len(square))
    quartile = math.sqrt(float(np.quantile(square, 0.25)) / QUARTILE)
    return rms if rms <= (1.0 + max(AGREE, chance)) * quartile else quartile
