"""The target's pose in every picture, from one or several cameras, each with its own covariance.

    C = s^2 (J'J)^-1 + G S G' + motion

s is the noise of a corner in this picture, J the reprojection's Jacobian: distance, tilt and size of the target act through it.
The second term is what the lens (and where cameras stand to each other) leaves uncertain, G = (J'J)^-1 J' J_lens. It is common to
all pictures of a camera: it does not average out.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from calib.arm_problem.observations import mean_rotation
from calib.arrays import Array, frozen
from calib.boards import MARKERS
from calib.errors import VisionError
from calib.points.points import CAMERA_FRAME, COVARIANCE, ORIENTATION, Points, make_points, triangles
from calib.vision.intrinsics import robust_noise_px
from calib.vision.lens import (
    CONVERGED,
    HERE,
    STEPS_MOST,
    CameraView,
    Lens,
    Misfit,
    Pose,
    best_poses,
    misfit,
    shared_step,
    started_pose,
)
from calib.vision.targets import PrintedTarget, SeenCorners, Sighting, Sightings
from control.kinematics.rotation import quaternions

CORNERS_LEAST = 4
CORNERS_TO_COMPARE = 12  # from here on one wrong corner shows against the others
POOLED_FREEDOM = 20.0  # degrees of freedom that the other pictures' noise counts for in one picture's
AMBIGUOUS = 9.0  # (3 standard deviations)^2 by which the second of two poses must be worse
BAD_TIMES = 5.0  # the usual residual: something else than noise


@dataclass(frozen=True, slots=True)
class MeasuredPose:
    """The target in one picture, or in pictures of several cameras at one moment: in the reference camera's frame.

    covariance (6, 6): of the position [m], then of the turn about the reference camera's axes [rad]; `common`: the part that all
    pictures share. corners: how many; cameras: their names.
    """

    name: str
    pose: Pose
    covariance: Array
    common: Array
    rms_px: float
    corners: int
    cameras: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class RejectedPicture:
    """A picture without a pose, and why."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class CameraPictures:
    """A camera by name: its lens and what its pictures show."""

    name: str
    lens: Lens
    pictures: Sightings


@dataclass(frozen=True, slots=True)
class JudgedView:
    """What a camera, by its name, saw of a picture; noise_px of a corner; stand (6, 6): the covariance of where it stands."""

    camera: str
    view: CameraView
    noise_px: float
    stand: Array


@dataclass(frozen=True, slots=True)
class PoseSet:
    """All pictures; `stands`: where each camera stands to the first; noise_px of a corner by camera."""

    measured: tuple[MeasuredPose, ...]
    rejected: tuple[RejectedPicture, ...]
    stands: Mapping[str, Stand]
    noise_px: Mapping[str, float]


def measure_poses(target: PrintedTarget, cameras: Sequence[CameraPictures], speed_m_s: float = 0.0) -> PoseSet:
    """Poses of all pictures; pictures of several cameras with one name were taken at one moment.

    speed_m_s: the fastest that the target may have moved while a picture was taken. VisionError if no picture can be used.
    """
    for camera in cameras:
        _require_own_pictures(camera)
    by_name = _together(cameras)
    if not by_name:
        raise VisionError(f"no picture shows {target.name}: check the target's options, light and sharpness")
    stands = stands_of({c.name: c.lens for c in cameras}, by_name, target.is_flat)
    by_name = {name: _cleared(parts, stands, target.is_flat) for name, parts in by_name.items()}
    solved, rejected = ({}, [RejectedPicture(name, "does not show the target") for name in _unseen(cameras, by_name)])
    for name, parts in by_name.items():
        views = [CameraView(camera.lens, one.corners, stands[camera.name].pose) for camera, one in parts]
        solved[name] = (views, best_poses(views, target.is_flat))
    noise = _noise(by_name, solved)
    measured = []
    for name, (views, poses) in solved.items():
        seen = [
            JudgedView(camera.name, view, noise[camera.name], stands[camera.name].covariance)
            for (camera, _), view in zip(by_name[name], views, strict=True)
        ]
        if reason := _reason(seen, poses):
            rejected.append(RejectedPicture(name, reason))
        else:
            measured.append(_measured(name, seen, poses[0][0], speed_m_s))
    if not measured:
        remedies = [f"; {camera.pictures.remedy}" for camera in cameras if camera.pictures.remedy]
        raise VisionError(f"no picture gives a pose: {rejected[0].name} {rejected[0].reason}{remedies[0] if remedies else ''}")
    return PoseSet(tuple(measured), tuple(rejected), stands, noise)


def _require_own_pictures(camera: CameraPictures) -> None:
    lens, seen = camera.lens, camera.pictures
    if (lens.width_px, lens.height_px) != (seen.width_px, seen.height_px):
        raise VisionError(
            f"camera {camera.name} was calibrated with {lens.width_px} x {lens.height_px} pixels, its pictures have"
            f" {seen.width_px} x {seen.height_px}: calibrate at the resolution, zoom and focus that you use"
        )


def _together(cameras: Sequence[CameraPictures]) -> dict[str, list[tuple[CameraPictures, Sighting]]]:
    """What the cameras saw, by the pictures' names."""
    by_name: dict[str, list[tuple[CameraPictures, Sighting]]] = {}
    for camera in cameras:
        for sighting in camera.pictures.seen:
            by_name.setdefault(sighting.name, []).append((camera, sighting))
    return dict(sorted(by_name.items()))


def _unseen(cameras: Sequence[CameraPictures], by_name: Mapping[str, object]) -> list[str]:
    return sorted({name for camera in cameras for name in camera.pictures.unseen if name not in by_name})


def _cleared(
    parts: list[tuple[CameraPictures, Sighting]], stands: Mapping[str, Stand], is_flat: bool
) -> list[tuple[CameraPictures, Sighting]]:
    """One picture's sightings without corners that were found beside their place; with few corners all are kept."""
    if sum(len(sighting.corners) for _, sighting in parts) < CORNERS_TO_COMPARE:
        return parts
    views = [CameraView(camera.lens, sighting.corners, stands[camera.name].pose) for camera, sighting in parts]
    poses = best_poses(views, is_flat)
    if not poses:
        return parts
    errors = [misfit(view, poses[0][0]).error_px.reshape(-1, 2) for view in views]
    noise = robust_noise_px(np.concatenate(errors))
    return [
        (camera, replace(sighting, corners=sighting.corners.agreeing(error, noise, CORNERS_LEAST)))
        for (camera, sighting), error in zip(parts, errors, strict=True)
    ]


Solved = tuple[list[CameraView], list[tuple[Pose, float]]]


def _noise(by_name: Mapping[str, list[tuple[CameraPictures, Sighting]]], solved: Mapping[str, Solved]) -> dict[str, float]:
    """Noise of a corner of each camera: robust, from the residuals of its pictures.

    With few corners a picture says little, and a moved one much: the median over pictures of its variance.
    """
    variances: dict[str, list[tuple[float, float]]] = {}
    for name, parts in by_name.items():
        views, poses = solved[name]
        if not poses:
            continue
        freedom = sum(2 * len(sighting.corners) for _, sighting in parts) - 6
        for (camera, sighting), view in zip(parts, views, strict=True):
            share = freedom * 2 * len(sighting.corners) / (freedom + 6)
            total = float(np.sum(misfit(view, poses[0][0]).error_px ** 2))
            variances.setdefault(camera.name, []).append((total, share))
    return {name: _pooled(parts) for name, parts in variances.items()}


def _pooled(parts: Sequence[tuple[float, float]]) -> float:
    """Standard deviation from sums of squares and degrees of freedom, without those far above the others."""
    ratio = np.array([total / max(freedom, 1.0) for total, freedom in parts])
    kept = ratio <= BAD_TIMES**2 * max(float(np.median(ratio)), 1e-12)
    total, freedom = np.array(parts)[kept].sum(axis=0)
    return math.sqrt(max(total / max(freedom, 1.0), 1e-12))


def _reason(views: Sequence[JudgedView], poses: Sequence[tuple[Pose, float]]) -> str:
    """Why a picture's pose is not used; empty if it is."""
    if not poses:
        return "fits no pose of the target"
    variance = float(np.mean(np.square([seen.noise_px for seen in views])))
    freedom = sum(2 * len(seen.view.corners) for seen in views) - 6
    usual = math.sqrt(poses[0][1] / max(freedom, 1) / variance)
    if usual > BAD_TIMES:
        return f"has residuals {usual:.0f} times the usual: the target or the camera moved, or the target is bent"
    if len(poses) > 1 and (poses[1][1] - poses[0][1]) / variance < AMBIGUOUS:
        return (
            "fits two poses of the target, mirrored in the view: too small, too far or seen head-on; use a larger board, or"
            " tags on two planes"
        )
    return ""


def _measured(name: str, seen: Sequence[JudgedView], pose: Pose, speed_m_s: float) -> MeasuredPose:
    views, noise_px = [one.view for one in seen], [one.noise_px for one in seen]
    parts = [misfit(view, pose) for view in views]
    information = sum((p.by_pose.T @ p.by_pose / s**2 for p, s in zip(parts, noise_px, strict=True)), np.zeros((6, 6)))
    inverse: Array = np.asarray(np.linalg.inv(information), dtype=np.float64)
    weighted = sum((p.error_px @ p.error_px / s**2 for p, s in zip(parts, noise_px, strict=True)), 0.0)
    freedom = sum(len(p.error_px) for p in parts) - 6
    ratio = (POOLED_FREEDOM + weighted) / (POOLED_FREEDOM + freedom)  # this picture's variance over the usual one
    common = _common(inverse, parts, seen)
    moved = motion_covariance(views, speed_m_s)
    corners = sum(len(view.corners) for view in views)
    rms = math.sqrt(sum(float(p.error_px @ p.error_px) for p in parts) / corners)
    covariance: Array = ratio * inverse + common + moved
    return MeasuredPose(name, pose, frozen(covariance), frozen(common), rms, corners, tuple(one.camera for one in seen))


def _common(inverse: Array, parts: Sequence[Misfit], seen: Sequence[JudgedView]) -> Array:
    """Covariance (6, 6) of a pose by what all pictures share: lenses, and where the cameras stand."""
    covariance = np.zeros((6, 6))
    for part, one in zip(parts, seen, strict=True):
        gain = inverse @ part.by_pose.T / one.noise_px**2
        by_lens, by_stand = gain @ part.by_lens, gain @ part.by_stand
        covariance += by_lens @ one.view.lens.covariance @ by_lens.T + by_stand @ one.stand @ by_stand.T
    return covariance


def motion_covariance(views: Sequence[CameraView], speed_m_s: float) -> Array:
    """Covariance (6, 6) by a target that moves while rows are read one after the other (rolling shutter).

    The rows that the target covers are read over a part of readout_s; the motion in that time spreads evenly and shears the
    target.
    """
    covariance = np.zeros((6, 6))
    for view in views:
        rows = view.corners.picture_px[:, 1]
        share = (rows.max() - rows.min()) / view.lens.height_px
        moved = speed_m_s * view.lens.readout_s * share
        whole = speed_m_s * view.lens.readout_s  # against the moment of the encoders
        size = float(np.ptp(view.corners.target_m, axis=0).max())
        here = np.diag([whole**2 / 12.0] * 3 + [(moved / max(size, 1e-6)) ** 2 / 12.0] * 3)
        covariance = np.maximum(covariance, here)
    return covariance


# Where several cameras stand to the first, from pictures that two of them took of one target at one moment.
COMMON_LEAST = 3  # pictures of both cameras


class Named(Protocol):
    """A camera by its name."""

    @property
    def name(self) -> str:
        """As given."""


class Cornered(Protocol):
    """What a picture shows."""

    @property
    def corners(self) -> SeenCorners:
        """Of the target."""


@dataclass(frozen=True, slots=True)
class Stand:
    """camera_T_first camera, and its covariance (6, 6): a shift [m] and a turn [rad] in the camera's axes."""

    pose: Pose
    covariance: Array


FIRST = Stand(HERE, frozen(np.zeros((6, 6))))


def stands_of(
    lenses: Mapping[str, Lens], by_name: Mapping[str, Sequence[tuple[Named, Cornered]]], is_flat: bool
) -> dict[str, Stand]:
    """The stand of every camera. VisionError for one that shares too few pictures with the first."""
    first, *others = lenses
    stands = {first: FIRST}
    for name in others:
        pairs = []
        for parts in by_name.values():
            seen = {camera.name: one.corners for camera, one in parts}
            if first in seen and name in seen:
                pairs.append((seen[first], seen[name]))
        if len(pairs) < COMMON_LEAST:
            raise VisionError(
                f"cameras {first} and {name} both saw the target in {len(pairs)} pictures of one name, {COMMON_LEAST} are needed"
                " to know where they stand to each other"
            )
        stands[name] = _stand(lenses[first], lenses[name], pairs, is_flat)
    return stands


def _stand(first: Lens, second: Lens, pairs: Sequence[tuple[SeenCorners, SeenCorners]], is_flat: bool) -> Stand:
    """Least squares over the stand and the target's pose in every pair of pictures."""
    poses, stand = _started(first, second, pairs, is_flat)
    before, parts = np.inf, _misfits(first, second, pairs, poses, stand)
    for _ in range(STEPS_MOST):
        parts = _misfits(first, second, pairs, poses, stand)
        total = sum(float(a.error_px @ a.error_px + b.error_px @ b.error_px) for a, b in parts)
        if before - total <= CONVERGED * total:
            break
        before = total
        step, moves, _ = shared_step(*_blocks(parts))
        stand = stand.moved(step)
        poses = [pose.moved(move) for pose, move in zip(poses, moves, strict=True)]
    freedom = sum(len(a.error_px) + len(b.error_px) for a, b in parts) - 6 * len(parts) - 6
    return Stand(stand, frozen(total / max(freedom, 1) * np.linalg.inv(shared_step(*_blocks(parts))[2])))


def _started(
    first: Lens, second: Lens, pairs: Sequence[tuple[SeenCorners, SeenCorners]], is_flat: bool
) -> tuple[list[Pose], Pose]:
    """Each camera for itself; the stand is the mean of what the pairs say."""
    poses, stands = [], []
    for ours, theirs in pairs:
        mine, yours = (started_pose(CameraView(first, ours), is_flat), started_pose(CameraView(second, theirs), is_flat))
        if mine is None or yours is None:
            raise VisionError("a picture of two cameras fits no pose of the target: check --board, --tag and the cameras' files")
        poses.append(mine)
        stands.append(yours.after(mine.inverse))
    rotation = mean_rotation(np.array([stand.rotation for stand in stands]))
    middle = np.median([stand.position_m for stand in stands], axis=0)
    return poses, Pose(rotation, middle)


def _misfits(
    first: Lens, second: Lens, pairs: Sequence[tuple[SeenCorners, SeenCorners]], poses: Sequence[Pose], stand: Pose
) -> list[tuple[Misfit, Misfit]]:
    return [
        (misfit(CameraView(first, ours), pose), misfit(CameraView(second, theirs, stand), pose))
        for (ours, theirs), pose in zip(pairs, poses, strict=True)
    ]


def _blocks(parts: Sequence[tuple[Misfit, Misfit]]) -> tuple[list[Array], list[Array], list[Array]]:
    return (
        [np.concatenate((a.error_px, b.error_px)) for a, b in parts],
        [np.concatenate((np.zeros_like(a.by_stand), b.by_stand)) for a, b in parts],
        [np.concatenate((a.by_pose, b.by_pose)) for a, b in parts],
    )


SETUP = "camera"  # of markers.csv: the frame is the first camera's


def picture_name(setup: str, point: str, repeat: int) -> str:
    """What the picture of a pose is called, without its ending."""
    return f"{setup}_{point}_{repeat}"


def with_pictures(points: Points, measured: Sequence[MeasuredPose]) -> tuple[Points, tuple[str, ...]]:
    """The poses that have a picture, with what it measured; and sentences about the others. VisionError if none has.

    Positions, orientations and covariances are in the first camera's frame. Covariances are of what differs from picture to
    picture: what all share moves with the camera's frame.
    """
    by_name = {picture.name: picture for picture in measured}
    names = [picture_name(*key) for key in zip(points.setup, points.point, points.repeat, strict=True)]
    rows = [k for k, name in enumerate(names) if name in by_name]
    if not rows:
        raise VisionError(
            f"no picture is called like a pose of the points: expected names such as {names[0]}.png (setup, point, repeat), got"
            f" {measured[0].name}"
        )
    sentences = []
    strange = sorted(set(by_name) - set(names))
    if strange:
        sentences.append(f"pictures that belong to no pose of the points: {', '.join(strange)}")
    if len(rows) < len(names):
        sentences.append(f"{len(names) - len(rows)} poses of the points have no measured picture and are left out")
    chosen, ours = points.chosen(rows), [by_name[names[k]] for k in rows]
    made = make_points(
        chosen.setup,
        chosen.point,
        chosen.repeat,
        chosen.q_rad,
        np.array([picture.pose.position_m for picture in ours]),
        chosen.direction,
        chosen.current_A,
        chosen.t_s,
        chosen.payload_kg,
        {**chosen.extra, "frame": (CAMERA_FRAME,) * len(rows)},
        quaternions(np.array([picture.pose.rotation for picture in ours])),
        np.array([covariance_row(picture.covariance - picture.common) for picture in ours]),
    )
    return made, tuple(sentences)


def covariance_row(covariance: Array) -> Array:
    """Covariances of position and orientation, (12,), in the order of the columns, of a whole one (6, 6)."""
    return np.concatenate((triangles(covariance[:3, :3]), triangles(covariance[3:, 3:])))


def poses_text(measured: Sequence[MeasuredPose]) -> str:
    """markers.csv of all pictures: the target in the first camera's frame, with orientation and covariances."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow([*(column.name for column in MARKERS.columns), *ORIENTATION, *COVARIANCE])
    turns = quaternions(np.array([picture.pose.rotation for picture in measured]))
    for picture, turn in zip(measured, turns, strict=True):
        writer.writerow(
            [
                SETUP,
                picture.name,
                *(f"{value:.7f}" for value in picture.pose.position_m),
                *(f"{value:.9f}" for value in turn),
                *(f"{value:.6e}" for value in covariance_row(picture.covariance)),
            ]
        )
    return lines.getvalue()
