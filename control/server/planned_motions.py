"""Motions that a client has planned: rebuilt from its request, and compared with the arm's position, limits and workspace."""

from collections.abc import Sequence
from typing import Any, TypeVar

from control.errors import ArmError
from control.loop.runtime import Runtime
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import JointMove
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath
from control.motion.setpoint import Motion
from control.server import messages
from control.server.messages import numbers

START_TOLERANCE_rad = 5e-3  # around a path's first point: a joint move ends within a few counts of it
P = TypeVar("P", PlannedPath, JointPath)
Planned = messages.MoveJoints | messages.RunPath | messages.RunJoints


class PlannedMotions:
    """Makes motions of requests for one arm."""

    def __init__(self, runtime: Runtime, limits: JointLimits) -> None:
        self._runtime, self._limits = runtime, limits

    def prepare(self, request: Planned) -> Motion:
        """The motion that a request describes, checked; nothing has begun. ArmError."""
        match request:
            case messages.MoveJoints():
                motion = self._joint_move(request)
            case messages.RunPath():
                motion = self._path(request)
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

    def _path(self, request: messages.RunPath) -> Motion:
        path = _made(PlannedPath, request.path)
        tool = self._runtime.parts.tool
        self._require_tool(request.tool)
        self._require_at(path.q_start_rad, request.as_encoders)
        tool.guard.require_path(path)
        return path.motion(tool.inverse, tool.kinematics)

    def _joint_path(self, request: messages.RunJoints) -> Motion:
        path = _made(JointPath, request.path)
        self._require_tool(request.tool)
        path.require_within(self._limits)
        self._require_at(path.at(0.0).q_rad, request.as_encoders)
        self._runtime.parts.tool.guard.require_joint_path(path)
        return path

    def _require_tool(self, planned: str | None) -> None:
        """Check that a path is for the tip of the tool that is on, if it says for which."""
        on = self._runtime.parts.tool.tool.name
        if planned is not None and planned != on:
            raise ArmError(
                f"the path is for the tip of tool {planned!r}, but {on!r} is mounted: plan it again"
            )

    def _require_at(self, first_rad: Sequence[float], as_encoders: bool) -> None:
        """Check that the arm holds at a path's first point."""
        seen_rad = self._runtime.seen(as_encoders).q_rad
        off_rad = max(abs(a - b) for a, b in zip(first_rad, seen_rad, strict=True))
        if off_rad > START_TOLERANCE_rad:
            raise ArmError(
                f"the arm is {off_rad:.4f} rad away from the path's first point (tolerance {START_TOLERANCE_rad} rad):"
                f" move there first, to {', '.join(f'{q:.4f}' for q in first_rad)} rad"
            )


def _made(kind: type[P], path: Any) -> P:
    """A path as the request has it, or made of one that was read in slices. ArmError if it is of another kind."""
    if isinstance(path, PlannedPath | JointPath):
        if not isinstance(path, kind):
            raise ArmError(
                f"path: expected one of a {'tip' if kind is PlannedPath else 'joint'} motion, got the other kind"
            )
        return path
    return kind.from_message(path)
