"""Ways to follow the tip's path with the joints, as the planner needs them: on a branch, or by a reference posture."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from control.errors import ArmError, PathError
from control.kinematics import pose_inverse
from control.kinematics import reach as problems
from control.kinematics import rotation as rotations
from control.kinematics.inverse import Branch, InverseKinematics, Solution
from control.kinematics.kinematics import PoseKinematics
from control.kinematics.pose_inverse import ORIENTATION_TOLERANCE_RAD, PoseInverse, TipPose
from control.kinematics.rotation import Quaternion
from control.model.arm import Arm
from control.motion import checks
from control.motion.checks import Array, JointSamples, TipSamples, TurnSamples, sample_tip, solve_joints
from control.motion.joint_path import JointPath, quintic
from control.motion.spline import CartesianSpline, TimedWaypoints, continuous_velocities
from control.motion.waypoints import Waypoints

Pose = tuple[float, ...]
SEED_STEP_M = 0.02  # between poses that are solved one after the other


@dataclass(frozen=True, slots=True)
class PathStart:
    """A pose in which the path can begin, and its branch where those have names."""

    q_rad: Pose
    branch: Branch | None = None


@dataclass(frozen=True, slots=True)
class Followed:
    """Tip and joints all along the path, and the poses at the way-points."""

    tip: TipSamples
    joints: JointSamples
    at_waypoints: tuple[Pose, ...]


class Follower(Protocol):
    """Follows one set of way-points with one arm; errors are PathError and name the way-point."""

    def starts(self, q_near: Sequence[float]) -> Iterator[PathStart]:
        """Poses at the first way-point, nearest first."""
        ...

    def check(self, start: PathStart) -> None:
        """PathError if a way-point cannot be reached from this start."""
        ...

    def follow(self, recipe: TimedWaypoints, spline: CartesianSpline, start: PathStart, rate_Hz: float) -> Followed:
        """Sample the path at a rate, or at `checks.LEAST_SAMPLES` a section."""
        ...


# The tip's orientation along a path: in each section the rotation vector from its start is a cubic over time.
#
#     R(t) = R_i exp(r(t)),   r(t) = c1 t + c2 t^2 + c3 t^3     (the cubic of SpringerPlus 5:1771, eq. (3), with a0 = 0)
#
# Between two way-points, from rest to rest, this is slerp with the cubic's timing. The angular velocity is continuous: at an
# inner way-point it is that of the parabola through the neighbouring turns, and zero where the path rests.

_DIFFERENCE = 1e-4  # of a section's time, for the angular acceleration: 1e-8 relative


def turns_rad(orientations: Sequence[Quaternion]) -> tuple[float, ...]:
    """Angle [rad] between each orientation and the next, at most half a turn."""
    return tuple(float(np.linalg.norm(rotations.between(a, b))) for a, b in pairwise(orientations))


class OrientationSpline:
    """Orientations at `times_s` (k + 1), and all between them. `rests` (k + 1): where the tip does not turn."""

    def __init__(self, times_s: Sequence[float], orientations: Sequence[Quaternion], rests: Sequence[bool]) -> None:
        at = rotations.matrices(np.array(orientations, dtype=np.float64))
        self._starts, back = at[:-1], np.swapaxes(at[:-1], 1, 2)
        turn = rotations.logarithms(back @ at[1:])
        duration = np.diff(np.asarray(times_s))[:, None]
        velocity = self._velocities(turn, duration, np.asarray(rests))
        first = (back @ velocity[:-1, :, None])[:, :, 0]
        last = np.linalg.solve(rotations.left_jacobians(turn), back @ velocity[1:, :, None])[:, :, 0]
        slope = turn / duration
        self._c1 = first
        self._c2 = (3.0 * slope - 2.0 * first - last) / duration
        self._c3 = (first + last - 2.0 * slope) / duration**2
        self._step_s = _DIFFERENCE * duration

    def _velocities(self, turn: Array, duration: Array, rests: NDArray[np.bool_]) -> Array:
        """Angular velocities (k + 1, 3) [rad/s] at the way-points, in the base frame."""
        rate = (self._starts @ (turn / duration)[:, :, None])[:, :, 0]
        velocity = np.zeros((len(rate) + 1, 3))
        before, after = duration[:-1], duration[1:]
        velocity[1:-1] = (after * rate[:-1] + before * rate[1:]) / (before + after)
        velocity[rests] = 0.0
        return velocity

    def sample(self, section: NDArray[np.int64], t_s: Array) -> TurnSamples:
        """Rotation, angular velocity and acceleration in the base frame, `t_s` (m,) into each sample's section (m,)."""
        t, h = t_s[:, None], self._step_s[section]
        c1, c2, c3 = self._c1[section], self._c2[section], self._c3[section]
        start = self._starts[section]

        def velocity(time: Array) -> Array:
            r, rate = time * (c1 + time * (c2 + time * c3)), c1 + time * (2.0 * c2 + 3.0 * time * c3)
            return np.asarray((start @ (rotations.left_jacobians(r) @ rate[:, :, None]))[:, :, 0])

        return TurnSamples(
            rotation=start @ rotations.exponentials(t * (c1 + t * (c2 + t * c3))),
            velocity_rad_s=velocity(t),
            acceleration_rad_s2=(velocity(t + h) - velocity(t - h)) / (2.0 * h),
        )


# A followed path as joint sections for the loop: quintics between as few of its samples as keep the tip on the path.
#
# A section is halved until its quintic, which has angle, speed and acceleration of the samples at both ends, passes the samples
# between them within half of the bound. So the loop evaluates polynomials, and neither iterates nor can fail on the way. At a
# way-point the path's acceleration may step: it is a knot with the acceleration before it, and one with that after it.

BOUND_M, BOUND_RAD = 1e-6, 1e-5  # of the tip beside the path
LONGEST_S = 0.1  # the loop's guard looks at the knots of a path before it begins
FEWEST = 2000  # sections of a path of many minutes: a request has an end
_SHARE = 0.5  # of the bound, at the samples


@dataclass(frozen=True, slots=True)
class JointSections:
    """The path of the joints, and by how much the tip departs from the samples at most."""

    path: JointPath
    off_m: float
    off_rad: float


def joint_sections(tip: TipSamples, joints: JointSamples, stretch: float) -> JointSections:
    """The sections of a path from rest to rest, run `stretch` times slower than sampled."""
    times_s = stretch * tip.times_s
    longest_s = max(LONGEST_S, times_s[-1] / FEWEST)
    waypoint = np.flatnonzero(np.diff(tip.section)) + 1  # the second of its two samples
    is_knot = np.zeros(len(times_s), dtype=np.bool_)
    is_knot[[0, -1, *waypoint, *(waypoint - 1)]] = True
    states = _states(joints, waypoint, stretch)
    while True:
        off_m, off_rad = _departures(times_s, states, joints.jacobian, is_knot)
        knots = np.flatnonzero(is_knot)
        section = np.cumsum(is_knot)[:-1] - 1  # of the interval after each sample
        is_far = np.maximum(off_m / BOUND_M, off_rad / BOUND_RAD)[:-1] > _SHARE
        worst = np.zeros(len(knots) - 1, dtype=np.bool_)
        np.logical_or.at(worst, section, is_far)
        worst |= np.diff(times_s[knots]) > longest_s * 1.001
        middles = ((knots[:-1] + knots[1:]) // 2)[worst & (np.diff(knots) > 1)]
        if not middles.size:
            break
        is_knot[middles] = True
    path = JointPath(times_s[knots].tolist(), states[knots])
    return JointSections(path, float(off_m.max()), float(off_rad.max()))


def _states(joints: JointSamples, waypoint: NDArray[np.int64], stretch: float) -> Array:
    """Angle, speed and acceleration (m, 3, n); of one angle and speed at each way-point, and at rest at both ends."""
    states = np.stack((joints.q_rad, joints.speed_rad_s / stretch, joints.acceleration_rad_s2 / stretch**2), axis=1)
    states[waypoint, :2] = states[waypoint - 1, :2] = 0.5 * (states[waypoint, :2] + states[waypoint - 1, :2])
    states[[0, -1], 1] = 0.0
    return states


def _departures(times_s: Array, states: Array, jacobian: Array, is_knot: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Distance [m] and angle [rad] (m,) of the tip at the quintics between the knots from the tip at the samples."""
    knots = np.flatnonzero(is_knot)
    section = np.minimum(np.cumsum(is_knot) - 1, len(knots) - 2)
    first, last = knots[section], knots[section + 1]
    h = (times_s[last] - times_s[first])[:, None]
    s = (times_s[:, None] - times_s[first][:, None]) / np.where(h > 0.0, h, 1.0)
    c0, c1, c2, c3, c4, c5 = quintic(h, *np.moveaxis(states[first], 1, 0), *np.moveaxis(states[last], 1, 0))
    q = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
    moved = (jacobian @ (q - states[:, 0])[:, :, None])[:, :, 0]
    return np.linalg.norm(moved[:, :3], axis=1), np.linalg.norm(moved[:, 3:], axis=1)


class BranchFollower:
    """Implements Follower with the inverse kinematics of positions."""

    def __init__(self, inverse: InverseKinematics, waypoints: Waypoints) -> None:
        self._inverse, self._waypoints = inverse, waypoints

    def starts(self, q_near: Sequence[float]) -> Iterator[PathStart]:
        """Branches that reach the first way-point and their poses, within limits first, then nearest first."""
        first = self._waypoints.points[0]
        try:
            if not self._inverse.has_branches:
                yield PathStart(self._inverse.nearest(first, q_near))
                return
            solutions = self._inverse.branches(first)
        except ArmError as problem:
            raise PathError(f"{self._waypoints.name(1)}: {problem}; nothing was moved", 1) from problem

        def distance(solution: Solution) -> tuple[bool, float]:
            return not solution.within_limits, max(abs(a - b) for a, b in zip(solution.q, q_near, strict=True))

        yield from (PathStart(solution.q, solution.branch) for solution in sorted(solutions, key=distance))

    def check(self, start: PathStart) -> None:
        """PathError for the first way-point that the branch does not reach."""
        if start.branch is None:
            return
        for number, point in enumerate(self._waypoints.points, 1):
            try:
                self._inverse.solve(point, start.branch)
            except ArmError as problem:
                raise PathError(f"{self._waypoints.name(number)}: {problem}; nothing was moved", number) from problem

    def follow(self, recipe: TimedWaypoints, spline: CartesianSpline, start: PathStart, rate_Hz: float) -> Followed:
        """Newton from scalar solutions, at most SEED_STEP_M apart."""
        tip = sample_tip(spline, rate_Hz)
        times, poses, at_waypoints = self._seeds(recipe, spline, start.q_rad)
        seeds = np.stack([np.interp(tip.times_s, times, q) for q in zip(*poses, strict=True)], axis=1)
        still = np.zeros_like(seeds)  # the tip alone fixes how the joints move
        joints = solve_joints(self._inverse.poses, self._inverse.held, tip, (seeds, still, still))
        return Followed(tip, joints, at_waypoints)

    def _seeds(
        self, recipe: TimedWaypoints, spline: CartesianSpline, q_start: Pose
    ) -> tuple[list[float], list[Pose], tuple[Pose, ...]]:
        """Times and poses followed along the path in small steps from `q_start`, and at the way-points."""
        times, poses, at_waypoints = [0.0], [q_start], [q_start]
        for length, (start, end) in zip(recipe.lengths_m, pairwise(spline.times_s), strict=True):
            steps = 2 + int(length / SEED_STEP_M)
            for k in range(1, steps + 1):
                time = end if k == steps else start + (end - start) * k / steps
                try:
                    poses.append(tuple(self._inverse.follow(spline.at(time)[0], poses[-1])))
                except ArmError as problem:
                    raise checks.Passage(self._waypoints, spline.times_s).error(time, problem) from problem
                times.append(time)
            at_waypoints.append(poses[-1])
        return times, poses, tuple(at_waypoints)


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
        return (self._c0[section] + t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + 3.0 * t * c3), 2.0 * c2 + 6.0 * t * c3)


JUMP_RAD = 0.5  # between two steps; more is a jump to another solution
# How far the tip may leave the cubic between way-points where the joints cannot hold all of it.
FARTHEST_OFF_M, FARTHEST_OFF_RAD = 0.02, 0.2


class PostureFollower:
    """Arms of any number of joints: the tip is held as the task says, and free joints stay near a reference posture.

    The reference is found once, along the path in small steps from the start. Every pose of the path is then the
    one nearest to it that holds the tip. So a pose depends on where the path is and not on how it was sampled.
    """

    def __init__(self, arm: Arm, inverse: PoseInverse, waypoints: Waypoints) -> None:
        self._name, self._inverse, self._waypoints = arm.name, inverse, waypoints
        self._kinematics = inverse.kinematics
        self._task = inverse.task(waypoints.orientations is not None)
        self._rule = PostureRule(self._kinematics, self._task, np.array(arm.limits_rad))
        self._known: tuple[PathStart, list[float], list[Pose]] | None = None

    def starts(self, q_near: Sequence[float]) -> Iterator[PathStart]:
        """Solutions at the first way-point, the one from `q_near` first."""
        yield from map(PathStart, self._at(1, q_near))

    def _at(self, number: int, q_near: Sequence[float]) -> Iterator[Pose]:
        """Solutions at way-point `number` (1-based), the one from `q_near` first. PathError names it if there is none."""
        turned = self._waypoints.orientations
        wanted = TipPose.of(self._waypoints.points[number - 1], None if turned is None else turned[number - 1])
        try:
            yield from self._inverse.solutions(wanted, q_near)
        except ArmError as problem:
            raise PathError(f"{self._waypoints.name(number)}: {problem}; nothing was moved", number) from problem

    def check(self, start: PathStart) -> None:
        """Nothing: following the path finds what cannot be reached."""

    def follow(self, recipe: TimedWaypoints, spline: CartesianSpline, start: PathStart, rate_Hz: float) -> Followed:
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
        tip = sample_tip(spline, rate_Hz)
        if turn is None:
            return tip
        into = tip.times_s - np.array(spline.times_s)[tip.section]
        return TipSamples(
            tip.times_s, tip.section, tip.position_m, tip.velocity_m_s, tip.acceleration_m_s2, turn.sample(tip.section, into)
        )

    # ---- the reference posture

    @staticmethod
    def _times(spline: CartesianSpline, fractions: Sequence[float]) -> list[float]:
        """Times of section numbers with fractions: 2.5 is in the middle of the third section."""
        return np.interp(fractions, np.arange(len(spline.times_s)), spline.times_s).tolist()

    def _postures(
        self, recipe: TimedWaypoints, spline: CartesianSpline, turn: OrientationSpline | None, start: PathStart
    ) -> tuple[list[float], list[Pose]]:
        """Fractions and poses, followed in small steps from the start."""
        turns = recipe.turns_rad or (0.0,) * len(recipe.lengths_m)
        fractions = [0.0]
        for section, (length, angle) in enumerate(zip(recipe.lengths_m, turns, strict=True)):
            count = 2 + int(max(length, pose_inverse.TURN_LENGTH_M * angle) / SEED_STEP_M)
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
            solved = self._rule.next(pose_inverse.Targets(np.array([position]), rotation), poses[-1])
            travel_rad = float(np.abs(solved.q_rad - poses[-1]).max())
            if travel_rad > JUMP_RAD or not solved.is_solved[0]:
                next(self._at(section + 2, poses[-1][0].tolist()))  # raises where the way-point itself cannot be taken
                problem = self._lost(position, solved, travel_rad)
                raise checks.Passage(self._waypoints, spline.times_s).error(time_s, problem)
            poses.append(solved.q_rad)
        return fractions, [tuple(q[0].tolist()) for q in poses]

    def _lost(self, position: Sequence[float], solved: pose_inverse.SolvedPoses, travel_rad: float) -> ArmError:
        """Why no pose follows the one before."""
        off_m = float(np.linalg.norm(solved.error[0, :3]))
        if solved.is_solved[0]:
            return problems.jump(self._name, position, travel_rad, JUMP_RAD)
        if off_m > pose_inverse.POSITION_TOLERANCE_M:
            return problems.out_of_reach(self._name, position, off_m)
        margin = float(pose_inverse.margins(self._task, solved.tip.jacobian)[0])  # so near, Newton's method only fails there
        return problems.near_singular(self._name, position, problems.LOSES_A_DIRECTION, margin)

    def _require_near(self, spline: CartesianSpline, tip: TipSamples, joints: JointSamples) -> None:
        """PathError where the tip leaves what was asked for: at a way-point by the tolerance, between them by more."""
        if not self._task.nearest:
            return
        is_between = np.abs(tip.times_s[:, None] - np.array(spline.times_s)).min(axis=1) > 1e-9
        for rows, tolerance, farthest, unit in (
            (slice(0, 3), pose_inverse.POSITION_TOLERANCE_M, FARTHEST_OFF_M, "m"),
            (slice(3, 6), ORIENTATION_TOLERANCE_RAD, FARTHEST_OFF_RAD, "rad"),
        ):
            off = np.linalg.norm(joints.off[:, rows], axis=1)
            excess = off / np.where(is_between, farthest, tolerance)
            worst = int(excess.argmax())
            if excess[worst] > 1.0:
                what = "position" if unit == "m" else "orientation"
                raise checks.Passage(self._waypoints, spline.times_s).error(
                    float(tip.times_s[worst]),
                    f"the {joints.q_rad.shape[1]} joints of arm {self._name} come no nearer than {off[worst]:.4f} {unit}"
                    f" to the {what} (allowed {tolerance:g} at a way-point, {farthest:g} between two)",
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

    def __init__(self, kinematics: PoseKinematics, task: pose_inverse.Task, limits_rad: Array) -> None:
        """`limits_rad`: (n, 2), infinite where there is none."""
        self._kinematics, self._task = kinematics, task
        self._is_free = task.freedom(kinematics.joint_count) > 0
        lower, upper = limits_rad.T
        is_bounded = np.isfinite(lower) & np.isfinite(upper)
        self._middle = np.where(is_bounded, 0.5 * (np.where(is_bounded, lower + upper, 0.0)), 0.0)
        self._half = np.where(is_bounded, 0.5 * (np.where(is_bounded, upper - lower, 0.0)), np.inf)

    def next(self, targets: pose_inverse.Targets, before_rad: Array) -> pose_inverse.SolvedPoses:
        """The pose (1, n) that holds the target, nearest to the pushed pose before (1, n)."""
        posture = before_rad + self._push(before_rad) if self._is_free else before_rad
        return pose_inverse.solve(self._kinematics, self._task, targets, posture, before_rad)

    def _push(self, q_rad: Array) -> Array:
        """Away from limits and singular poses (1, n) [rad]."""
        offset = (q_rad - self._middle) / self._half
        outside = np.clip((np.abs(offset) - (1.0 - OUTER_SHARE)) / OUTER_SHARE, 0.0, 1.0)
        push = -PUSH_RAD * outside * np.sign(offset)
        margin = float(pose_inverse.margins(self._task, self._kinematics.batch(q_rad).jacobian)[0])
        if margin < SAFE_MARGIN_M:
            gradient = self._gradient(q_rad)
            length = float(np.linalg.norm(gradient))
            if length > 0.0:
                push += PUSH_RAD * (1.0 - margin / SAFE_MARGIN_M) * gradient / length
        return np.asarray(push)

    def _gradient(self, q_rad: Array) -> Array:
        """Of the margin, (1, n), by central differences."""
        steps = _MARGIN_SLOPE_RAD * np.eye(q_rad.shape[1])
        around = pose_inverse.margins(self._task, self._kinematics.batch(np.vstack((q_rad + steps, q_rad - steps))).jacobian)
        return np.asarray((around[: len(steps)] - around[len(steps) :])[None] / (2.0 * _MARGIN_SLOPE_RAD))
