"""A calibration session: what happens at a point, in which order points are visited, what is kept."""

from calib.session.ports import ArmPort, Camera, Inverse, Sample, TipSeat
from calib.session.sequence import (
    BoardPoint,
    FreePose,
    Progress,
    SessionSettings,
    Stage,
    step_through,
    take_free_poses,
)

__all__ = [
    "ArmPort",
    "BoardPoint",
    "Camera",
    "FreePose",
    "Inverse",
    "Progress",
    "Sample",
    "SessionSettings",
    "Stage",
    "TipSeat",
    "step_through",
    "take_free_poses",
]
