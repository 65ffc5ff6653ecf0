"""How free joints are resolved: stay near the pose before, away from joint limits and from singular poses.

Of the poses that hold the tip, each is the one nearest to the pose before. That one is first pushed off a joint's limit
within the outer fifth of its range, and up the gradient of the margin from singular poses where that is small (Siciliano et
al., Robotics, 3.5.1). The pushes fade in, so that the postures stay smooth.
"""

import numpy as np

from control.kinematics.pose_kinematics import PoseKinematics
from control.kinematics.pose_solver import SolvedPoses, Targets, Task, margins, solve
from control.motion.samples import Array

PUSH_RAD = 0.02  # at most, on each step of the tip (20 mm or 0.1 rad)
OUTER_SHARE = 0.2  # of half a joint's range
SAFE_MARGIN_M = 0.06  # m/rad: three times what a path may come down to
_SLOPE_RAD = 1e-4  # of the difference that gives the margin's gradient


class PostureRule:
    """The next pose along a path for one arm and task."""

    def __init__(self, kinematics: PoseKinematics, task: Task, limits_rad: Array) -> None:
        """`limits_rad`: (n, 2), infinite where there is none."""
        self._kinematics, self._task = kinematics, task
        self._is_free = task.freedom(kinematics.joint_count) > 0
        lower, upper = limits_rad.T
        is_bounded = np.isfinite(lower) & np.isfinite(upper)
        self._middle = np.where(is_bounded, 0.5 * (np.where(is_bounded, lower + upper, 0.0)), 0.0)
        self._half = np.where(is_bounded, 0.5 * (np.where(is_bounded, upper - lower, 0.0)), np.inf)

    def next(self, targets: Targets, before_rad: Array) -> SolvedPoses:
        """The pose (1, n) that holds the target, nearest to the pushed pose before (1, n)."""
        posture = before_rad + self._push(before_rad) if self._is_free else before_rad
        return solve(self._kinematics, self._task, targets, posture, before_rad)

    def _push(self, q_rad: Array) -> Array:
        """Away from limits and singular poses (1, n) [rad]."""
        offset = (q_rad - self._middle) / self._half
        outside = np.clip((np.abs(offset) - (1.0 - OUTER_SHARE)) / OUTER_SHARE, 0.0, 1.0)
        push = -PUSH_RAD * outside * np.sign(offset)
        margin = float(margins(self._task, self._kinematics.batch(q_rad).jacobian)[0])
        if margin < SAFE_MARGIN_M:
            gradient = self._gradient(q_rad)
            length = float(np.linalg.norm(gradient))
            if length > 0.0:
                push += PUSH_RAD * (1.0 - margin / SAFE_MARGIN_M) * gradient / length
        return np.asarray(push)

    def _gradient(self, q_rad: Array) -> Array:
        """Of the margin, (1, n), by central differences."""
        steps = _SLOPE_RAD * np.eye(q_rad.shape[1])
        around = margins(
            self._task, self._kinematics.batch(np.vstack((q_rad + steps, q_rad - steps))).jacobian
        )
        return np.asarray((around[: len(steps)] - around[len(steps) :])[None] / (2.0 * _SLOPE_RAD))
