"""A calibration session: recording at a point, order of the points, saved data.

plan, state: planned and recorded targets, without I/O; folder, journal: the same on disk; conduct: the dialogue
between operator, arm and folder; sequence: the same without an operator.
"""

from calib.session.moves import ArmGeometry, ArmPort, Geometry, RestSample, SeenTip, TipSeat, TipSensor
from calib.session.sequence import (
    BoardPoint,
    PointStage,
    SessionProgress,
    step_through,
)
from calib.session.take import SessionSettings

__all__ = [
    "ArmGeometry",
    "ArmPort",
    "BoardPoint",
    "TipSensor",
    "Geometry",
    "SessionProgress",
    "RestSample",
    "SeenTip",
    "SessionSettings",
    "PointStage",
    "TipSeat",
    "step_through",
]
