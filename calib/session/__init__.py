"""A calibration session: what happens at a point, in which order points are visited, what is kept.

plan, state: what is to be taken and what has been, without I/O; folder, journal: the same on the disk; conduct: the talk
between operator, arm and folder; sequence: the same walk with nobody to ask.
"""

from calib.session.moves.geometry import ArmGeometry
from calib.session.moves.ports import ArmPort, Camera, Geometry, Sample, TipSeat
from calib.session.sequence import (
    BoardPoint,
    FreePose,
    Progress,
    Stage,
    step_through,
    take_free_poses,
)
from calib.session.take import SessionSettings

__all__ = [
    "ArmGeometry",
    "ArmPort",
    "BoardPoint",
    "Camera",
    "FreePose",
    "Geometry",
    "Progress",
    "Sample",
    "SessionSettings",
    "Stage",
    "TipSeat",
    "step_through",
    "take_free_poses",
]
