"""Inverse kinematics of position and orientation for one arm: all of a tip pose that its joints can hold.

An arm of six joints or more holds position and orientation exactly; one of three to five holds the position exactly and the
orientation as nearly as it can; with fewer, the tip is as near as possible. See control.kinematics.pose_solver.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from control.errors import NearSingular, OutOfReach
from control.kinematics import pose_solver
from control.kinematics import reach as problems
from control.kinematics import rotation as rotations
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics
from control.kinematics.numeric_inverse import Array, descended, seeds
from control.kinematics.reach import JointRange, travel_rad
from control.kinematics.rotation import Quaternion, checked_quaternion
from control.model.arm import Arm, Vector3

ORIENTATION_TOLERANCE_RAD = 2e-3  # the same: three decimals of a quaternion
SINGULAR_MARGIN_M = 0.005  # m/rad, as for positions
_SCATTERED, _SCATTERED_TURNED = 12, 40  # starting poses: with orientation, fewer of them lead to the target
_ANOTHER_RAD = 0.05  # solutions further apart than this are different ones


@dataclass(frozen=True, slots=True)
class TipPose:
    """A tip position [m] in the base frame, and the orientation of the last link frame, or None where it is free."""

    position_m: Vector3
    orientation: Quaternion | None = None

    @staticmethod
    def of(position_m: Sequence[float], orientation: Sequence[float] | None = None) -> "TipPose":
        """Check the numbers; BadTarget says what is wrong."""
        turned = None if orientation is None else checked_quaternion(orientation)
        return TipPose(problems.checked_point(position_m), turned)

    def targets(self) -> pose_solver.Targets:
        """This pose as a batch of one."""
        position = np.array([self.position_m])
        if self.orientation is None:
            return pose_solver.Targets(position, None)
        return pose_solver.Targets(position, rotations.matrices(np.array([self.orientation])))

    def __str__(self) -> str:
        turned = "" if self.orientation is None else f" at {_spelled_turn(self.orientation)}"
        return f"{problems.spelled(self.position_m)}{turned}"


class PoseInverse:
    """Joint angles for tip poses of one arm. Errors name the target and by how much it is missed."""

    def __init__(self, arm: Arm, kinematics: PoseKinematics | None = None) -> None:
        self.kinematics = kinematics or PoseKinematics(ForwardKinematics(arm))
        self._name = arm.name
        self._range = JointRange(arm)
        self._limits = np.array(arm.limits_rad)
        self._rest = arm.rest.q_rad if arm.rest is not None else (0.0,) * arm.joint_count
        self._tasks = {turned: pose_solver.task_of(self.kinematics, turned) for turned in (False, True)}

    def task(self, has_orientation: bool) -> pose_solver.Task:
        """What the arm's joints hold of a tip pose."""
        return self._tasks[has_orientation]

    def nearest(self, target: TipPose, q_near: Sequence[float]) -> tuple[float, ...]:
        """Joint angles for a target within the limits: the solution that a descent from `q_near` finds, else from other poses.

        Raises:
            OutOfReach, NearSingular, BadTarget.
        """
        return next(self.solutions(target, q_near))

    def solutions(self, target: TipPose, q_near: Sequence[float]) -> Iterator[tuple[float, ...]]:
        """Yield different solutions, the one from `q_near` first; errors as `nearest` if there is none."""
        self._range.check_pose(q_near)
        found: list[tuple[float, ...]] = []
        failures: list[OutOfReach | NearSingular] = []
        scattered = _SCATTERED if target.orientation is None else _SCATTERED_TURNED
        for start in seeds(self._limits, [q_near, self._rest], scattered):
            solved = self._descended(target, start)
            q = tuple(solved.q_rad[0].tolist())
            if failure := self._failure(target, solved):
                failures.append(failure)
            elif all(travel_rad(q, other) > _ANOTHER_RAD for other in found):
                found.append(q)
                yield q
        if not found:
            raise problems.most_telling(failures)

    def _descended(self, target: TipPose, start: Sequence[float]) -> pose_solver.SolvedPoses:
        """The best pose near `start`: all rows weighed against each other first, then the exact ones exactly."""
        aim = target.targets()
        rows = 3 if target.orientation is None else 6
        length = np.array([1.0] * 3 + [pose_solver.TURN_LENGTH_M] * 3)[:rows]

        def residual(q: Array) -> tuple[Array, Array]:
            position, rotation, jacobian = self.kinematics.at(*q.tolist())
            error = aim.position_m[0] - np.array(position)
            if aim.rotation is not None:
                turned = rotations.logarithms((aim.rotation[0] @ np.array(rotation).T)[None])[0]
                error = np.concatenate((error, turned))
            return length * error, length[:, None] * np.array(jacobian[:rows])

        near = np.array([descended(residual, start, self._limits).q])
        return pose_solver.solve(self.kinematics, self._tasks[target.orientation is not None], aim, near)

    def _failure(self, target: TipPose, solved: pose_solver.SolvedPoses) -> OutOfReach | NearSingular | None:
        """Why a descent did not lead to a usable pose, or None."""
        name, q = self._name, solved.q_rad[0].tolist()
        off_m, off_rad = (float(np.linalg.norm(part)) for part in (solved.error[0, :3], solved.error[0, 3:]))
        if off_m > pose_solver.POSITION_TOLERANCE_M or not solved.is_solved[0]:
            return problems.out_of_reach(name, target.position_m, off_m)
        if off_rad > ORIENTATION_TOLERANCE_RAD:
            return problems.not_turned(name, str(target), len(q), off_rad)
        if not self._range.is_inside(q):
            return problems.beyond_range(name, str(target), self._range.excess_rad(q))
        task = self._tasks[target.orientation is not None]
        margin, limit = float(pose_solver.margins(task, solved.tip.jacobian)[0]), SINGULAR_MARGIN_M
        if margin < limit:
            pose = "losing a direction of motion"
            return problems.near_singular(name, target.position_m, "arm", margin, limit, "m/rad", pose)
        return None


def _spelled_turn(orientation: Quaternion) -> str:
    return f"({', '.join(f'{value:.4f}' for value in orientation)})"
