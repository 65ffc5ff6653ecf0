"""Errors of an arm, its file, or a request to it. An operator can act on every message."""

from pathlib import Path

from firmware_iface.errors import ArmwrightError
from firmware_iface.installation import claim

claim()  # here too: python-control's __init__.py may have replaced ours


class ArmError(ArmwrightError):
    """Base of all errors that the package `control` raises deliberately; `str()` is the message to show."""


class ArmFileError(ArmError):
    """An invalid arm.toml; names file, line, key, the expected value and the actual one."""

    def __init__(self, file: str | Path, line: int | None, key: str, expected: str, got: str, hint: str = "") -> None:
        self.file = str(file)
        self.line = line
        self.key = key
        self.expected = expected
        self.got = got
        self.hint = hint
        where = f"{file}, line {line}" if line else f"{file}"
        what = f"{key}: " if key else ""
        remedy = f" ({hint})" if hint else ""
        super().__init__(f"{where}: {what}expected {expected}, got {got}{remedy}")


class MissingModel(ArmError):
    """The arm's description lacks something that the request needs (masses, a drive, a table, a closed form)."""


class BadTarget(ArmError):
    """An invalid target or joint vector: not finite, or of the wrong length."""


class OutOfReach(ArmError):
    """No joint angles reach the target; `distance_m` is its distance from the reachable space."""

    def __init__(self, message: str, distance_m: float) -> None:
        self.distance_m = distance_m
        super().__init__(message)


class NearSingular(ArmError):
    """The target can be reached only in, or too close to, a singular pose.

    `which` is "elbow", "shoulder" or "arm"; `margin` is the distance from the singularity and
    `limit` the smallest one allowed, both in `unit`.
    """

    def __init__(self, message: str, which: str, margin: float, limit: float, unit: str) -> None:
        self.which = which
        self.margin = margin
        self.limit = limit
        self.unit = unit
        super().__init__(message)


class JointLimitViolated(ArmError):
    """A joint would have to go `excess_rad` beyond its limit (1-based `joint`)."""

    def __init__(self, message: str, joint: int, excess_rad: float) -> None:
        self.joint = joint
        self.excess_rad = excess_rad
        super().__init__(message)


class MotionError(ArmError):
    """A motion that cannot be planned: not finite, outside of limits, or inconsistent."""


class PathError(MotionError):
    """A Cartesian path that cannot be run; `waypoint` is 1-based, None if no single one is the cause."""

    def __init__(self, message: str, waypoint: int | None = None) -> None:
        self.waypoint = waypoint
        super().__init__(message)


class WaypointFileError(PathError):
    """A way-point file that cannot be read: the message names file, line and column."""
