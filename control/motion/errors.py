"""Errors of a requested motion; nothing has moved when one of these is raised."""

from control.errors import ArmError


class MotionError(ArmError):
    """A motion that cannot be planned: not finite, outside of limits, or inconsistent."""


class PathError(MotionError):
    """A Cartesian path that cannot be run; `waypoint` is 1-based, None if no single one is the cause."""

    def __init__(self, message: str, waypoint: int | None = None) -> None:
        self.waypoint = waypoint
        super().__init__(message)


class WaypointFileError(PathError):
    """A way-point file that cannot be read: the message names file, line and column."""
