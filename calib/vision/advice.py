"""What the pictures of a lens calibration lack: parts of the picture, tilts, distances, sharpness, light, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from calib.arrays import Array
from calib.vision.intrinsics import LensFit, SeenPicture, TILT_rad

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
    found = [
        _about_count(fit),
        _about_coverage(fit),
        *_about_tilt(fit.seen),
        _about_distance(fit.seen),
        _named(
            fit.seen,
            lambda one: one.sighting.blur_px > BLUR_MOST_px,
            "blurred: hold the board still, add light, focus once and keep it",
        ),
        _named(
            fit.seen,
            lambda one: one.sighting.contrast < CONTRAST_LEAST,
            "pale: add light, avoid reflections on the print",
        ),
        _about_outliers(fit.seen),
        *_about_result(fit),
    ]
    return tuple(sentence for sentence in found if sentence)


def uncovered(fit: LensFit) -> tuple[str, ...]:
    """Names of those of 3 x 3 parts of the picture that show too few corners."""
    pixels = np.concatenate([one.sighting.corners.picture_px for one in fit.seen])
    column = np.clip((CELLS * pixels[:, 0] / fit.lens.width_px).astype(int), 0, CELLS - 1)
    row = np.clip((CELLS * pixels[:, 1] / fit.lens.height_px).astype(int), 0, CELLS - 1)
    count = np.bincount(CELLS * row + column, minlength=CELLS**2)
    return tuple(f"{ROWS[k // CELLS]} {COLUMNS[k % CELLS]}" for k in np.flatnonzero(count < CORNERS_A_CELL))


def _about_count(fit: LensFit) -> str:
    if len(fit.seen) < PICTURES_WANTED:
        without = f" (no board in {_listed(fit.unseen)})" if fit.unseen else ""
        return f"{len(fit.seen)} pictures show the board{without}: take at least {PICTURES_WANTED}"
    return f"no board found in {_listed(fit.unseen)}: not used" if fit.unseen else ""


def _about_coverage(fit: LensFit) -> str:
    missing = uncovered(fit)
    if not missing:
        return ""
    return f"few corners in parts of the picture: {', '.join(missing)}; hold the board there: distortion is unknown there"


def _about_tilt(seen: Sequence[SeenPicture]) -> list[str]:
    tilts = np.abs([one.tilt for one in seen])
    found = []
    for axis, name, way in ((0, "horizontal", "top or bottom"), (1, "vertical", "left or right edge")):
        count = int(np.sum(tilts[:, axis] > TILT_rad))
        if count < TILTED_WANTED:
            found.append(
                f"{count} pictures are tilted by more than {math.degrees(TILT_rad):.0f} deg about the picture's {name} axis: take"
                f" {TILTED_WANTED} or more with the {way} of the board nearer to the camera"
            )
    return found


def _about_distance(seen: Sequence[SeenPicture]) -> str:
    distance = [one.distance_m for one in seen]
    if max(distance) >= DISTANCES_RATIO * min(distance):
        return ""
    return (
        f"all pictures are from {1e3 * min(distance):.0f} to {1e3 * max(distance):.0f} mm: take some much nearer and some"
        " farther, over the range in which the arm works"
    )


def _about_outliers(seen: Sequence[SeenPicture]) -> str:
    middle = float(np.median([one.rms_px for one in seen]))
    return _named(
        seen,
        lambda one: one.rms_px > WORSE_TIMES * middle,
        f"residual above {WORSE_TIMES:.0f} times that of the others: the board moved, or is bent; remove and take again",
    )


def _about_result(fit: LensFit) -> list[str]:
    found = []
    share = float(np.max(fit.lens.sd[:2] / fit.lens.values[:2]))
    if share > FOCAL_SD_MOST:
        found.append(
            f"the focal length is uncertain by {100 * share:.2f} % (standard deviation), {1e3 * share * 0.5:.1f} mm at 0.5 m:"
            " take more pictures, tilted and near"
        )
    bent = systematic_px(fit)
    if bent > fit.lens.noise_px:
        found.append(
            f"residuals of neighbouring corners agree by {bent:.2f} px in one part of the picture: a bent board, or"
            " a lens beyond this model (fish-eye); check that the board is flat"
        )
    if fit.held_out_px is not None and fit.held_out_px > HELD_OUT_TIMES * fit.rms_px:
        found.append(
            f"pictures left out are off by {fit.held_out_px:.2f} px, those of the fit by {fit.rms_px:.2f} px: take more"
        )
    return found


def systematic_px(fit: LensFit) -> float:
    """The largest mean residual of a part (6 x 6) of the picture, less what noise makes of as many corners [px]."""
    pixels = np.concatenate([one.sighting.corners.picture_px for one in fit.seen])
    error = np.concatenate([one.error_px for one in fit.seen])
    cells = 2 * CELLS
    place = np.clip((cells * pixels / [fit.lens.width_px, fit.lens.height_px]).astype(int), 0, cells - 1) @ [
        1,
        cells,
    ]
    largest = 0.0
    for cell in np.unique(place):
        here: Array = error[place == cell]
        if len(here) >= CORNERS_A_CELL:
            noise = 3.0 * fit.lens.noise_px / math.sqrt(len(here))
            largest = max(largest, float(np.abs(here.mean(axis=0)).max()) - noise)
    return largest


def _named(seen: Sequence[SeenPicture], is_so: Callable[[SeenPicture], bool], what: str) -> str:
    names = [one.sighting.name for one in seen if is_so(one)]
    return f"{_listed(names)}: {what}" if names else ""


def _listed(names: Sequence[str]) -> str:
    more = len(names) - NAMED_MOST
    return ", ".join(names[:NAMED_MOST]) + (f" and {more} more" if more > 0 else "")
