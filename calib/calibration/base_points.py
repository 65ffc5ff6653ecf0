"""Points that a camera measured, in the arm's base frame as a calibration found it: for commands that need them there."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.arm_problem.assembly import CAMERA
from calib.arrays import frozen
from calib.calibration.calibrate import Calibrated
from calib.points.covariance import matrices_of, triangles
from calib.points.points import Points
from control.kinematics.rotation import matrices, quaternions


def points_in_base(made: Calibrated) -> Points | None:
    """The points with tips, orientations and covariances turned from the camera's to the base frame; None for other points."""
    frame, points = made.found.solution.frames[0], made.points
    if frame.name != CAMERA:
        return None
    turned = np.array(points.orientation)
    rows = np.isfinite(turned).all(axis=1)
    turned[rows] = quaternions(frame.rotation @ matrices(turned[rows]))
    spread = frame.rotation @ matrices_of(points.covariance.reshape(-1, 2, 6)) @ frame.rotation.T
    return dataclasses.replace(
        points,
        tip_m=frozen(frame.to_base(points.tip_m)),
        orientation=frozen(turned),
        covariance=frozen(triangles(spread).reshape(-1, 12)),
        extra={name: column for name, column in points.extra.items() if name != "frame"},
    )
