"""The lens of a camera: its fit to pictures of a board, and camera.json."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib.arrays import Array, frozen
from calib.errors import VisionError
from calib.results import Provenance, array_in, entries, read_json, write_json
from calib.vision.lens import (
    CONVERGED,
    NAMES,
    STEPS_MOST,
    CameraView,
    Lens,
    Misfit,
    Pose,
    misfit,
    shared_step,
    solved_pose,
    started_pose,
)
from calib.vision.targets import PrintedTarget, Sighting, Sightings, opencv

PICTURES_LEAST = 4  # below it nothing is determined; the advice asks for more
PICTURES_TO_HOLD_OUT = 8
CORNERS_LEAST = 8  # of a board in a picture: fewer say little about the lens
K3 = NAMES.index("k3")
WORTH = 5.0  # standard deviations: a weaker k3 follows noise and bends the rim of the picture
TILT_rad = math.radians(15.0)
FOCAL_SHARE_MOST = 0.1  # of the focal length: a standard deviation beyond it is no calibration
FOCAL_MOST = 20.0  # picture widths: a longer focal length than any webcam's is a failed fit


@dataclass(frozen=True, slots=True)
class SeenPicture:
    """One picture of the fit: pose of the board, residuals (k, 2) [px] at pixels (k, 2)."""

    sighting: Sighting
    pose: Pose
    error_px: Array

    @property
    def rms_px(self) -> float:
        """Root mean square of the residual's length."""
        return float(np.sqrt(np.mean(np.sum(self.error_px**2, axis=1))))

    @property
    def distance_m(self) -> float:
        """From the camera to the board's centre."""
        return float(np.linalg.norm(self.pose.position_m))

    @property
    def tilt(self) -> tuple[float, float]:
        """Turn of the board about the picture's horizontal and vertical axes [rad]; 0: it faces the camera."""
        x, y, z = self.pose.rotation[:, 2]
        return math.atan2(-y, abs(z)), math.atan2(x, abs(z))


@dataclass(frozen=True, slots=True)
class LensFit:
    """The result. held_out_px: rms of pictures when the lens comes from the others, None with too few pictures."""

    lens: Lens
    seen: tuple[SeenPicture, ...]
    unseen: tuple[str, ...]
    held_out_px: float | None

    @property
    def rms_px(self) -> float:
        """Root mean square of the residual's length over all corners."""
        return float(np.sqrt(np.mean(np.sum(np.concatenate([one.error_px for one in self.seen]) ** 2, axis=1))))


def fit_lens(target: PrintedTarget, pictures: Sightings, readout_s: float = 0.0) -> LensFit:
    """Identify the lens. VisionError if the pictures do not allow it."""
    if len(pictures.seen) < PICTURES_LEAST:
        remedy = pictures.remedy or "check --board (columns x rows of squares), --dictionary, light and sharpness"
        raise VisionError(
            f"the board ({target.name}) is in {len(pictures.seen)} of {len(pictures.seen) + len(pictures.unseen)} pictures,"
            f" {PICTURES_LEAST} are needed: {remedy}"
        )
    cleared = _cleared(pictures)
    fit = _fitted(cleared, cleared.seen)
    lens = replace(fit.lens, readout_s=readout_s)
    return replace(fit, lens=lens, unseen=pictures.unseen, held_out_px=_held_out(cleared))


def _cleared(pictures: Sightings) -> Sightings:
    """The pictures without corners that were found beside their place."""
    fit = _fitted(pictures, pictures.seen)
    noise = robust_noise_px(np.concatenate([one.error_px for one in fit.seen]))
    seen = (replace(one.sighting, corners=one.sighting.corners.agreeing(one.error_px, noise, CORNERS_LEAST)) for one in fit.seen)
    return replace(pictures, seen=tuple(seen))


def robust_noise_px(error_px: Array) -> float:
    """Standard deviation of one axis of residuals (k, 2) from their median length, which for normal noise is 1.177 of it."""
    return float(np.median(np.linalg.norm(error_px, axis=1))) / 1.177


def _fitted(pictures: Sightings, chosen: Sequence[Sighting]) -> LensFit:
    """A fit without k3, or with it where it is certain."""
    start = _started(pictures, chosen)
    whole = _refined(start, chosen, len(NAMES))
    is_certain = abs(whole.lens.values[K3]) > WORTH * whole.lens.sd[K3]
    return whole if is_certain else _refined(start, chosen, K3)


def _started(pictures: Sightings, chosen: Sequence[Sighting]) -> Lens:
    """OpenCV's estimate (Zhang, A Flexible New Technique for Camera Calibration, 2000)."""
    cv2 = opencv()
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(
            [one.corners.target_m.astype(np.float32) for one in chosen],
            [one.corners.picture_px.astype(np.float32) for one in chosen],
            (pictures.width_px, pictures.height_px),
            None,
            None,
            flags=cv2.CALIB_FIX_K3,
        )
    except cv2.error as error:
        raise VisionError(f"the pictures determine no lens ({error.err}): {_MORE}") from error
    values = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(distortion)[:4], 0.0]
    if not np.isfinite(values).all() or not 0.0 < values[0] < FOCAL_MOST * pictures.width_px:
        raise VisionError(f"the pictures determine no lens (focal length {values[0]:.0f} px): {_MORE}")
    return Lens(frozen(values), pictures.width_px, pictures.height_px)


_MORE = "tilt the board by 20 to 40 degrees to all sides, and bring it nearer and farther"


def _refined(lens: Lens, chosen: Sequence[Sighting], free: int) -> LensFit:
    """Least squares over lens (its first `free` values) and poses, with the lens's covariance."""
    poses = [_pose(lens, shot) for shot in chosen]
    before = np.inf
    for _ in range(STEPS_MOST):
        parts = _misfits(lens, chosen, poses)
        total = _total(parts)
        if before - total <= CONVERGED * total:
            break
        before = total
        step, moves, _ = shared_step(*_blocks(parts, free))
        lens = replace(lens, values=frozen(lens.values + np.pad(step, (0, len(NAMES) - free))))
        poses = [pose.moved(move) for pose, move in zip(poses, moves, strict=True)]
    parts = _misfits(lens, chosen, poses)
    freedom = sum(len(part.error_px) for part in parts) - 6 * len(parts) - free
    if freedom < 1:
        raise VisionError(f"{len(chosen)} pictures show too few corners to determine a lens: {_MORE}")
    noise = math.sqrt(_total(parts) / freedom)
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[:free, :free] = noise**2 * _inverse(shared_step(*_blocks(parts, free))[2])
    lens = replace(lens, covariance=frozen(covariance), noise_px=noise)
    if not (np.isfinite(lens.sd).all() and (lens.sd[:2] < FOCAL_SHARE_MOST * lens.values[:2]).all()):
        raise VisionError(f"the pictures determine no lens (the focal length is uncertain by more than 10 %): {_MORE}")
    seen = [
        SeenPicture(shot, pose, frozen(m.error_px.reshape(-1, 2))) for shot, pose, m in zip(chosen, poses, parts, strict=True)
    ]
    return LensFit(lens, tuple(seen), (), None)


def _misfits(lens: Lens, chosen: Sequence[Sighting], poses: Sequence[Pose]) -> list[Misfit]:
    return [misfit(CameraView(lens, one.corners), pose) for one, pose in zip(chosen, poses, strict=True)]


def _blocks(parts: Sequence[Misfit], free: int) -> tuple[list[Array], list[Array], list[Array]]:
    return [p.error_px for p in parts], [p.by_lens[:, :free] for p in parts], [p.by_pose for p in parts]


def _total(parts: Sequence[Misfit]) -> float:
    return float(sum(part.error_px @ part.error_px for part in parts))


def _inverse(normal: Array) -> Array:
    """Of a normal matrix whose unknowns differ in size by orders of magnitude. VisionError if some are not determined."""
    diagonal = np.diag(normal)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    try:
        return np.asarray(np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise VisionError(f"the pictures determine no lens: {_MORE}") from None


def _pose(lens: Lens, sighting: Sighting) -> Pose:
    pose = started_pose(CameraView(lens, sighting.corners), is_flat=True)
    if pose is None:
        raise VisionError(f"picture {sighting.name}: its {len(sighting.corners)} corners fit no pose of the board: leave it out")
    return pose


def _held_out(pictures: Sightings) -> float | None:
    """Rms residual of every second picture with the lens of the others, both ways, per degree of freedom."""
    if len(pictures.seen) < PICTURES_TO_HOLD_OUT:
        return None
    squares, freedom = 0.0, 0
    for part in (0, 1):
        try:
            lens = _fitted(pictures, pictures.seen[1 - part :: 2]).lens
        except VisionError:
            return None
        for sighting in pictures.seen[part::2]:
            squares += solved_pose([CameraView(lens, sighting.corners)], _pose(lens, sighting))[1]
            freedom += 2 * len(sighting.corners) - 6
    return math.sqrt(2.0 * squares / freedom)


FORMAT = "camera/1"
PIXELS_MOST = 100_000
READOUT_MOST_s = 1.0


def write_camera(path: Path, fit: LensFit, target: str, advice: Sequence[str], made: Provenance) -> None:
    """Write the fit; with the `advice`."""
    lens = fit.lens
    content = {
        "target": target,
        **entries(lens, "width_px", "height_px", "readout_s", "covariance", "noise_px"),
        "lens": dict(zip(NAMES, lens.values, strict=True)),
        "sd": dict(zip(NAMES, lens.sd, strict=True)),
        **entries(fit, "rms_px", "held_out_px"),
        "pictures": [
            {
                "name": picture.sighting.name,
                "corners": len(picture.sighting.corners),
                **entries(picture, "rms_px", "distance_m"),
                "tilt_rad": picture.tilt,
                "blur_px": picture.sighting.blur_px,
            }
            for picture in fit.seen
        ],
        "without_board": fit.unseen,
        "advice": advice,
    }
    write_json(path, made.heading(FORMAT) | content)


def read_camera(path: Path) -> Lens:
    """The lens of a file. VisionError names file and key."""
    content = read_json(path, FORMAT, VisionError)
    values = content.get("lens")
    if not isinstance(values, dict):
        raise VisionError(f"{path}, lens: expected {', '.join(NAMES)}, got {values!r}")
    numbers = np.array([_number(path, f"lens.{name}", values.get(name)) for name in NAMES])
    for name, value in zip(NAMES[:2], numbers[:2], strict=True):
        if value <= 0.0:
            raise VisionError(f"{path}, lens.{name}: expected a focal length above 0 px, got {value}")
    return Lens(
        frozen(numbers),
        int(_number(path, "width_px", content.get("width_px"), 1, PIXELS_MOST)),
        int(_number(path, "height_px", content.get("height_px"), 1, PIXELS_MOST)),
        _covariance(path, content.get("covariance")),
        _number(path, "noise_px", content.get("noise_px"), 0.0),
        _number(path, "readout_s", content.get("readout_s", 0.0), 0.0, READOUT_MOST_s),
    )


def _number(path: Path, key: str, value: Any, least: float = -np.inf, most: float = np.inf) -> float:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not np.isfinite(value) or not least <= value <= most:
        raise VisionError(f"{path}, {key}: expected a number{_limits(least, most)}, got {value!r}")
    return float(value)


def _limits(least: float, most: float) -> str:
    if np.isfinite(most):
        return f" from {least:g} to {most:g}"
    return f" from {least:g} on" if np.isfinite(least) else ""


def _covariance(path: Path, value: Any) -> Array:
    k = len(NAMES)
    covariance = array_in(f"{path}, covariance", value, (k, k), VisionError)
    if not np.allclose(covariance, covariance.T):
        raise VisionError(f"{path}, covariance: expected {k} by {k} numbers, symmetric")
    return covariance
