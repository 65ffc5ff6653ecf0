"""Arms of any number of joints: the tip is held as the task says, and free joints stay near a reference posture.

The reference is found once, along the path in small steps from the start. Every pose of the path is then the
one nearest to it that holds the tip. So a pose depends on where the path is and not on how it was sampled.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from control.errors import ArmError
from control.kinematics import inverse_errors as problems
from control.kinematics.kinematics import PoseKinematics
from control.kinematics.pose_inverse import (
    ORIENTATION_TOLERANCE_RAD,
    SINGULAR_MARGIN_M,
    PoseInverse,
    TipPose,
)
from control.kinematics.pose_solver import (
    POSITION_TOLERANCE_M,
    TURN_LENGTH_M,
    SolvedPoses,
    Targets,
    Task,
    margins,
    solve,
)
from control.model.arm import Arm
from control.motion import checks
from control.motion.checks import Array, JointSamples, TipSamples, sample_tip, solve_joints
from control.motion.errors import PathError
from control.motion.following.follower import (
    LEAST_SAMPLES,
    SEED_STEP_M,
    Followed,
    OrientationSpline,
    PathStart,
    Pose,
)
from control.motion.spline import CartesianSpline, TimedWaypoints, continuous_velocities
from control.motion.waypoints import Waypoints


# The reference posture: smooth joint angles over time through known poses, to which redundant joints stay near.
class ReferencePosture:
    """Cubics through poses (k + 1, n) at `times_s`, acceleration continuous, at rest at both ends."""

    def __init__(self, times_s: Sequence[float], poses: Sequence[Sequence[float]]) -> None:
        rest = (0.0,) * len(poses[0])
        steps = np.diff(times_s).tolist()
        velocity = np.array(continuous_velocities(poses, steps, rest, rest))
        h, q = np.diff(times_s)[:, None], np.array(poses, dtype=np.float64)
        slope = np.diff(q, axis=0) / h
        self._times_s = np.asarray(times_s, dtype=np.float64)
        self._c0, self._c1 = q[:-1], velocity[:-1]
        self._c2 = (3.0 * slope - 2.0 * velocity[:-1] - velocity[1:]) / h
        self._c3 = (velocity[:-1] + velocity[1:] - 2.0 * slope) / h**2

    def at(self, times_s: Array) -> tuple[Array, Array, Array]:
        """Angles, speeds and accelerations (m, n) at times (m,)."""
        section = np.clip(np.searchsorted(self._times_s, times_s, "right") - 1, 0, len(self._c0) - 1)
        t = (times_s - self._times_s[section])[:, None]
        c1, c2, c3 = self._c1[section], self._c2[section], self._c3[section]
        return (
            self._c0[section] + t * (c1 + t * (c2 + t * c3)),
            c1 + t * (2.0 * c2 + 3.0 * t * c3),
            2.0 * c2 + 6.0 * t * c3,
        )


JUMP_RAD = 0.5  # between two steps; more is a jump to another solution
# How far the tip may leave the cubic between way-points where the joints cannot hold all of it.
FARTHEST_OFF_M, FARTHEST_OFF_RAD = 0.02, 0.2


class PostureFollower:
    """Implements Follower for any arm."""

    def __init__(self, arm: Arm, inverse: PoseInverse, waypoints: Waypoints) -> None:
        self._name, self._inverse, self._waypoints = arm.name, inverse, waypoints
        self._kinematics = inverse.kinematics
        self._task = inverse.task(waypoints.orientations is not None)
        self._rule = PostureRule(self._kinematics, self._task, np.array(arm.limits_rad))
        self._known: tuple[PathStart, list[float], list[Pose]] | None = None

    def starts(self, q_near: Sequence[float]) -> Iterator[PathStart]:
        """Solutions at the first way-point, the one from `q_near` first."""
        try:
            for q in self._inverse.solutions(self._wanted(0), q_near):
                yield PathStart(q)
        except ArmError as problem:
            raise PathError(f"{self._waypoints.name(1)}: {problem}; nothing was moved", 1) from problem

    def _wanted(self, index: int) -> TipPose:
        turned = self._waypoints.orientations
        return TipPose.of(self._waypoints.points[index], None if turned is None else turned[index])

    def check(self, start: PathStart) -> None:
        """Nothing: following the path finds what cannot be reached."""

    def follow(
        self, recipe: TimedWaypoints, spline: CartesianSpline, start: PathStart, rate_Hz: float
    ) -> Followed:
        """Every sample by Newton from the reference posture."""
        turn = self._turn(recipe, spline)
        if self._known is None or self._known[0] is not start:
            self._known = (start, *self._postures(recipe, spline, turn, start))
        _, fractions, poses = self._known
        reference = ReferencePosture(self._times(spline, fractions), poses)
        tip = self._sampled(spline, turn, rate_Hz)
        joints = solve_joints(self._kinematics, self._task, tip, reference.at(tip.times_s))
        self._require_near(spline, tip, joints)
        first = np.flatnonzero(np.diff(tip.section, prepend=-1))
        at_waypoints = [joints.q_rad[i] for i in (*first, len(tip.times_s) - 1)]
        return Followed(tip, joints, tuple(tuple(q.tolist()) for q in at_waypoints))

    def _turn(self, recipe: TimedWaypoints, spline: CartesianSpline) -> OrientationSpline | None:
        turned = self._waypoints.orientations
        if turned is None:
            return None
        rests = [speed == 0.0 for speed in recipe.speeds_m_s]
        return OrientationSpline(spline.times_s, turned, rests)

    def _sampled(self, spline: CartesianSpline, turn: OrientationSpline | None, rate_Hz: float) -> TipSamples:
        tip = sample_tip(spline, rate_Hz, LEAST_SAMPLES)
        if turn is None:
            return tip
        into = tip.times_s - np.array(spline.times_s)[tip.section]
        return TipSamples(
            tip.times_s, tip.section, tip.position_m, tip.velocity_m_s, tip.acceleration_m_s2,
            turn.sample(tip.section, into),
        )  # fmt: skip

    # ---- the reference posture

    @staticmethod
    def _times(spline: CartesianSpline, fractions: Sequence[float]) -> list[float]:
        """Times of section numbers with fractions: 2.5 is in the middle of the third section."""
        return np.interp(fractions, np.arange(len(spline.times_s)), spline.times_s).tolist()

    def _postures(
        self,
        recipe: TimedWaypoints,
        spline: CartesianSpline,
        turn: OrientationSpline | None,
        start: PathStart,
    ) -> tuple[list[float], list[Pose]]:
        """Fractions and poses, followed in small steps from the start."""
        turns = recipe.turns_rad or (0.0,) * len(recipe.lengths_m)
        fractions = [0.0]
        for section, (length, angle) in enumerate(zip(recipe.lengths_m, turns, strict=True)):
            count = 2 + int(max(length, TURN_LENGTH_M * angle) / SEED_STEP_M)
            fractions += [section + k / count for k in range(1, count + 1)]
        times_s = self._times(spline, fractions)
        poses = [np.array([start.q_rad])]
        for fraction, time_s in zip(fractions[1:], times_s[1:], strict=True):
            section = min(int(np.ceil(fraction)) - 1, len(spline.times_s) - 2)
            rotation = None
            if turn is not None:
                into = np.array([time_s - spline.times_s[section]])
                rotation = turn.sample(np.array([section]), into).rotation
            position = spline.at(time_s)[0]
            found = self._rule.next(Targets(np.array([position]), rotation), poses[-1])
            travel_rad = float(np.abs(found.q_rad - poses[-1]).max())
            if travel_rad > JUMP_RAD or not found.is_solved[0]:
                where, number = checks.place(self._waypoints, spline.times_s, time_s)
                problem = self._lost(position, found, travel_rad)
                raise PathError(f"{where}: {problem}; nothing was moved", number)
            poses.append(found.q_rad)
        return fractions, [tuple(q[0].tolist()) for q in poses]

    def _lost(self, position: Sequence[float], found: SolvedPoses, travel_rad: float) -> ArmError:
        """Why no pose follows the one before."""
        off_m = float(np.linalg.norm(found.error[0, :3]))
        if found.is_solved[0]:
            return problems.jump(self._name, position, travel_rad, JUMP_RAD)
        if off_m > POSITION_TOLERANCE_M:
            return problems.out_of_reach(self._name, position, off_m)
        margin = float(
            margins(self._task, found.tip.jacobian)[0]
        )  # so near, Newton's method only fails there
        pose = "losing a direction of motion"
        return problems.near_singular(self._name, position, "arm", margin, SINGULAR_MARGIN_M, "m/rad", pose)

    def _require_near(self, spline: CartesianSpline, tip: TipSamples, joints: JointSamples) -> None:
        """PathError where the tip leaves what was asked for: at a way-point by the tolerance, between them by more."""
        if not self._task.nearest:
            return
        is_between = np.abs(tip.times_s[:, None] - np.array(spline.times_s)).min(axis=1) > 1e-9
        for rows, tolerance, farthest, unit in (
            (slice(0, 3), POSITION_TOLERANCE_M, FARTHEST_OFF_M, "m"),
            (slice(3, 6), ORIENTATION_TOLERANCE_RAD, FARTHEST_OFF_RAD, "rad"),
        ):
            off = np.linalg.norm(joints.off[:, rows], axis=1)
            excess = off / np.where(is_between, farthest, tolerance)
            worst = int(excess.argmax())
            if excess[worst] > 1.0:
                where, number = checks.place(self._waypoints, spline.times_s, float(tip.times_s[worst]))
                what = "position" if unit == "m" else "orientation"
                raise PathError(
                    f"{where}: the {joints.q_rad.shape[1]} joints of arm {self._name} come no nearer than {off[worst]:.4f} {unit}"
                    f" to the {what} (allowed {tolerance:g} at a way-point, {farthest:g} between two); nothing was moved",
                    number,
                )


# How free joints are resolved: stay near the pose before, away from joint limits and from singular poses.
#
# Of the poses that hold the tip, each is the one nearest to the pose before. That one is first pushed off a joint's limit
# within the outer fifth of its range, and up the gradient of the margin from singular poses where that is small (Siciliano et
# al., Robotics, 3.5.1). The pushes fade in, so that the postures stay smooth.
PUSH_RAD = 0.02  # at most, on each step of the tip (20 mm or 0.1 rad)
OUTER_SHARE = 0.2  # of half a joint's range
SAFE_MARGIN_M = 0.06  # m/rad: three times what a path may come down to
_MARGIN_SLOPE_RAD = 1e-4  # of the difference that gives the margin's gradient


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
        steps = _MARGIN_SLOPE_RAD * np.eye(q_rad.shape[1])
        around = margins(
            self._task, self._kinematics.batch(np.vstack((q_rad + steps, q_rad - steps))).jacobian
        )
        return np.asarray((around[: len(steps)] - around[len(steps) :])[None] / (2.0 * _MARGIN_SLOPE_RAD))
