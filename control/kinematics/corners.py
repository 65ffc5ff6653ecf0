"""Corners of an arm: the origins of its link frames that move, and the tip; its body runs in straight lines between them, as
thick as [[link]] radius_m says.

Scalar for the control cycle, and in batches for the check of a whole motion. From the same chain as the tip.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import MissingModel
from control.kinematics import chain
from control.kinematics.tracing import Graph, Symbol, compile_function
from control.model.arm import Arm, Vector3


class Corners:
    """Corner positions [m] in the base frame, from the base to the tip.

    `first_free`: index of the first corner that is not on the base or on the link that joint 2 hangs on to it.
    `radii_m`: of the body that ends at each corner. `joints`: how many joints move each. `start_m`: where the first of these
    bodies begins.
    """

    def __init__(self, arm: Arm) -> None:
        """MissingModel if nothing of the arm moves: the tip and all frames lie on all axes."""
        self._arm = arm
        graph = Graph()
        names = [graph.variable(f"q{i}") for i in range(1, arm.joint_count + 1)]
        self._inputs = names
        self._traced, self.first_free, self.radii_m = _traced(arm, names)
        if not self._traced:
            raise MissingModel(
                f"arm {arm.name}: no joint moves its tip or a link: check d_m and L_m of its links, and the tip"
            )
        self.joints, self.start_m = _carried(arm, names)

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
        q, outputs = self._inputs, tuple(self._traced)
        return (
            compile_function(name, q, outputs)
            if library is None
            else compile_function(name, q, outputs, library)
        )


def _traced(arm: Arm, q: list[Symbol]) -> tuple[list[tuple[Any, ...]], int, tuple[float, ...]]:
    """The corners as expressions, without those that never move or equal the one before; `first_free` and `radii_m`."""
    found: list[tuple[Any, ...]] = []
    radii: list[float] = []
    rows, turns = arm.dh.tolist(), arm.joints
    first_free: int | None = None
    for count in range(1, len(rows) + 1):
        steps = chain.steps(rows[:count], turns[:count], arm.dh_convention)
        corner = chain.tip(steps, q, (0.0, 0.0, 0.0))
        if any(isinstance(x, Symbol) for x in corner) and not (found and _is_same(rows[count - 1])):
            found.append(corner)
            radii.append(arm.links[count - 1].radius_m)
        if first_free is None and sum(turns[:count]) >= 2:
            first_free = max(len(found) - 1, 0)
        if count == len(rows) and any(arm.tool.position_m):
            found.append(chain.tip(steps, q, arm.tool.position_m))
            radii.append(arm.links[count - 1].radius_m)
    return found, len(found) if first_free is None else first_free, tuple(radii)


def _carried(arm: Arm, q: list[Symbol]) -> tuple[tuple[int, ...], Vector3]:
    """The number of joints before each corner, and the last origin of a frame that never moves."""
    rows, turns = arm.dh.tolist(), arm.joints
    joints: list[int] = []
    start_m: Vector3 = (0.0, 0.0, 0.0)
    for count in range(1, len(rows) + 1):
        corner = chain.tip(chain.steps(rows[:count], turns[:count], arm.dh_convention), q, (0.0, 0.0, 0.0))
        if not any(isinstance(x, Symbol) for x in corner):
            x, y, z = (float(value) for value in corner)
            start_m = (x, y, z)
        elif not (joints and _is_same(rows[count - 1])):
            joints.append(sum(turns[:count]))
    if any(arm.tool.position_m):
        joints.append(sum(turns))
    return tuple(joints), start_m


def _is_same(row: list[float]) -> bool:
    """Whether a link has no length, so that its frame's origin is that of the link before."""
    d_m, _, length_m, _ = row
    return d_m == 0.0 and length_m == 0.0
