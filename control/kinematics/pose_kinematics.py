"""Position and orientation of the last frame with the tip, and their Jacobian: scalar and in batches, compiled for one arm.

Rows 1 to 3 of the Jacobian are the tip's velocity [m/rad], rows 4 to 6 the angular velocity in the base frame: the joints'
axes (Siciliano et al., Robotics: Modelling, Planning and Control, 3.1). Both DH conventions, see control.kinematics.chain.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.kinematics import chain
from control.kinematics.kinematics import ForwardKinematics
from control.kinematics.straight_line import compile_function, derivative, shared
from control.kinematics.tracing import Graph, Scalar
from control.model.arm import Vector3

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]
_X, _Z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


class Poses(NamedTuple):
    """Positions (m, 3) [m], rotations base_R_tip (m, 3, 3), and Jacobians (m, 6, n) of m poses."""

    position_m: Array
    rotation: Array
    jacobian: Array


class PoseKinematics:
    """Forward kinematics of an arm's tip with its orientation, which is that of the last link frame."""

    def __init__(self, kinematics: ForwardKinematics) -> None:
        self.kinematics = kinematics
        self.joint_count = kinematics.joint_count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PoseKinematics) and self.kinematics == other.kinematics

    def __hash__(self) -> int:
        return hash(self.kinematics)

    @shared
    def at(self) -> Callable[..., tuple[Vector3, Rows, Rows]]:
        """`at(q1, ..., qn) -> (position, rotation's rows, Jacobian's six rows)`, in plain floats."""
        q, position, rotation, jacobian = self._traced()
        return compile_function("tip_pose", q, (position, rotation, jacobian))

    def batch(self, q_rad: ArrayLike) -> Poses:
        """Position, rotation and Jacobian of poses (m, n)."""
        q = chain.checked_poses(q_rad, self.joint_count)
        m, n = q.shape
        position, rotation, jacobian = self._batch(*q.T)
        found = Poses(np.empty((3, m)), np.empty((3, 3, m)), np.empty((6, n, m)))
        for i, value in enumerate(position):
            found.position_m[i] = value
        for rows, values in ((found.rotation, rotation), (found.jacobian, jacobian)):
            for i, row in enumerate(values):
                for j, value in enumerate(row):
                    rows[i, j] = value
        return Poses(found.position_m.T, found.rotation.transpose(2, 0, 1), found.jacobian.transpose(2, 0, 1))

    @shared
    def _batch(self) -> Callable[..., Any]:
        q, position, rotation, jacobian = self._traced()
        return compile_function("tip_poses", q, (position, rotation, jacobian), np)

    def _traced(self) -> tuple[list[Any], Any, Any, Any]:
        """The symbols q, and position, rotation and Jacobian as expressions of them."""
        k, graph = self.kinematics, Graph()
        q = [graph.variable(f"q{i}") for i in range(1, k.joint_count + 1)]
        steps = chain.steps(k.dh.tolist(), k.joints, k.convention)
        position = k.traced_tip(q)
        columns = [derivative(position, angle) for angle in q]
        axes = [
            _turned(steps[: place + 1], q, _Z) for place, step in enumerate(steps) if step.joint is not None
        ]
        x, z = _turned(steps, q, _X), _turned(steps, q, _Z)
        rotation = tuple(zip(x, _cross(z, x), z, strict=True))
        linear, angular = zip(*columns, strict=True), zip(*axes, strict=True)
        return q, tuple(position), rotation, (*map(tuple, linear), *map(tuple, angular))


def _turned(steps: Sequence[chain.ChainStep], q: Sequence[Scalar], direction: Vector3) -> tuple[Scalar, ...]:
    """A direction of the frame that the steps lead to, in the base frame: the chain without its lengths."""
    return chain.tip([step._replace(move=0.0) for step in steps], q, direction)


def _cross(a: Sequence[Scalar], b: Sequence[Scalar]) -> tuple[Scalar, ...]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
