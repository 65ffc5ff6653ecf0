"""Static compliance, ISO 9283:1998 clause 10: how far the tip gives way under a load, with the drives holding."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen
from calib.iso9283.checks import Iso9283Error, positions


def static_compliance(force_N: npt.ArrayLike, tip_m: npt.ArrayLike) -> Array:
    """Displacement per unit load (3, 3) [m/N]: column k is the tip's displacement by one newton along axis k.

    The least-squares slope of displacement over force; the standard loads the three base axes in both directions in
    steps of a tenth of the rated load, three times each. force_N (n, 3), tip_m (n, 3). Columns of axes along which no
    load was put are NaN.
    """
    forces, tips = positions(force_N, "static compliance, force", 2), positions(tip_m, "static compliance", 2)
    if len(forces) != len(tips):
        raise Iso9283Error(f"static compliance: {len(forces)} forces for {len(tips)} positions")
    forces, tips = forces - forces.mean(axis=0), tips - tips.mean(axis=0)
    loaded = np.flatnonzero(np.abs(forces).max(axis=0) > 0.0)
    compliance = np.full((3, 3), np.nan)
    if not len(loaded):
        raise Iso9283Error("static compliance: needs at least two different loads, got one")
    slope, _, rank, _ = np.linalg.lstsq(forces[:, loaded], tips, rcond=None)
    if rank < len(loaded):
        raise Iso9283Error(
            "static compliance: loads along different axes always changed together: load one at a time"
        )
    compliance[:, loaded] = slope.T
    return frozen(compliance)
