"""Corners of an arm: the origins of its link frames that leave the base, and the tip; straight lines between them are its body.

Scalar for the control cycle, and in batches for the check of a whole motion. From the same chain as the tip.
"""

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.kinematics import chain
from control.kinematics.straight_line import compile_function
from control.kinematics.tracing import Graph, Symbol
from control.model.arm import Arm, Vector3

_SAME_m = 1e-9


class Corners:
    """Corner positions [m] in the base frame, from the base to the tip."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    @cached_property
    def at(self) -> Callable[..., tuple[Vector3, ...]]:
        """`at(q1, ..., qn)` -> the corners."""
        return self._compiled("corners", None)

    def batch(self, q_rad: ArrayLike) -> list[NDArray[np.float64]]:
        """Corners of poses (m, n): one array (3, m) a corner."""
        poses = chain.checked_poses(q_rad, self._arm.joint_count)
        found = self._batch(*poses.T)
        return [np.stack([np.broadcast_to(x, len(poses)) for x in corner]) for corner in found]

    @cached_property
    def _batch(self) -> Callable[..., Any]:
        return self._compiled("corners", np)

    def _compiled(self, name: str, library: Any) -> Callable[..., Any]:
        graph = Graph()
        q = [graph.variable(f"q{i}") for i in range(1, self._arm.joint_count + 1)]
        outputs = tuple(self._traced(q))
        return (
            compile_function(name, q, outputs)
            if library is None
            else compile_function(name, q, outputs, library)
        )

    def _traced(self, q: list[Symbol]) -> list[tuple[Any, ...]]:
        """The corners as expressions; those that stay in the base, and those that equal the one before, are left out."""
        arm, found = self._arm, list[tuple[Any, ...]]()
        rows, turns = arm.dh.tolist(), arm.joints
        for count in range(1, len(rows) + 1):
            steps = chain.steps(rows[:count], turns[:count], arm.dh_convention)
            is_last = count == len(rows)
            corner = chain.tip(steps, q, (0.0, 0.0, 0.0))
            does_move = any(isinstance(x, Symbol) for x in corner) and not self._is_of_the_base(steps)
            if does_move and (not found or not _is_same(rows[count - 1])):
                found.append(corner)
            if is_last and any(arm.tool.position_m):
                found.append(chain.tip(steps, q, arm.tool.position_m))
        return found

    def _is_of_the_base(self, steps: list[chain.Step]) -> bool:
        """Whether a frame's origin turns with joint 1 within the base: the place of joint 2, also on an arm whose calibration
        put it beside axis 1.
        """
        n, limits = self._arm.joint_count, self._arm.limits
        if n == 1:
            return False
        x, y, z = chain.tip(steps, [0.0] * n, (0.0, 0.0, 0.0))
        elsewhere = chain.tip(steps, [0.0, *(1.0 + k for k in range(1, n))], (0.0, 0.0, 0.0))
        is_of_joint_1 = math.dist((x, y, z), elsewhere) < _SAME_m
        return is_of_joint_1 and math.hypot(x, y) <= limits.base_radius_m + limits.floor_tolerance_m


def _is_same(row: list[float]) -> bool:
    """Whether a link has no length, so that its frame's origin is that of the link before."""
    d_m, _, length_m, _ = row
    return d_m == 0.0 and length_m == 0.0
