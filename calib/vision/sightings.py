"""What pictures show of a target: its corners, and how sharp and how well lit they are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.errors import VisionError
from calib.vision.opencv import Picture, read_picture
from calib.vision.targets import PrintedTarget, SeenCorners
from control.progress import Advance, silent

TRIED = 10  # pictures that are looked at again
AROUND_px = 8  # of a corner: the part of the picture in which sharpness is judged


@dataclass(frozen=True, slots=True)
class Sighting:
    """The target in one picture. blur_px: standard deviation of the blur; contrast: ink to paper, in grey levels of 255."""

    name: str
    corners: SeenCorners
    blur_px: float
    contrast: float


@dataclass(frozen=True, slots=True)
class Sightings:
    """Pictures of one camera: those with the target, and the names of those without enough of it.

    remedy: the option with which pictures show the target that show none of it as it was given; "" if there is no such option.
    """

    width_px: int
    height_px: int
    seen: tuple[Sighting, ...]
    unseen: tuple[str, ...]
    remedy: str = ""


def look_for(
    target: PrintedTarget, files: Sequence[Path], least: int, advance: Advance = silent
) -> Sightings:
    """Find a target in pictures of one camera; fewer than `least` corners do not count.

    VisionError for an unreadable picture, pictures of several sizes, or two with one name.
    """
    seen, unseen, size, first = [], [], (0, 0), files[0]
    names = [file.stem for file in files]
    for name in names:
        if names.count(name) > 1:
            raise VisionError(f"{first.parent}: two pictures are called {name}, with other endings: keep one")
    for k, file in enumerate(files):
        advance(f"looking at {file.name}", k / len(files))
        picture = read_picture(file)
        if k == 0:
            size = picture.shape
        if picture.shape != size:
            raise VisionError(
                f"{file}: {picture.shape[1]} x {picture.shape[0]} pixels, {first.name} has {size[1]} x {size[0]}: give"
                " pictures of one camera with one resolution, not turned"
            )
        corners = target.find(picture)
        if len(corners) < least or not _spans(corners):
            unseen.append(file.stem)
        else:
            seen.append(Sighting(file.stem, corners, *sharpness(picture, corners.picture_px)))
    advance("looking at pictures", 1.0)
    remedy = "" if seen else _remedy(target, files, least)
    return Sightings(size[1], size[0], tuple(seen), tuple(unseen), remedy)


def _remedy(target: PrintedTarget, files: Sequence[Path], least: int) -> str:
    """With which option most pictures, of some that are spread evenly, show the target."""
    some = files[:: max(1, len(files) // TRIED)]
    shown = {
        option: sum(len(other.find(read_picture(file))) >= least for file in some)
        for option, other in target.others.items()
    }
    best = max(shown, key=lambda option: shown[option], default="")
    return f"{best}, {shown[best]} of {len(some)} pictures show it" if best and shown[best] else ""


def sharpness(picture: Picture, pixels: Array) -> tuple[float, float]:
    """Blur and contrast at corners (k, 2), median over them.

    A step of height C blurred by a normal distribution of standard deviation s has the largest slope C / (s sqrt(2 pi)).
    """
    blurs, contrasts = [], []
    for u, v in np.rint(pixels).astype(int).tolist():
        patch = picture[max(0, v - AROUND_px) : v + AROUND_px + 1, max(0, u - AROUND_px) : u + AROUND_px + 1]
        if min(patch.shape) <= AROUND_px:
            continue
        dark, light = np.percentile(patch, (5, 95))
        down, right = np.gradient(patch.astype(float))
        steepest = float(np.percentile(np.hypot(down, right), 98))
        contrasts.append(float(light - dark))
        blurs.append(contrasts[-1] / (max(steepest, 1e-3) * math.sqrt(2.0 * math.pi)))
    return (float(np.median(blurs)), float(np.median(contrasts))) if blurs else (math.nan, math.nan)


def _spans(corners: SeenCorners) -> bool:
    """Whether the corners are not all on one line."""
    centred = corners.target_m - corners.target_m.mean(axis=0)
    singular = np.linalg.svd(centred, compute_uv=False)
    return bool(singular[1] > 0.1 * singular[0])
