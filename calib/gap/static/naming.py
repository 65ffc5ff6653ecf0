"""What was kept, as effects with parameters: geometry first, then one effect more at a time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName, NamedEffect
from calib.gap.poses.candidate import Candidate
from calib.gap.poses.currents import Currents
from calib.gap.poses.floor import Floor
from calib.gap.poses.model import Fitted, fitted, parameters_of
from calib.gap.static.split import Split
from calib.points.points import Points
from control.model.arm import Arm

GEOMETRY_PAYS = 40.0  # mean square of chi-square beyond its count that 16 refitted parameters must gain
KINDS = ("d_m", "theta_rad", "L_m", "alpha_rad")


def stages(
    arm: Arm, points: Points, parts: Split, bare: Fitted, kept: Sequence[Candidate]
) -> list[tuple[str, Fitted]]:
    """Geometry, then one effect more at a time."""
    growing = (kept[: count + 1] for count in range(len(kept)))
    return [
        ("link geometry", bare),
        *((str(some[-1].name), fitted(arm, points, parts.known, some)) for some in growing),
    ]


def named(
    fits: Sequence[tuple[str, Fitted]],
    parts: Split,
    floor: Floor,
    margin: float,
    nominal: Array,
    currents: Currents | None,
) -> tuple[NamedEffect, ...]:
    """The geometry, where the nominal one does not do, and every effect that was kept."""
    final = fits[-1][1]
    found = []
    gained = (rms(nominal, parts.known) ** 2 - fits[0][1].rms_m(parts.known) ** 2) / floor.tip_m**2
    if gained * 3 * parts.known.sum() > GEOMETRY_PAYS:
        gap = fits[0][1].rms_m(parts.report) / floor.tip_m
        found.append(NamedEffect(EffectName("link_geometry"), _geometry(final, parts, floor), gap))
    values = parameters_of(final, parts.known, floor.tip_m, currents)
    for (_, fit), one, parameters in zip(fits[1:], final.chosen, values, strict=True):
        gap = fit.rms_m(parts.report) / floor.tip_m
        found.append(NamedEffect(one.name, parameters, gap, {"margin": margin}))
    return tuple(found)


def _geometry(final: Fitted, parts: Split, floor: Floor) -> dict[str, tuple[float, float]]:
    """The DH deviations under the names of docs/formats.md, with standard deviations; a prior of their bound included."""
    _, jacobian = final.problem.residuals_and_jacobian(final.x)
    base = jacobian[parts.known].reshape(-1, len(final.x)) / floor.tip_m
    covariance = np.linalg.inv(base.T @ base + np.eye(len(final.x)))
    scale = np.array([parameter.scale for parameter in final.problem.parameters])
    sd = np.sqrt(np.diag(covariance)) * scale
    deviation = (final.solution.dh - final.problem.model.nominal_dh).ravel()
    return {
        f"link{k // 4 + 1}_{KINDS[k % 4]}": (float(deviation[k]), float(sd[k])) for k in range(len(deviation))
    }


def rms(residual_m: Array, rows: Mask) -> float:
    """Of one axis, over the poses of a mask (m,)."""
    return float(np.sqrt(np.mean(residual_m[rows] ** 2)))
