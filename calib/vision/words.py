"""Results of cameras as text for a terminal."""

from __future__ import annotations

import math

import numpy as np

from calib.vision.advice import advice
from calib.vision.intrinsics import LensFit, SeenPicture
from calib.vision.lens import NAMES
from calib.vision.poses import MeasuredPose, PoseSet

REJECTED_NAMED = 8


def lens_text(fit: LensFit) -> str:
    """Residuals first, then the lens, then every picture, then what is missing."""
    lens = fit.lens
    held = "" if fit.held_out_px is None else f"; pictures left out in turn {fit.held_out_px:.3f} px"
    lines = [
        f"{len(fit.seen)} pictures, {sum(len(one.sighting.corners) for one in fit.seen)} corners: residual"
        f" {fit.rms_px:.3f} px (rms distance){held}.",
        f"A corner is found to {lens.noise_px:.3f} px (standard deviation of one axis).",
        "",
        f"{'lens':<8}{'value':>12}{'sd':>11}",
    ]
    for name, value, sd in zip(NAMES, lens.values, lens.sd, strict=True):
        unit = " px" if name in NAMES[:4] else ""
        spread = f"{sd:>11.4f}" if sd > 0.0 else f"{'':>11}  kept: these pictures do not determine it"
        lines.append(f"{name:<8}{value:>12.4f}{spread}{unit}")
    lines += ["", f"{'picture':<20}{'corners':>8}{'px':>8}{'mm away':>9}{'tilt, deg':>14}{'blur px':>9}"]
    lines += [_picture_line(one) for one in fit.seen]
    said = advice(fit)
    lines += (
        ["", *(f"To do: {sentence}." for sentence in said)] if said else ["", "The pictures lack nothing."]
    )
    return "\n".join(lines) + "\n"


def _picture_line(one: SeenPicture) -> str:
    about_x, about_y = (math.degrees(angle) for angle in one.tilt)
    blur = "" if math.isnan(one.sighting.blur_px) else f"{one.sighting.blur_px:.1f}"
    return (
        f"{one.sighting.name[:19]:<20}{len(one.sighting.corners):>8}{one.rms_px:>8.3f}{1e3 * one.distance_m:>9.0f}"
        f"{about_x:>8.0f}{about_y:>6.0f}{blur:>9}"
    )


def poses_text(found: PoseSet) -> str:
    """How many pictures gave a pose, how certain, and why the others did not."""
    lines = [
        f"{len(found.measured)} of {len(found.measured) + len(found.rejected)} pictures give a pose of the target."
    ]
    lines += [
        f"Camera {name}: a corner is found to {noise:.3f} px." for name, noise in found.noise_px.items()
    ]
    lines += [_spread_line("standard deviation, median", found.measured, 0.5)]
    lines += [_spread_line("standard deviation, largest", found.measured, 1.0)]
    lines += [_common_line(found.measured)]
    lines += [f"Not used: {one.name} {one.reason}." for one in found.rejected[:REJECTED_NAMED]]
    if len(found.rejected) > REJECTED_NAMED:
        lines.append(f"Not used: {len(found.rejected) - REJECTED_NAMED} more.")
    return "\n".join(lines) + "\n"


def _spread_line(what: str, measured: tuple[MeasuredPose, ...], share: float) -> str:
    along, across, turn = np.quantile([_spread(one.covariance, one) for one in measured], share, axis=0)
    return f"{what}: {1e3 * across:.3f} mm across the view, {1e3 * along:.3f} mm along it, {1e3 * turn:.2f} mrad."


def _common_line(measured: tuple[MeasuredPose, ...]) -> str:
    along, across, turn = np.median([_spread(one.common, one) for one in measured], axis=0)
    return (
        f"of this, common to all pictures (lens, stands): {1e3 * across:.3f} mm across, {1e3 * along:.3f} mm along,"
        f" {1e3 * turn:.2f} mrad."
    )


def _spread(covariance: np.ndarray, one: MeasuredPose) -> tuple[float, float, float]:
    """Standard deviations along the line of sight, across it, and of the turn about the worst axis."""
    ray = one.pose.position_m / np.linalg.norm(one.pose.position_m)
    position, turn = covariance[:3, :3], covariance[3:, 3:]
    along = float(ray @ position @ ray)
    across = 0.5 * (float(np.trace(position)) - along)
    return (
        math.sqrt(max(along, 0.0)),
        math.sqrt(max(across, 0.0)),
        math.sqrt(max(np.linalg.eigvalsh(turn)[-1], 0.0)),
    )
