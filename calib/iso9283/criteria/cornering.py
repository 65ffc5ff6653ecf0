"""Cornering deviations, ISO 9283:1998 clause 8.5: rounding and overshoot at a sharp corner without a stop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, norms
from calib.iso9283.criteria.checks import Iso9283Error, direction, position, positions


def corner_round_off(corner_m: npt.ArrayLike, attained_m: Sequence[npt.ArrayLike]) -> float:
    """CR (clause 8.5): the least distance from the corner to the attained path, the mean of n cycles.

    CR = 1/n sum_j min_i |p_ij - p_e|; corner_m (3,), each attained path (k, 3). Between samples the path is
    straight.
    """
    corner = position(corner_m, "corner")
    return float(np.mean([_distance_to(corner, path) for path in _paths(attained_m)]))


def corner_overshoot(
    corner_m: npt.ArrayLike,
    first_direction: npt.ArrayLike,
    second_direction: npt.ArrayLike,
    length_m: float,
    attained_m: Sequence[npt.ArrayLike],
) -> float:
    """CO (clause 8.5): the largest distance beyond the second leg, on the far side of the first, mean of n cycles.

    With the second leg as z axis from the corner and the first leg arriving in the negative y half plane,
    CO_j = max_i sqrt(x_i^2 + y_i^2) over samples with y_i > 0 and 0 <= z_i <= length_m, else 0; CO = 1/n sum_j CO_j.
    Directions (3,) are those of travel along the legs.
    """
    corner, along = position(corner_m, "corner"), direction(second_direction, "second leg")
    arriving = position(first_direction, "first leg")
    outward = arriving - (arriving @ along) * along
    if np.linalg.norm(outward) < 1e-9 * np.linalg.norm(arriving):
        raise Iso9283Error("corner: its two legs lie on one line")
    outward = direction(outward, "first leg")
    largest = []
    for path in _paths(attained_m):
        offset = path - corner
        z, y = offset @ along, offset @ outward
        beyond = norms(offset - np.outer(z, along))[(y > 0.0) & (z >= 0.0) & (z <= length_m)]
        largest.append(float(beyond.max()) if len(beyond) else 0.0)
    return float(np.mean(largest))


def _paths(attained_m: Sequence[npt.ArrayLike]) -> list[Array]:
    if not len(attained_m):
        raise Iso9283Error("cornering: needs at least one attained path")
    return [positions(path, "cornering, attained path", least=2) for path in attained_m]


def _distance_to(point: Array, path: Array) -> float:
    """From a point to a polyline."""
    start, step = path[:-1], np.diff(path, axis=0)
    size = np.maximum(np.einsum("ij,ij->i", step, step), 1e-300)
    share = np.clip(np.einsum("ij,ij->i", point - start, step) / size, 0.0, 1.0)
    return float(norms(start + share[:, None] * step - point).min())
