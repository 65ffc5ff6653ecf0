"""What the pictures of a lens calibration lack (parts, tilts, distances, sharpness, light), and results of cameras as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from calib.arrays import Array
from calib.vision.intrinsics import LensFit, SeenPicture, TILT_rad
from calib.vision.lens import NAMES
from calib.vision.poses import MeasuredPose, PoseSet
from control.plain_text import aligned, first_of

PICTURES_WANTED = 15
CELLS = 3  # rows and columns of the picture that each need corners
CORNERS_A_CELL = 8
TILTED_WANTED = 4  # pictures each way: focal length and distance are told apart by perspective alone
DISTANCES_RATIO = 1.4
BLUR_MOST_px = 1.8
CONTRAST_LEAST = 60.0  # of 255
FOCAL_SD_MOST = 0.002  # of the focal length: 1 mm at 0.5 m
WORSE_TIMES = 3.0  # than the median picture
HELD_OUT_TIMES = 1.5
NAMED_MOST = 6

ROWS = ("upper", "middle", "lower")
COLUMNS = ("left", "centre", "right")


def advice(fit: LensFit) -> tuple[str, ...]:
    """One sentence for each thing that the pictures lack; none if they lack nothing."""
    lacks = [
        _about_count(fit),
        _about_coverage(fit),
        *_about_tilt(fit.seen),
        _about_distance(fit.seen),
        _named(
            fit.seen,
            lambda shot: shot.sighting.blur_px > BLUR_MOST_px,
            "blurred: hold the board still, add light, focus once and keep it",
        ),
        _named(fit.seen, lambda shot: shot.sighting.contrast < CONTRAST_LEAST, "pale: add light, avoid reflections on the print"),
        _about_outliers(fit.seen),
        *_about_result(fit),
    ]
    return tuple(sentence for sentence in lacks if sentence)


def uncovered(fit: LensFit) -> tuple[str, ...]:
    """Names of those of 3 x 3 parts of the picture that show too few corners."""
    pixels = np.concatenate([one.sighting.corners.picture_px for one in fit.seen])
    column = np.clip((CELLS * pixels[:, 0] / fit.lens.width_px).astype(int), 0, CELLS - 1)
    row = np.clip((CELLS * pixels[:, 1] / fit.lens.height_px).astype(int), 0, CELLS - 1)
    count = np.bincount(CELLS * row + column, minlength=CELLS**2)
    return tuple(f"{ROWS[k // CELLS]} {COLUMNS[k % CELLS]}" for k in np.flatnonzero(count < CORNERS_A_CELL))


def _about_count(fit: LensFit) -> str:
    if len(fit.seen) < PICTURES_WANTED:
        without = f" (no board in {first_of(fit.unseen, NAMED_MOST)})" if fit.unseen else ""
        return f"{len(fit.seen)} pictures show the board{without}: take at least {PICTURES_WANTED}"
    return f"no board found in {first_of(fit.unseen, NAMED_MOST)}: not used" if fit.unseen else ""


def _about_coverage(fit: LensFit) -> str:
    missing = uncovered(fit)
    if not missing:
        return ""
    return f"few corners in parts of the picture: {', '.join(missing)}; hold the board there: distortion is unknown there"


def _about_tilt(seen: Sequence[SeenPicture]) -> list[str]:
    tilts = np.abs([one.tilt for one in seen])
    lacks = []
    for axis, name, way in ((0, "horizontal", "top or bottom"), (1, "vertical", "left or right edge")):
        count = int(np.sum(tilts[:, axis] > TILT_rad))
        if count < TILTED_WANTED:
            lacks.append(
                f"{count} pictures are tilted by more than {math.degrees(TILT_rad):.0f} deg about the picture's {name} axis: take"
                f" {TILTED_WANTED} or more with the {way} of the board nearer to the camera"
            )
    return lacks


def _about_distance(seen: Sequence[SeenPicture]) -> str:
    distance = [one.distance_m for one in seen]
    if max(distance) >= DISTANCES_RATIO * min(distance):
        return ""
    return (
        f"all pictures are from {1e3 * min(distance):.0f} to {1e3 * max(distance):.0f} mm: take some much nearer and some"
        " farther, over the range in which the arm works"
    )


def _about_outliers(seen: Sequence[SeenPicture]) -> str:
    middle = float(np.median([shot.rms_px for shot in seen]))
    return _named(
        seen,
        lambda shot: shot.rms_px > WORSE_TIMES * middle,
        f"residual above {WORSE_TIMES:.0f} times that of the others: the board moved, or is bent; remove and take again",
    )


def _about_result(fit: LensFit) -> list[str]:
    lacks = []
    share = float(np.max(fit.lens.sd[:2] / fit.lens.values[:2]))
    if share > FOCAL_SD_MOST:
        lacks.append(
            f"the focal length is uncertain by {100 * share:.2f} % (standard deviation), {1e3 * share * 0.5:.1f} mm at 0.5 m:"
            " take more pictures, tilted and near"
        )
    bent = systematic_px(fit)
    if bent > fit.lens.noise_px:
        lacks.append(
            f"residuals of neighbouring corners agree by {bent:.2f} px in one part of the picture: a bent board, or"
            " a lens beyond this model (fish-eye); check that the board is flat"
        )
    if fit.held_out_px is not None and fit.held_out_px > HELD_OUT_TIMES * fit.rms_px:
        lacks.append(f"pictures left out are off by {fit.held_out_px:.2f} px, those of the fit by {fit.rms_px:.2f} px: take more")
    return lacks


def systematic_px(fit: LensFit) -> float:
    """The largest mean residual of a part (6 x 6) of the picture, less what noise makes of as many corners [px]."""
    pixels = np.concatenate([one.sighting.corners.picture_px for one in fit.seen])
    error = np.concatenate([one.error_px for one in fit.seen])
    cells = 2 * CELLS
    place = np.clip((cells * pixels / [fit.lens.width_px, fit.lens.height_px]).astype(int), 0, cells - 1) @ [1, cells]
    largest = 0.0
    for cell in np.unique(place):
        here: Array = error[place == cell]
        if len(here) >= CORNERS_A_CELL:
            noise = 3.0 * fit.lens.noise_px / math.sqrt(len(here))
            largest = max(largest, float(np.abs(here.mean(axis=0)).max()) - noise)
    return largest


def _named(seen: Sequence[SeenPicture], is_so: Callable[[SeenPicture], bool], what: str) -> str:
    names = [one.sighting.name for one in seen if is_so(one)]
    return f"{first_of(names, NAMED_MOST)}: {what}" if names else ""


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
    ]
    rows = [("lens", "value", "sd")]
    for name, value, sd in zip(NAMES, lens.values, lens.sd, strict=True):
        unit = " px" if name in NAMES[:4] else ""
        rows.append((f"{name}{unit}", f"{value:.4f}", f"{sd:.4f}" if sd > 0.0 else "not determined: kept"))
    pictures = [("picture", "corners", "px", "mm away", "tilt, deg", "blur px"), *map(_picture, fit.seen)]
    lines += [aligned(rows), "", aligned(pictures)]
    said = advice(fit)
    lines += ["", *(f"To do: {sentence}." for sentence in said)] if said else ["", "The pictures lack nothing."]
    return "\n".join(lines) + "\n"


def _picture(shot: SeenPicture) -> tuple[str, ...]:
    tilt = " ".join(f"{math.degrees(angle):4.0f}" for angle in shot.tilt)
    blur = "" if math.isnan(shot.sighting.blur_px) else f"{shot.sighting.blur_px:.1f}"
    corners = str(len(shot.sighting.corners))
    return (shot.sighting.name, corners, f"{shot.rms_px:.3f}", f"{1e3 * shot.distance_m:.0f}", tilt, blur)


def poses_text(poses: PoseSet) -> str:
    """How many pictures gave a pose, how certain, and why the others did not."""
    lines = [f"{len(poses.measured)} of {len(poses.measured) + len(poses.rejected)} pictures give a pose of the target."]
    lines += [f"Camera {name}: a corner is found to {noise:.3f} px." for name, noise in poses.noise_px.items()]
    lines += [_spread_line("standard deviation, median", poses.measured, 0.5)]
    lines += [_spread_line("standard deviation, largest", poses.measured, 1.0)]
    lines += [_common_line(poses.measured)]
    lines += [f"Not used: {one.name} {one.reason}." for one in poses.rejected[:REJECTED_NAMED]]
    if len(poses.rejected) > REJECTED_NAMED:
        lines.append(f"Not used: {len(poses.rejected) - REJECTED_NAMED} more.")
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


def _spread(covariance: np.ndarray, measured: MeasuredPose) -> tuple[float, float, float]:
    """Standard deviations along the line of sight, across it, and of the turn about the worst axis."""
    ray = measured.pose.position_m / np.linalg.norm(measured.pose.position_m)
    position, turn = covariance[:3, :3], covariance[3:, 3:]
    along = float(ray @ position @ ray)
    across = 0.5 * (float(np.trace(position)) - along)
    return (math.sqrt(max(along, 0.0)), math.sqrt(max(across, 0.0)), math.sqrt(max(np.linalg.eigvalsh(turn)[-1], 0.0)))
