"""What can be wrong with calibration data; str() of each is the message an operator reads."""

from __future__ import annotations

from firmware_iface.errors import ArmwrightError


class CalibrationError(ArmwrightError):
    """Base of everything that calib refuses."""


class PointsFileError(CalibrationError):
    """points.csv does not follow its format; the message names file, line and column."""


class UnusablePointsError(CalibrationError):
    """The points are well-formed, but no calibration can be made of them."""


class SessionError(CalibrationError):
    """A session cannot go on: the arm does not come to rest, or the record does not belong to it."""


class RegistrationError(CalibrationError):
    """Where a board stands cannot be found from the markers that were seen; nothing is guessed."""
