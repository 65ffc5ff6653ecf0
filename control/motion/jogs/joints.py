"""Joint jog: each joint at its requested speed, jerk-limited, coming to rest at the end of its range.

A joint with a requested speed moves towards the end of its range at no more than that speed (ruckig, position control)
and comes to rest exactly there. A joint with zero requested speed stops at once (velocity control).
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from control.model.rules import ANGLE
from control.motion.errors import MotionError
from control.motion.joint_limits import JointLimits
from control.motion.joint_move import calculated
from control.motion.setpoint import SetPoint

if TYPE_CHECKING:
    import ruckig

_NEAR_END_rad = 1e-6
_NOTHING_rad_s = 1e-6


class JointJog:
    """Jogs joints from a set-point, at rest or moving, at no more than `speed_rad_s` of the limits."""

    __slots__ = ("_is_endless", "_limits", "_plans", "_state", "_target", "_time_s", "_wanted")

    def __init__(self, start: SetPoint, limits: JointLimits) -> None:
        self._limits = limits
        self._state = start
        self._wanted = [0.0] * len(start.q_rad)
        self._target: list[float | None] = [None] * len(start.q_rad)
        self._time_s = [0.0] * len(start.q_rad)
        self._is_endless = [False] * len(start.q_rad)
        self._plans: list[ruckig.Trajectory | None] = [None] * len(start.q_rad)
        for joint, speed in enumerate(start.speed_rad_s):
            if speed or start.acceleration_rad_s2[joint]:
                self._plan(joint)

    @property
    def is_at_rest(self) -> bool:
        """Whether every joint has come to rest at its goal."""
        return all(plan is None for plan in self._plans)

    @property
    def limited(self) -> str:
        """Why joints do not move as requested, as text; empty if they do."""
        stuck = [joint + 1 for joint in range(len(self._wanted)) if self._is_at_end(joint)]
        return "; ".join(f"joint {joint} is at the end of its range" for joint in stuck)

    def want(self, speed_rad_s: Sequence[float]) -> None:
        """Set the requested speed of each joint, clamped to the joint's limit."""
        for joint, (speed, limit) in enumerate(zip(speed_rad_s, self._limits.speed_rad_s, strict=True)):
            speed = min(max(speed, -limit), limit) if abs(speed) > _NOTHING_rad_s else 0.0
            if speed != self._wanted[joint] or self._target[joint] is not None:
                self._wanted[joint], self._target[joint] = speed, None
                self._plan(joint)

    def step(self, joint: int, by_rad: float, speed_rad_s: float) -> None:
        """Turn one joint (0-based) by an angle, from rest. MotionError if that is outside of its range."""
        lower, upper = self._limits.lower_rad[joint], self._limits.upper_rad[joint]
        goal = self._state.q_rad[joint] + by_rad
        if not lower <= goal <= upper:
            raise MotionError(
                f"jog: joint {joint + 1} cannot go to {goal:.4f} rad, outside of its range {lower:.4f} .. {upper:.4f} rad:"
                f" jog by {lower - self._state.q_rad[joint]:.4f} to {upper - self._state.q_rad[joint]:.4f} rad"
                f"{ANGLE.doubt(by_rad)}"
            )
        speed = min(abs(speed_rad_s), self._limits.speed_rad_s[joint])
        self._wanted[joint], self._target[joint] = math.copysign(speed, by_rad), goal
        self._plan(joint)

    def advance(self, elapsed_s: float) -> SetPoint:
        """Set-point `elapsed_s` after the last one."""
        for joint, plan in enumerate(self._plans):
            if plan is not None:
                self._follow(joint, plan, elapsed_s)
        return self._state

    def take_up(self, motion_s: float, speed_share: float) -> SetPoint:
        """Go on from `motion_s` later, at a share of the present speed: others have slowed the arm down."""
        q, speed, acceleration = self._state
        if motion_s > 0.0:
            q = tuple(a + v * motion_s for a, v in zip(q, speed, strict=True))
        self._state = SetPoint(q, tuple(v * speed_share for v in speed), tuple(0.0 for _ in acceleration))
        for joint, plan in enumerate(self._plans):
            if plan is not None:
                self._plan(joint)
        return self._state

    def _follow(self, joint: int, plan: "ruckig.Trajectory", elapsed_s: float) -> None:
        self._time_s[joint] += elapsed_s
        is_over = self._time_s[joint] >= plan.duration and not self._is_endless[joint]
        time_s = plan.duration if is_over else self._time_s[joint]  # beyond its end the joint keeps its speed
        (q,), (speed,), (acceleration,) = plan.at_time(time_s)
        if is_over:
            speed = acceleration = 0.0
            self._plans[joint] = None
        columns = [list(values) for values in self._state]
        for column, value in zip(columns, (q, speed, acceleration), strict=True):
            column[joint] = value
        self._state = SetPoint(tuple(columns[0]), tuple(columns[1]), tuple(columns[2]))

    def _plan(self, joint: int) -> None:
        import ruckig

        state, limits, wanted = self._state, self._limits, self._wanted[joint]
        asked: Any = ruckig.InputParameter(1)
        asked.current_position = [state.q_rad[joint]]
        asked.current_velocity = [state.speed_rad_s[joint]]
        asked.current_acceleration = [state.acceleration_rad_s2[joint]]
        asked.max_acceleration = [limits.acceleration_rad_s2[joint]]
        goal = self._goal(joint)
        asked.max_velocity = [abs(wanted) if goal is not None else limits.speed_rad_s[joint]]
        speed = 0.0 if self._is_at_end(joint) else wanted
        self._is_endless[joint] = goal is None and speed != 0.0
        if goal is None:
            asked.control_interface = ruckig.ControlInterface.Velocity
            asked.target_velocity = [speed]
        else:
            asked.target_position = [goal]
        what = f"jog of joint {joint + 1} at {wanted} rad/s from {state.q_rad[joint]} rad"
        trajectory = calculated(asked, [limits.jerk_rad_s3[joint]], what)
        self._plans[joint], self._time_s[joint] = trajectory, 0.0

    def _goal(self, joint: int) -> float | None:
        """Where the joint comes to rest by itself; None if it is to stop now or has no range."""
        wanted = self._wanted[joint]
        if (target := self._target[joint]) is not None:
            return target
        end = self._end(joint)
        return None if wanted == 0.0 or math.isinf(end) or self._is_at_end(joint) else end

    def _end(self, joint: int) -> float:
        is_up = self._wanted[joint] > 0.0
        return self._limits.upper_rad[joint] if is_up else self._limits.lower_rad[joint]

    def _is_at_end(self, joint: int) -> bool:
        """Whether the request leads beyond the joint's range, which it may already have left by hand."""
        wanted = self._wanted[joint]
        room = (self._end(joint) - self._state.q_rad[joint]) * wanted
        return wanted != 0.0 and self._target[joint] is None and room <= _NEAR_END_rad * abs(wanted)
