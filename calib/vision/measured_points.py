"""Poses of a target as points of an arm: each picture belongs to the pose of points.csv that its name says."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np

from calib.arrays import Array
from calib.boards import MARKERS
from calib.errors import VisionError
from calib.points.points import CAMERA_FRAME, COVARIANCE, ORIENTATION, Points, make_points, triangles
from calib.vision.poses import MeasuredPose
from control.kinematics.rotation import quaternions

SETUP = "camera"  # of markers.csv: the frame is the first camera's


def picture_name(setup: str, point: str, repeat: int) -> str:
    """What the picture of a pose is called, without its ending."""
    return f"{setup}_{point}_{repeat}"


def with_pictures(points: Points, measured: Sequence[MeasuredPose]) -> tuple[Points, tuple[str, ...]]:
    """The poses that have a picture, with what it measured; and sentences about the others. VisionError if none has.

    Positions, orientations and covariances are in the first camera's frame. Covariances are of what differs from picture to
    picture: what all share moves with the camera's frame.
    """
    by_name = {one.name: one for one in measured}
    names = [picture_name(*key) for key in zip(points.setup, points.point, points.repeat, strict=True)]
    rows = [k for k, name in enumerate(names) if name in by_name]
    if not rows:
        raise VisionError(
            f"no picture is called like a pose of the points: expected names such as {names[0]}.png (setup, point, repeat), got"
            f" {measured[0].name}"
        )
    said = []
    strange = sorted(set(by_name) - set(names))
    if strange:
        said.append(f"pictures that belong to no pose of the points: {', '.join(strange)}")
    if len(rows) < len(names):
        said.append(f"{len(names) - len(rows)} poses of the points have no measured picture and are left out")
    chosen, ours = points.chosen(rows), [by_name[names[k]] for k in rows]
    made = make_points(
        chosen.setup,
        chosen.point,
        chosen.repeat,
        chosen.q_rad,
        np.array([one.pose.position_m for one in ours]),
        chosen.direction,
        chosen.current_A,
        chosen.t_s,
        chosen.payload_kg,
        {**chosen.extra, "frame": (CAMERA_FRAME,) * len(rows)},
        quaternions(np.array([one.pose.rotation for one in ours])),
        np.array([covariance_row(one.covariance - one.common) for one in ours]),
    )
    return made, tuple(said)


def covariance_row(covariance: Array) -> Array:
    """Covariances of position and orientation, (12,), in the order of the columns, of a whole one (6, 6)."""
    return np.concatenate((triangles(covariance[:3, :3]), triangles(covariance[3:, 3:])))


def poses_text(measured: Sequence[MeasuredPose]) -> str:
    """markers.csv of all pictures: the target in the first camera's frame, with orientation and covariances."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow([*(column.name for column in MARKERS.columns), *ORIENTATION, *COVARIANCE])
    turns = quaternions(np.array([one.pose.rotation for one in measured]))
    for one, turn in zip(measured, turns, strict=True):
        writer.writerow(
            [
                SETUP,
                one.name,
                *(f"{value:.7f}" for value in one.pose.position_m),
                *(f"{value:.9f}" for value in turn),
                *(f"{value:.6e}" for value in covariance_row(one.covariance)),
            ]
        )
    return lines.getvalue()
