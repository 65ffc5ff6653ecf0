"""Inverse kinematics of position and orientation for one arm: all of a tip pose that its joints can hold.

An arm of six joints or more holds position and orientation exactly; one of three to five holds the position exactly and the
orientation as nearly as it can; with fewer, the tip is as near as possible.
`solve` takes many poses at once, by Newton's method from nearby seeds: any number of joints, redundant or not.

Of the tip's six rows, three of position and three of orientation, a Task holds as many exactly as the arm's joints can, and the
others as nearly as they can. What freedom then is left goes to the reference posture: of all poses q that hold the tip, the one
nearest to q_ref. Each step solves

    min over dq   |S dq - e_s|^2 + w |dq - (q_ref - q)|^2    subject to   C dq = e_c

with the exact rows C, the nearest rows S and the tip's errors e (Siciliano et al., Robotics, 3.5; Nocedal and Wright, Numerical
Optimization, 16.1). Without nearest rows w does not matter. Speeds and accelerations solve the same with their own right sides.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from control.errors import NearSingular, OutOfReach
from control.kinematics import reach as problems
from control.kinematics import rotation as rotations
from control.kinematics.kinematics import ForwardKinematics, PoseKinematics, Poses
from control.kinematics.numeric_inverse import PROBES, RANK_M, Array, descended, seeds
from control.kinematics.reach import JointRange, travel_rad
from control.kinematics.rotation import Quaternion, checked_quaternion
from control.model.arm import Arm, Vector3

ACCURACY = 1e-9  # m and rad
POSITION_TOLERANCE_M = 1e-4  # where the joints cannot hold all: a way-point read off this arm is nearer
# A turn of 1 rad counts as much as 0.1 m, about a hand's length, where metres and radians have to be weighed.
TURN_LENGTH_M = 0.1
_POSITION, _ORIENTATION = (0, 1, 2), (3, 4, 5)
_STEPS = 40
LONGEST_STEP_RAD = 0.3  # a longer step may lead to another solution
_QUADRATIC = 1e-6  # rad: after a step this small, the next error is far below the accuracy
_LINEAR = 1e-10  # rad: the same where nearest rows converge only linearly
_POSTURE_WEIGHT = 1e-8  # m^2: of the posture beside the nearest rows; moves the tip by nothing that shows
_RIDGE = 1e-13  # m^2: keeps singular poses solvable; slows convergence there


@dataclass(frozen=True, slots=True)
class Task:
    """Rows of the tip (0 to 2 position, 3 to 5 orientation) that are held exactly, and those held as nearly as possible.

    `rank`: in how many directions the joints can move the exact rows, or, without any, the nearest ones.
    """

    exact: tuple[int, ...]
    nearest: tuple[int, ...]
    rank: int

    @property
    def has_orientation(self) -> bool:
        """Whether the tip's orientation matters."""
        return 3 in self.exact or 3 in self.nearest

    def freedom(self, joint_count: int) -> int:
        """Number of directions that are left to the posture."""
        if not self.exact:
            return joint_count - self.rank
        return max(joint_count - len(self.exact) - len(self.nearest), 0)


@dataclass(frozen=True, slots=True)
class Targets:
    """Tip positions (m, 3) [m] and rotations (m, 3, 3), or None where the orientation is free; base frame."""

    position_m: Array
    rotation: Array | None


@dataclass(frozen=True, slots=True)
class SolvedPoses:
    """Joint angles (m, n), the tip there, its errors (m, 6) [m, rad], and whether the exact rows are met (m,)."""

    q_rad: Array
    tip: Poses
    error: Array
    is_solved: NDArray[np.bool_]


def task_of(kinematics: PoseKinematics, has_orientation: bool) -> Task:
    """What this arm's joints can hold: rows that they can move independently in some pose are held exactly."""
    wanted = (_POSITION, _ORIENTATION) if has_orientation else (_POSITION,)
    probes = np.random.default_rng(0).uniform(-np.pi, np.pi, (PROBES, kinematics.joint_count))
    jacobians = scaled(kinematics.batch(probes).jacobian)
    for count in range(len(wanted), 0, -1):
        exact = sum(wanted[:count], ())
        if len(exact) <= kinematics.joint_count:
            smallest = np.linalg.svd(jacobians[:, exact], compute_uv=False)[:, -1]
            if smallest.max() > RANK_M:
                return Task(exact, sum(wanted[count:], ()), len(exact))
    rows = sum(wanted, ())
    sizes = np.linalg.svd(jacobians[:, rows], compute_uv=False)
    return Task((), rows, max(int((sizes > RANK_M).sum(axis=1).max()), 1))


def scaled(jacobians: Array) -> Array:
    """Jacobians (m, 6, n) with the rows of orientation in metres too."""
    return np.asarray(jacobians * np.array([1.0] * 3 + [TURN_LENGTH_M] * 3)[:, None])


def margins(task: Task, jacobians: Array) -> Array:
    """Least travel of the tip per radian in its weakest direction (m,) [m/rad]: the distance from a singular pose."""
    rows = task.exact or task.nearest
    return np.asarray(np.linalg.svd(scaled(jacobians)[:, rows], compute_uv=False)[:, task.rank - 1])


def errors(targets: Targets, tip: Poses) -> Array:
    """Wanted minus actual (m, 6): position [m], and the rotation vector [rad] from the actual to the wanted orientation."""
    error = np.zeros((len(tip.position_m), 6))
    error[:, :3] = targets.position_m - tip.position_m
    if targets.rotation is not None:
        error[:, 3:] = rotations.logarithms(targets.rotation @ np.swapaxes(tip.rotation, 1, 2))
    return error


def solve(
    kinematics: PoseKinematics, task: Task, targets: Targets, q_ref_rad: Array, seeds_rad: Array | None = None
) -> SolvedPoses:
    """Joint angles for the targets, nearest to the postures q_ref (m, n), which are the seeds by default."""
    q = np.array(q_ref_rad if seeds_rad is None else seeds_rad)
    enough = _LINEAR if task.nearest else _QUADRATIC
    tip = kinematics.batch(q)
    error = errors(targets, tip)
    for _ in range(_STEPS):
        step = joint_rates(task, tip.jacobian, error, q_ref_rad - q)
        largest = np.abs(step).max(initial=0.0)
        if largest > LONGEST_STEP_RAD:
            step *= np.minimum(1.0, LONGEST_STEP_RAD / np.maximum(np.abs(step).max(axis=1), 1e-300))[:, None]
        q += step
        tip = kinematics.batch(q)
        error = errors(targets, tip)
        if largest < enough:
            break
    is_solved = np.abs(error[:, task.exact]).max(axis=1, initial=0.0) < ACCURACY
    return SolvedPoses(q, tip, error, is_solved)


def joint_rates(task: Task, jacobians: Array, tip_rates: Array, posture_rates: Array) -> Array:
    """Joint rates (m, n) that move the tip by tip_rates (m, 6), and for the rest are nearest to posture_rates (m, n)."""
    exact = jacobians[:, task.exact]
    if not task.nearest:
        return _held(exact, tip_rates[:, task.exact], posture_rates)
    count, n = len(task.exact), jacobians.shape[2]
    held = _held(exact, tip_rates[:, task.exact], np.zeros_like(posture_rates)) if count else 0.0 * posture_rates
    # columns that leave the exact rows alone
    free = np.swapaxes(np.linalg.svd(exact)[2][:, count:], 1, 2) if count else np.eye(n)[None]
    weight = np.array([TURN_LENGTH_M if row > 2 else 1.0 for row in task.nearest])
    nearest = jacobians[:, task.nearest] * weight[:, None]
    missing = tip_rates[:, task.nearest] * weight - _times(nearest, held)
    slope = nearest @ free
    transposed = np.swapaxes(slope, 1, 2)
    hessian = transposed @ slope + _POSTURE_WEIGHT * np.eye(slope.shape[2])
    posture = _times(np.swapaxes(free, 1, 2), posture_rates - held)
    gradient = _times(transposed, missing) + _POSTURE_WEIGHT * posture
    return np.asarray(held + _times(free, _solved(hessian, gradient)))


def _held(exact: Array, wanted: Array, free: Array) -> Array:
    """The rates nearest to the free ones with which the exact rows move as wanted: free + C' (C C')^-1 (wanted - C free)."""
    transposed = np.swapaxes(exact, 1, 2)
    gram = exact @ transposed + _RIDGE * np.eye(exact.shape[1])
    return np.asarray(free + _times(transposed, _solved(gram, wanted - _times(exact, free))))


def _times(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _solved(matrices: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrices, right[:, :, None])[:, :, 0], dtype=np.float64)


ORIENTATION_TOLERANCE_RAD = 2e-3  # the same: three decimals of a quaternion
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

    def targets(self) -> Targets:
        """This pose as a batch of one."""
        position = np.array([self.position_m])
        if self.orientation is None:
            return Targets(position, None)
        return Targets(position, rotations.matrices(np.array([self.orientation])))

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
        self._rest = arm.rest_rad
        self._tasks = {turned: task_of(self.kinematics, turned) for turned in (False, True)}

    def task(self, has_orientation: bool) -> Task:
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
        postures: list[tuple[float, ...]] = []
        failures: list[OutOfReach | NearSingular] = []
        scattered = _SCATTERED if target.orientation is None else _SCATTERED_TURNED
        for start in seeds(self._limits, [q_near, self._rest], scattered):
            solved = self._descended(target, start)
            q = tuple(solved.q_rad[0].tolist())
            if failure := self._failure(target, solved):
                failures.append(failure)
            elif all(travel_rad(q, other) > _ANOTHER_RAD for other in postures):
                postures.append(q)
                yield q
        if not postures:
            raise problems.most_telling(failures)

    def _descended(self, target: TipPose, start: Sequence[float]) -> SolvedPoses:
        """The best pose near `start`: all rows weighed against each other first, then the exact ones exactly."""
        aim = target.targets()
        rows = 3 if target.orientation is None else 6
        length = np.array([1.0] * 3 + [TURN_LENGTH_M] * 3)[:rows]

        def residual(q: Array) -> tuple[Array, Array]:
            position, rotation, jacobian = self.kinematics.at(*q.tolist())
            error = aim.position_m[0] - np.array(position)
            if aim.rotation is not None:
                turned = rotations.logarithms((aim.rotation[0] @ np.array(rotation).T)[None])[0]
                error = np.concatenate((error, turned))
            return length * error, length[:, None] * np.array(jacobian[:rows])

        near = np.array([descended(residual, start, self._limits).q])
        return solve(self.kinematics, self._tasks[target.orientation is not None], aim, near)

    def _failure(self, target: TipPose, solved: SolvedPoses) -> OutOfReach | NearSingular | None:
        """Why a descent did not lead to a usable pose, or None."""
        name, q = self._name, solved.q_rad[0].tolist()
        off_m, off_rad = (float(np.linalg.norm(part)) for part in (solved.error[0, :3], solved.error[0, 3:]))
        if off_m > POSITION_TOLERANCE_M or not solved.is_solved[0]:
            return problems.out_of_reach(name, target.position_m, off_m)
        if off_rad > ORIENTATION_TOLERANCE_RAD:
            return problems.not_turned(name, str(target), len(q), off_rad)
        if not self._range.is_inside(q):
            beyond_rad, joint = self._range.farthest_rad(q)
            return problems.beyond_range(name, str(target), joint, beyond_rad)
        task = self._tasks[target.orientation is not None]
        margin = float(margins(task, solved.tip.jacobian)[0])
        if margin < problems.LOSES_A_DIRECTION.least:
            return problems.near_singular(name, target.position_m, problems.LOSES_A_DIRECTION, margin)
        return None


def _spelled_turn(orientation: Quaternion) -> str:
    return f"({', '.join(f'{value:.4f}' for value in orientation)})"
