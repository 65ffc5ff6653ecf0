"""Design of experiments: which points, tilts and free poses to record next, and the gain of each."""

from calib.design.candidates import OTHER_TILTS, CameraBox
from calib.design.information import CRITERIA, Indices, Uncertainty, indices_of
from calib.design.planning import (
    Alternative,
    Plan,
    PlannedPose,
    Request,
    in_words,
    plan_json,
    plan_poses,
    write_plan,
)

__all__ = [
    "CRITERIA",
    "OTHER_TILTS",
    "Alternative",
    "Indices",
    "Plan",
    "PlannedPose",
    "Request",
    "Uncertainty",
    "CameraBox",
    "in_words",
    "indices_of",
    "plan_json",
    "plan_poses",
    "write_plan",
]
