"""Forward kinematics of any arm of revolute joints: tip, Jacobian and their derivatives, scalar and in batches.

Everything is derived from `control.kinematics.chain`. The scalar functions are that chain, traced and compiled
for this arm's numbers (see `control.kinematics.tracing`); their derivatives are taken on the traced expression.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import ArmError
from control.kinematics import chain
from control.kinematics.chain_jacobian import tips_and_dh_jacobian
from control.kinematics.straight_line import compile_function, derivative, shared
from control.kinematics.tracing import Graph, Symbol
from control.model.arm import Arm, Convention, Vector3

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]


class ForwardKinematics:
    """Forward kinematics of an arm's tip. Lengths in m, angles in rad, everything in the base frame. Equal where the numbers are.

    Args:
        arm_or_dh: an Arm, or a DH table (links, 4) with columns d, theta, L, alpha.
        convention: of a DH table, "standard" or "modified"; an Arm has its own.
        joints: of a DH table, for each link whether its joint turns; all by default.
        tool_m: of a DH table, the tip in the last frame.
    """

    def __init__(
        self,
        arm_or_dh: Arm | ArrayLike,
        convention: Convention = "standard",
        joints: Sequence[bool] | None = None,
        tool_m: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        if isinstance(arm_or_dh, Arm):
            arm = arm_or_dh
            self.dh, self.convention, self.joints = arm.dh, arm.dh_convention, arm.joints
            self.tool_m: Vector3 = arm.tool.position_m
        else:
            self.dh = np.array(arm_or_dh, dtype=np.float64)
            self.convention = convention
            self.joints = tuple(joints) if joints is not None else (True,) * len(self.dh)
            self.tool_m = (float(tool_m[0]), float(tool_m[1]), float(tool_m[2]))
        self._check()
        self.joint_count = sum(self.joints)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ForwardKinematics) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)

    @property
    def _numbers(self) -> tuple[object, ...]:
        return self.dh.tobytes(), self.convention, self.joints, self.tool_m

    def _check(self) -> None:
        if self.dh.ndim != 2 or self.dh.shape != (len(self.joints), 4) or not np.isfinite(self.dh).all():
            expected = f"expected a finite DH table ({len(self.joints)}, 4)"
            raise ArmError(f"kinematics: {expected}, got shape {self.dh.shape}")
        if self.convention not in ("standard", "modified"):
            raise ArmError(f'DH convention: expected "standard" or "modified", got "{self.convention}"')

    def traced_tip(self, q: Sequence[Symbol]) -> tuple[Any, ...]:
        """Return the tip as expressions of the symbols q."""
        return chain.tip(chain.steps(self.dh.tolist(), self.joints, self.convention), q, self.tool_m)

    @shared
    def tip(self) -> Callable[..., Vector3]:
        """`tip(q1, ..., qn) -> (x, y, z)`."""
        q = self._symbols(Graph(), "q")
        return compile_function("tip", q, self.traced_tip(q))

    @shared
    def tip_jacobian(self) -> Callable[..., tuple[Vector3, Rows]]:
        """`tip_jacobian(q1, ..., qn) -> ((x, y, z), three rows of n)`, rows in m/rad."""
        q = self._symbols(Graph(), "q")
        tip = self.traced_tip(q)
        return compile_function("tip_jacobian", q, (tip, _transposed([derivative(tip, s) for s in q])))

    @shared
    def tip_bias(self) -> Callable[[Sequence[float], Sequence[float]], Vector3]:
        """`tip_bias(q, qd) -> Jdot qd`, the tip's acceleration [m/s^2] at constant joint speeds."""
        graph = Graph()
        q, speeds = self._symbols(graph, "q"), self._symbols(graph, "s")
        velocity = _rate(self.traced_tip(q), q, speeds)
        return compile_function("tip_bias", [q, speeds], tuple(_rate(velocity, q, speeds)))

    @shared
    def _batch_jacobian(self) -> Callable[..., Any]:
        q = self._symbols(Graph(), "q")
        tip = self.traced_tip(q)
        columns = [derivative(tip, s) for s in q]
        return compile_function("jacobians", q, tuple(map(tuple, columns)), np)

    @shared
    def _batch_tip(self) -> Callable[..., Any]:
        q = self._symbols(Graph(), "q")
        return compile_function("tips", q, self.traced_tip(q), np)

    def tips(self, q: ArrayLike) -> Array:
        """Return the tips (m, 3) of poses (m, n)."""
        poses = self.poses(q)
        result = np.empty((len(poses), 3))
        result[:, 0], result[:, 1], result[:, 2] = self._batch_tip(*poses.T)
        return result

    def jacobians(self, q: ArrayLike) -> Array:
        """Return the Jacobians (m, 3, n) [m/rad] of poses (m, n)."""
        poses = self.poses(q)
        result = np.empty((len(poses), 3, self.joint_count))
        for joint, column in enumerate(self._batch_jacobian(*poses.T)):
            result[:, 0, joint], result[:, 1, joint], result[:, 2, joint] = column
        return result

    def identification_jacobian(self, q: ArrayLike) -> Array:
        """Return d tip / d dh.ravel() (m, 3, 4 links) of poses (m, n): each link's d, theta, L, alpha in turn."""
        return self.tips_and_dh_jacobian(q)[1]

    def tips_and_dh_jacobian(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return tips (m, 3) and the identification Jacobian (m, 3, 4 links) of poses (m, n)."""
        return tips_and_dh_jacobian(self.dh, self.poses(q), self.joints, self.convention, self.tool_m)

    def link_transforms(self, q: ArrayLike) -> Array:
        """Return base_T_link (m, links + 1, 4, 4) of poses (m, n); index 0 is the base frame itself."""
        return chain.link_transforms(self.dh, self.poses(q), self.joints, self.convention)

    def poses(self, q: ArrayLike) -> Array:
        """Return q as a finite array (m, n), or raise BadTarget."""
        return chain.checked_poses(q, self.joint_count)

    def _symbols(self, graph: Graph, prefix: str) -> list[Symbol]:
        return [graph.variable(f"{prefix}{i}") for i in range(1, self.joint_count + 1)]


def _transposed(columns: Sequence[Sequence[Any]]) -> tuple[tuple[Any, ...], ...]:
    return tuple(tuple(column[i] for column in columns) for i in range(3))


def _rate(outputs: Sequence[Any], variables: Sequence[Symbol], rates: Sequence[Symbol]) -> list[Any]:
    """Return the outputs' derivatives by time when the variables change at the given rates."""
    result: list[Any] = [0.0] * len(outputs)
    for variable, rate in zip(variables, rates, strict=True):
        slopes = derivative(outputs, variable)
        result = [total + slope * rate for total, slope in zip(result, slopes, strict=True)]
    return result
