"""Forward and inverse kinematics and the Jacobian, of one pose or of many at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import BadTarget, MissingModel
from control.kinematics import rotation
from control.kinematics.inverse import InverseKinematics, Solution
from control.kinematics.pose_inverse import PoseInverse, TipPose
from control.model.arm import Arm

Array = NDArray[np.float64]


class Kinematics:
    """The geometry of one arm with n joints: DH table and tool, from the arm's file.

    Joint angles in rad, tip positions in m in the base frame; a tip pose is position and orientation of the last link frame,
    x, y, z, qw, qx, qy, qz. Leading axes of an argument are kept: (n,) gives one result, (m, n) gives m of them. Angles are
    joint angles; effects between encoder and joint (backlash, compliance) are not included.
    """

    def __init__(self, arm: Arm) -> None:
        """The functions are compiled for the numbers of `arm` when they are first called, which takes some 10 ms."""
        self._inverse = InverseKinematics(arm)
        self._forward = self._inverse.kinematics
        self._posed = PoseInverse(arm, self._inverse.poses)
        self._rest_rad = arm.rest_rad
        self.joint_count = arm.joint_count

    def forward(self, joint_rad: ArrayLike) -> Array:
        """Tip positions (..., 3) [m] of joint angles (..., n). BadTarget for another shape or a non-finite number."""
        poses, shape = _rows(joint_rad, self.joint_count, "joint angles")
        return self._forward.tips(poses).reshape(*shape, 3)

    def pose(self, joint_rad: ArrayLike) -> Array:
        """Tip poses (..., 7) of joint angles (..., n). BadTarget as `forward`."""
        poses, shape = _rows(joint_rad, self.joint_count, "joint angles")
        found = self._inverse.poses.batch(poses)
        return np.hstack((found.position_m, rotation.quaternions(found.rotation))).reshape(*shape, 7)

    def jacobian(self, joint_rad: ArrayLike) -> Array:
        """Derivatives of the tip position by the joint angles, (..., 3, n) [m/rad], of (..., n). BadTarget as `forward`."""
        poses, shape = _rows(joint_rad, self.joint_count, "joint angles")
        return self._forward.jacobians(poses).reshape(*shape, 3, self.joint_count)

    def inverse(self, tip_m: ArrayLike, near_rad: ArrayLike | None = None) -> Array:
        """Joint angles (..., n) within the joint limits for tip positions (..., 3), to 1e-9 m, or tip poses (..., 7).

        Of several solutions for a position, one near `near_rad` (n,) or (..., n), by default the arm's rest pose: of the four
        branches the one with the least largest joint travel, on other arms the one to which short steps from there lead; for a
        pose, the one that a descent from there finds. An arm that cannot hold an orientation (five joints or fewer) holds what
        it can of it.

        Raises:
            OutOfReach: `distance_m` of the first such position from the reach.
            JointLimitViolated: only poses beyond the limits reach it; `joint` and `excess_rad` say by how much.
            NearSingular: the arm would lose a direction of motion there.
            BadTarget: another shape, or a number that is not finite.
        """
        tips, shape = _rows(tip_m, (3, 7), "tip positions")
        near = np.asarray(self._rest_rad if near_rad is None else near_rad, dtype=np.float64)
        try:
            starts = np.broadcast_to(near, (*shape, self.joint_count)).reshape(-1, self.joint_count)
        except ValueError:
            raise BadTarget(
                f"near_rad: expected shape ({self.joint_count},) or {(*shape, self.joint_count)}, got {near.shape}"
            ) from None
        solutions_rad = [
            nearest_rad(self._inverse, self._posed, tip, start) for tip, start in zip(tips.tolist(), starts.tolist(), strict=True)
        ]
        return np.array(solutions_rad, dtype=np.float64).reshape(*shape, self.joint_count)

    def solutions(self, tip_m: ArrayLike) -> tuple[Solution, ...]:
        """Every pose that reaches one tip position (3,), also beyond the joint limits, each with its branch.

        Raises as `inverse`, and MissingModel for an arm that is not yaw - pitch - pitch and has no named branches: `inverse` from
        different `near_rad` gives its solutions.
        """
        tips, shape = _rows(tip_m, 3, "tip position")
        if shape:
            raise BadTarget(f"tip position: expected shape (3,), got {(*shape, 3)}")
        if not self._inverse.has_branches:
            raise MissingModel("this arm has no named branches: `inverse` with different near_rad gives its solutions")
        return tuple(self._inverse.branches(tips[0].tolist()))


def nearest_rad(
    positions: InverseKinematics, poses: PoseInverse, tip: Sequence[float], near_rad: Sequence[float]
) -> tuple[float, ...]:
    """Joint angles for one tip position (3,), or one tip pose (7,)."""
    if len(tip) == 3:
        return positions.nearest(tip, near_rad)
    return poses.nearest(TipPose.of(tip[:3], tip[3:]), near_rad)


def _rows(values: ArrayLike, widths: int | tuple[int, ...], what: str) -> tuple[Array, tuple[int, ...]]:
    """`values` (..., width) as rows (m, width), and the shape of what is before the last axis; BadTarget for another width."""
    allowed = (widths,) if isinstance(widths, int) else widths
    width = " or ".join(f"(..., {one})" for one in allowed)
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise BadTarget(f"{what}: expected numbers of shape {width}") from None
    if array.ndim == 0 or array.shape[-1] not in allowed:
        raise BadTarget(f"{what}: expected shape {width}, got {array.shape}")
    if not np.isfinite(array).all():
        raise BadTarget(f"{what}: expected finite numbers")
    return array.reshape(-1, array.shape[-1]), array.shape[:-1]
