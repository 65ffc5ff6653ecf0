"""Static compliance, ISO 9283:1998 clause 10: displacement of the tip under a load, with the drives holding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.iso9283.criteria.checks import Iso9283Error, positions


@dataclass(frozen=True, slots=True)
class Compliance:
    """Displacement per unit load (3, 3) [m/N]: column k is the tip's displacement by one newton along axis k.

    `sd_m_N` (3, 3): standard deviation of each, from the residuals of the fit; NaN without residuals.
    Columns of axes without loads are NaN.
    """

    m_N: Array
    sd_m_N: Array


def static_compliance(force_N: npt.ArrayLike, tip_m: npt.ArrayLike) -> Compliance:
    """The least-squares slope of displacement over force (clause 10).

    The standard loads the three base axes in both directions in steps of a tenth of the rated load, three times each.
    force_N (n, 3), tip_m (n, 3).
    """
    forces, tips = positions(force_N, "static compliance, force", 2), positions(tip_m, "static compliance", 2)
    if len(forces) != len(tips):
        raise Iso9283Error(f"static compliance: {len(forces)} forces for {len(tips)} positions")
    forces, tips = forces - forces.mean(axis=0), tips - tips.mean(axis=0)
    loaded = np.flatnonzero(np.abs(forces).max(axis=0) > 0.0)
    if not len(loaded):
        raise Iso9283Error("static compliance: needs at least two different loads, got one")
    slope, _, rank, _ = np.linalg.lstsq(forces[:, loaded], tips, rcond=None)
    if rank < len(loaded):
        raise Iso9283Error(
            "static compliance: loads along different axes always changed together: load one axis at a time"
        )
    compliance, sd = np.full((3, 3), np.nan), np.full((3, 3), np.nan)
    compliance[:, loaded] = slope.T
    freedom = len(tips) - 1 - len(loaded)
    if freedom > 0:
        left = tips - forces[:, loaded] @ slope
        per_force = np.diag(np.linalg.inv(forces[:, loaded].T @ forces[:, loaded]))
        sd[:, loaded] = np.sqrt(np.outer((left**2).sum(axis=0) / freedom, per_force))
    return Compliance(frozen(compliance), frozen(sd))
