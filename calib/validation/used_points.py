"""Detects points that the calibration has already used, by the file's hash and pose by pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib.arrays import Array
from calib.errors import CalibrationError
from calib.inputs import input_file
from calib.points.reading import read_points
from control.model.arm import Arm

SAME_POSE_rad = (
    0.002  # difference of every joint, about a millimetre at the tip, below which a pose is not new
)


@dataclass(frozen=True, slots=True)
class Used:
    """Known number of poses that the calibration has used, and warnings."""

    count: int
    warnings: tuple[str, ...]


def already_used(calibrated: Arm, q_rad: Array, sha256: str = "") -> Used:
    """Check whether poses (m, n) were used; with the hash of their file, if any.

    The calibration's input files are searched beside the calibrated arm; missing ones cannot be compared.
    """
    made = calibrated.calibration
    if made is None:
        return Used(
            0,
            (
                f"arm {calibrated.name} does not name its calibration data: whether these points were used for it is"
                " unknown",
            ),
        )
    name = next((name for name, digest in made.inputs.items() if sha256 and digest == sha256), None)
    if name is not None:
        return Used(
            len(q_rad),
            (f"these points are {name}, from which the arm was calibrated: they cannot verify it",),
        )
    sentences, missing, total = [], [], 0
    for name, digest in made.inputs.items():
        if not name.endswith((".csv", ".csv.gz")):
            continue  # the nominal arm or a board's registration: no poses
        used = _poses_of(calibrated, name, digest)
        if used is None:
            missing.append(name)
        elif count := _same_count(q_rad, used):
            total = max(total, count)
            sentences.append(
                f"{count} of {len(q_rad)} poses are within {SAME_POSE_rad:g} rad of a pose of {name}, from which the arm was"
                " calibrated"
            )
    if missing:
        sentences.append(
            f"missing beside the calibrated arm, or changed: {', '.join(missing)}; whether its poses were reused is unknown"
        )
    return Used(total, tuple(sentences))


def _poses_of(calibrated: Arm, name: str, digest: str) -> Array | None:
    """Joint angles of an input of the calibration; None if the file is not available."""
    path = (calibrated.path.parent if calibrated.path is not None else Path()) / Path(name).name
    if not path.is_file() or input_file(path, "").sha256 != digest:
        return None
    try:
        return read_points(path, calibrated.joint_count)[0].q_rad
    except CalibrationError:
        return np.zeros(
            (0, calibrated.joint_count)
        )  # the right file, but without poses, such as a board's registration


def _same_count(q_rad: Array, used_rad: Array) -> int:
    """Number of q_rad (m, n) that are near one of used_rad (k, n)."""
    if not len(used_rad):
        return 0
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(used_rad).query(q_rad, p=np.inf)
    return int(np.sum(np.asarray(distance) <= SAME_POSE_rad))
