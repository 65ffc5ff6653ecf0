"""A calibration session: recording at a point, order of the points, saved data.

plan, state: planned and recorded targets, without I/O; folder, journal: the same on disk; conduct: the dialogue
between operator, arm and folder; sequence: the same without an operator.
"""

from calib.session.moves import ArmGeometry, ArmPort, Camera, Geometry, Sample, SeenTip, TipSeat
from calib.session.sequence import (
    BoardPoint,
    Progress,
    Stage,
    step_through,
)
from calib.session.take import SessionSettings

__all__ = [
    "ArmGeometry",
    "ArmPort",
    "BoardPoint",
    "Camera",
    "Geometry",
    "Progress",
    "Sample",
    "SeenTip",
    "SessionSettings",
    "Stage",
    "TipSeat",
    "step_through",
]
