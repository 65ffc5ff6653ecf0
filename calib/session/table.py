"""The calibration table in a session and in an identification: points to visit, and reference tips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from calib.arrays import Array
from calib.errors import UnusablePointsError
from calib.points.points import Points, make_points
from calib.session.sequence import BoardPoint

Cavities = Mapping[str, Sequence[float] | Array]


def board_points(setup: str, cavities: Cavities, repeat: int = 1) -> tuple[BoardPoint, ...]:
    """Cavities (name to base-frame position) of a board in `setup`, with its normal."""
    positions = np.array([np.asarray(p, dtype=float) for p in cavities.values()])
    normal = board_normal(positions)
    up = (float(normal[0]), float(normal[1]), float(normal[2]))
    return tuple(
        BoardPoint(setup, name, (float(x), float(y), float(z)), up, repeat)
        for name, (x, y, z) in zip(cavities, positions, strict=True)
    )


def board_normal(positions_m: Array) -> Array:
    """Unit normal of the plane through positions (m, 3), pointing up; z if they span no plane."""
    _, spread, axes = np.linalg.svd(positions_m - positions_m.mean(axis=0), full_matrices=True)
    if len(spread) < 2 or spread[1] < 1e-9:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(axes[2] * (1.0 if axes[2, 2] >= 0.0 else -1.0))


def with_reference_tips(points: Points, cavities_of: Callable[[str], Cavities]) -> Points:
    """Points whose tip was not measured get the cavity that they sat in; `cavities_of` gives a setup's
    cavities.

    UnusablePointsError if neither a measurement nor a cavity is known.
    """
    tip_m = np.array(points.tip_m)
    unmeasured = np.flatnonzero(np.isnan(tip_m).any(axis=1))
    known = {setup: cavities_of(setup) for setup in dict.fromkeys(points.setup[int(k)] for k in unmeasured)}
    for k in map(int, unmeasured):
        setup, point = points.setup[k], points.point[k]
        if point not in known[setup]:
            raise UnusablePointsError(
                f"point {point} of setup {setup} (pose {k + 1}) has no tip, and the table has no such cavity"
            )
        tip_m[k] = known[setup][point]
    return make_points(
        points.setup,
        points.point,
        points.repeat,
        points.q_rad,
        tip_m,
        points.direction,
        points.current_A,
        points.t_s,
        points.payload_kg,
        points.extra,
    )
