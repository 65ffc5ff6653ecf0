"""Where several cameras stand to the first, from pictures that two of them took of one target at one moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from calib.arm_problem.frames import mean_rotation
from calib.arrays import Array, frozen
from calib.errors import VisionError
from calib.vision.lens import Lens
from calib.vision.placed import (
    CONVERGED,
    HERE,
    STEPS_MOST,
    CameraView,
    Misfit,
    Pose,
    misfit,
    shared_step,
    started_pose,
)
from calib.vision.targets import SeenCorners

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
    found = {first: FIRST}
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
        found[name] = _stand(lenses[first], lenses[name], pairs, is_flat)
    return found


def _stand(
    first: Lens, second: Lens, pairs: Sequence[tuple[SeenCorners, SeenCorners]], is_flat: bool
) -> Stand:
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
        mine, other = (
            started_pose(CameraView(first, ours), is_flat),
            started_pose(CameraView(second, theirs), is_flat),
        )
        if mine is None or other is None:
            raise VisionError(
                "a picture of two cameras fits no pose of the target: check --board, --tag and the cameras' files"
            )
        poses.append(mine)
        stands.append(other.after(mine.inverse))
    rotation = mean_rotation(np.array([one.rotation for one in stands]))
    middle = np.median([other.position_m for other in stands], axis=0)
    return poses, Pose(rotation, middle)


def _misfits(
    first: Lens,
    second: Lens,
    pairs: Sequence[tuple[SeenCorners, SeenCorners]],
    poses: Sequence[Pose],
    stand: Pose,
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
