"""Errors of calibration data; str() of each is the message for the operator."""

from __future__ import annotations

from firmware_iface.errors import ArmwrightError


class CalibrationError(ArmwrightError):
    """Base of all errors of calib."""


class PointsFileError(CalibrationError):
    """An invalid points.csv; the message names file, line and column."""


class UnusablePointsError(CalibrationError):
    """The points are well-formed, but not usable for a calibration."""


class SessionError(CalibrationError):
    """A session cannot continue: the arm does not come to rest, or the record does not belong to it."""


class RegistrationError(CalibrationError):
    """The measured markers do not determine the board's pose."""


class ImportedModelError(CalibrationError):
    """A URDF or MJCF file cannot be read as a serial arm; the message names the file and the place."""


class VisionError(CalibrationError):
    """Pictures, a printed target or a camera's file cannot be used; the message names which and the remedy."""
