"""Motions that a client has planned: rebuilt from its request, and compared with the arm's position, limits and workspace."""

from collections.abc import Sequence
from typing import Any

from control.errors import ArmError
from control.loop.runtime import Runtime
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath
from control.motion.setpoint import Motion
from control.server import messages
from control.server.messages import numbers

START_TOLERANCE_rad = 5e-3  # around a path's first point: a joint move ends within a few counts of it
Planned = messages.MoveJoints | messages.RunJoints


class PlannedMotions:
    """Makes motions of requests for one arm."""

    def __init__(self, runtime: Runtime, limits: JointLimits) -> None:
        self._runtime, self._limits = runtime, limits

    def prepare(self, request: Planned) -> Motion:
        """The motion that a request describes, checked; nothing has begun. ArmError."""
        match request:
            case messages.MoveJoints():
                motion = self._joint_move(request)
            case _:
                motion = self._joint_path(request)
        self._runtime.parts.tool.guard.require_rising(motion)
        return motion

    def _joint_move(self, request: messages.MoveJoints) -> Motion:
        target = numbers("q_rad", request.q_rad, len(self._runtime.parts.joint_names))
        start = self._runtime.seen(request.as_encoders)
        move = JointMove(start, target, self._limits.scaled(request.speed))
        self._runtime.parts.tool.guard.require_move(move, start, target)
        return move

    def _joint_path(self, request: messages.RunJoints) -> Motion:
        given: Any = request.path  # read in slices already, where it was long
        path = given if isinstance(given, JointPath) else JointPath.from_message(given)
        self._require_tool(request.tool)
        path.require_within(self._limits)
        self._require_at(path.at(0.0).q_rad, request.as_encoders)
        self._runtime.parts.tool.guard.require_joint_path(path)
        return path

    def _require_tool(self, planned: str | None) -> None:
        """Check that a path is for the tip of the tool that is on, if it says for which."""
        on = self._runtime.parts.tool.tool.name
        if planned is not None and planned != on:
            raise ArmError(f"the path is for the tip of tool {planned!r}, but {on!r} is mounted: plan it again")

    def _require_at(self, first_rad: Sequence[float], as_encoders: bool) -> None:
        """Check that the arm holds at a path's first point."""
        seen_rad = self._runtime.seen(as_encoders).q_rad
        off_rad = max(abs(a - b) for a, b in zip(first_rad, seen_rad, strict=True))
        if off_rad > START_TOLERANCE_rad:
            raise ArmError(
                f"the arm is {off_rad:.4f} rad away from the path's first point (tolerance {START_TOLERANCE_rad} rad):"
                f" move there first, to {', '.join(f'{q:.4f}' for q in first_rad)} rad"
            )
