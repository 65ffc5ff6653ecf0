"""Design of experiments: which points, tilts and free poses to record next, and the gain of each."""

from calib.design.boards import OTHER_TILTS
from calib.design.candidates import View
from calib.design.criteria import CRITERIA
from calib.design.files import plan_json, write_plan
from calib.design.information import Uncertainty
from calib.design.observability import Indices, indices_of
from calib.design.plan import Alternative, Plan, PlannedPose, Request
from calib.design.planning import plan_poses
from calib.design.words import in_words

__all__ = [
    "CRITERIA",
    "OTHER_TILTS",
    "Alternative",
    "Indices",
    "Plan",
    "PlannedPose",
    "Request",
    "Uncertainty",
    "View",
    "in_words",
    "indices_of",
    "plan_json",
    "plan_poses",
    "write_plan",
]
