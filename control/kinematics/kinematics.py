"""Forward kinematics of any arm of revolute joints: tip, Jacobian and their derivatives, scalar and in batches.

Everything is derived from `control.kinematics.chain`. The scalar functions are that chain, traced and compiled
for this arm's numbers (see `control.kinematics.tracing`); their derivatives are taken on the traced expression.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import MissingModel
from control.kinematics import chain
from control.kinematics.chain import tips_and_dh_jacobian
from control.kinematics.tracing import KEPT, Graph, Scalar, Symbol, compile_function, derivative, shared
from control.model.arm import Arm, Convention, Vector3

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]


class ForwardKinematics:
    """Forward kinematics of an arm's tip. Lengths in m, angles in rad, all in the base frame. Equal where the numbers are."""

    def __init__(self, arm: Arm) -> None:
        self.dh, self.convention, self.joints = arm.dh, arm.dh_convention, arm.joints
        self.tool_m = arm.tool.position_m
        self.joint_count = arm.joint_count

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ForwardKinematics) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)

    @property
    def _numbers(self) -> tuple[object, ...]:
        return self.dh.tobytes(), self.convention, self.joints, self.tool_m

    def traced_tip(self, q: Sequence[Symbol]) -> tuple[Any, ...]:
        """Return the tip as expressions of the symbols q."""
        return chain.tip(chain.steps(self.dh.tolist(), self.joints, self.convention), q, self.tool_m)

    @shared
    def tip(self) -> Callable[..., Vector3]:
        """`tip(q1, ..., qn) -> (x, y, z)`."""
        q = self._symbols()
        return compile_function("tip", q, self.traced_tip(q))

    @shared
    def tip_jacobian(self) -> Callable[..., tuple[Vector3, Rows]]:
        """`tip_jacobian(q1, ..., qn) -> ((x, y, z), three rows of n)`, rows in m/rad."""
        q = self._symbols()
        tip = self.traced_tip(q)
        return compile_function("tip_jacobian", q, (tip, _transposed([derivative(tip, s) for s in q])))

    @shared
    def _batch_jacobian(self) -> Callable[..., Any]:
        q = self._symbols()
        tip = self.traced_tip(q)
        columns = [derivative(tip, s) for s in q]
        return compile_function("jacobians", q, tuple(map(tuple, columns)), np)

    @shared
    def _batch_tip(self) -> Callable[..., Any]:
        q = self._symbols()
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

    def _symbols(self) -> list[Symbol]:
        graph = Graph()
        return [graph.variable(f"q{i}") for i in range(1, self.joint_count + 1)]


def _transposed(columns: Sequence[Sequence[Any]]) -> tuple[tuple[Any, ...], ...]:
    return tuple(tuple(column[i] for column in columns) for i in range(3))


# Position and orientation of the last frame with the tip, and their Jacobian: scalar and in batches, compiled for one arm.
#
# Rows 1 to 3 of the Jacobian are the tip's velocity [m/rad], rows 4 to 6 the angular velocity in the base frame: the joints'
# axes (Siciliano et al., Robotics: Modelling, Planning and Control, 3.1). Both DH conventions, see control.kinematics.chain.

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
        poses = Poses(np.empty((3, m)), np.empty((3, 3, m)), np.empty((6, n, m)))
        for i, value in enumerate(position):
            poses.position_m[i] = value
        for rows, values in ((poses.rotation, rotation), (poses.jacobian, jacobian)):
            for i, row in enumerate(values):
                for j, value in enumerate(row):
                    rows[i, j] = value
        return Poses(poses.position_m.T, poses.rotation.transpose(2, 0, 1), poses.jacobian.transpose(2, 0, 1))

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
        axes = [_turned(steps[: place + 1], q, _Z) for place, step in enumerate(steps) if step.joint is not None]
        x, z = _turned(steps, q, _X), _turned(steps, q, _Z)
        rotation = tuple(zip(x, _cross(z, x), z, strict=True))
        linear, angular = zip(*columns, strict=True), zip(*axes, strict=True)
        return q, tuple(position), rotation, (*map(tuple, linear), *map(tuple, angular))


def _turned(steps: Sequence[chain.ChainStep], q: Sequence[Scalar], direction: Vector3) -> tuple[Scalar, ...]:
    """A direction of the frame that the steps lead to, in the base frame: the chain without its lengths."""
    return chain.tip([step._replace(move=0.0) for step in steps], q, direction)


def _cross(a: Sequence[Scalar], b: Sequence[Scalar]) -> tuple[Scalar, ...]:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


class Corners:
    """Corner positions [m] in the base frame, from the base to the tip: of the moving link frames, and the tip.

    The body runs in straight lines between them, as thick as [[link]] radius_m says. Scalar for the cycle, and in batches for
    the check of a whole motion; from the same chain as the tip. Equal where the numbers are.

    `first_free`: index of the first corner that is not on the base or on the link that joint 2 hangs on to it.
    `radii_m`: of the body that ends at each corner. `joints`: how many joints move each. `start_m`: where the first of these
    bodies begins.
    """

    def __init__(self, arm: Arm) -> None:
        """MissingModel if nothing of the arm moves: the tip and all frames lie on all axes."""
        rows, radii = tuple(map(tuple, arm.dh.tolist())), tuple(link.radius_m for link in arm.links)
        self._numbers = rows, arm.joints, arm.dh_convention, arm.tool.position_m, radii
        self._inputs, self._outputs, self.first_free, self.radii_m, self.joints, self.start_m = _traced(*self._numbers)
        if not self._outputs:
            raise MissingModel(f"arm {arm.name}: no joint moves its tip or a link: check d_m and L_m of its links, and the tip")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Corners) and self._numbers == other._numbers

    def __hash__(self) -> int:
        return hash(self._numbers)

    @shared
    def at(self) -> Callable[..., tuple[Vector3, ...]]:
        """`at(q1, ..., qn)` -> the corners."""
        return compile_function("corners", self._inputs, self._outputs)

    def batch(self, q_rad: ArrayLike) -> list[NDArray[np.float64]]:
        """Corners of poses (m, n): one array (3, m) a corner."""
        poses = chain.checked_poses(q_rad, len(self._inputs))
        found = self._batch(*poses.T)
        return [np.stack([np.broadcast_to(x, len(poses)) for x in corner]) for corner in found]

    @shared
    def _batch(self) -> Callable[..., Any]:
        return compile_function("corners", self._inputs, self._outputs, np)


class TracedCorners(NamedTuple):
    """The angles' symbols, the corners as expressions of them, and what `Corners` says of these."""

    inputs: list[Symbol]
    outputs: tuple[tuple[Any, ...], ...]
    first_free: int
    radii_m: tuple[float, ...]
    joints: tuple[int, ...]
    start_m: Vector3


@lru_cache(maxsize=KEPT)
def _traced(
    rows: tuple[tuple[float, ...], ...],
    turns: tuple[bool, ...],
    convention: Convention,
    tool_m: Vector3,
    link_radii_m: tuple[float, ...],
) -> TracedCorners:
    """Without corners that never move or equal the one before."""
    graph = Graph()
    q = [graph.variable(f"q{i}") for i in range(1, sum(turns) + 1)]
    traced: list[tuple[Any, ...]] = []
    radii: list[float] = []
    joints: list[int] = []
    start_m: Vector3 = (0.0, 0.0, 0.0)
    first_free: int | None = None
    for count, (row, radius_m) in enumerate(zip(rows, link_radii_m, strict=True), start=1):
        steps = chain.steps(rows[:count], turns[:count], convention)
        corner, before = chain.tip(steps, q, (0.0, 0.0, 0.0)), sum(turns[:count])
        if not any(isinstance(x, Symbol) for x in corner):
            x, y, z = (float(value) for value in corner)
            start_m = (x, y, z)
        elif not (traced and _is_same(row)):
            traced.append(corner)
            radii.append(radius_m)
            joints.append(before)
        if first_free is None and before >= 2:
            first_free = max(len(traced) - 1, 0)
    if any(tool_m):
        traced.append(chain.tip(chain.steps(rows, turns, convention), q, tool_m))
        radii.append(link_radii_m[-1])
        joints.append(sum(turns))
    free = len(traced) if first_free is None else first_free
    return TracedCorners(q, tuple(traced), free, tuple(radii), tuple(joints), start_m)


def _is_same(row: Sequence[float]) -> bool:
    """Whether a link has no length, so that its frame's origin is that of the link before."""
    d_m, _, length_m, _ = row
    return d_m == 0.0 and length_m == 0.0
