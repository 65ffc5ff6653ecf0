"""Checks of a path before anything moves: reachability, joint range, singularity, clearance and timing.

All checks work on samples of the whole path. A violation is raised as a PathError that
names the way-point and the amount.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from control.errors import PathError
from control.kinematics.kinematics import Corners, ForwardKinematics, PoseKinematics
from control.kinematics.pose_inverse import Targets, Task, joint_rates, margins, solve
from control.model import table as tables
from control.model.arm import Arm, Limits
from control.motion.joint_limits import JointLimits
from control.motion.spline import CartesianSpline
from control.motion.waypoints import Waypoints
from control.safety.workspace import LinkThickness, Workspace

Array = NDArray[np.float64]
_SLOPE_RAD = 1e-5  # of the fastest joint: the difference that gives Jdot


@dataclass(frozen=True, slots=True)
class TurnSamples:
    """The tip's rotation (m, 3, 3), angular velocity and acceleration (m, 3) in the base frame."""

    rotation: Array
    velocity_rad_s: Array
    acceleration_rad_s2: Array


@dataclass(frozen=True, slots=True)
class TipSamples:
    """Times (m,), section of each (m,), and tip position, velocity, acceleration (m, 3) in the base frame.

    Each section is sampled from end to end, so that way-points appear twice and both one-sided accelerations. `turn`: None if
    the orientation is free.
    """

    times_s: Array
    section: NDArray[np.int64]
    position_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    turn: TurnSamples | None = None


@dataclass(frozen=True, slots=True)
class JointSamples:
    """Joint angles, speeds and accelerations (m, n) at the samples; `is_solved` (m,): the pose exists.

    `jacobian` (m, 6, n): of the tip. `off` (m, 6): position [m] and orientation [rad] wanted minus actual.
    """

    q_rad: Array
    speed_rad_s: Array
    acceleration_rad_s2: Array
    smallest_singular_m: Array
    is_solved: NDArray[np.bool_]
    jacobian: Array
    off: Array


LEAST_SAMPLES = 12  # of a section, however short


def sample_tip(spline: CartesianSpline, rate_Hz: float) -> TipSamples:
    """Sample each section at `rate_Hz` or at LEAST_SAMPLES points, whichever is more."""
    starts = np.array(spline.times_s)
    durations = np.diff(starts)
    counts = np.maximum(LEAST_SAMPLES, np.ceil(durations * rate_Hz).astype(np.int64) + 1)
    section = np.repeat(np.arange(len(durations)), counts)
    within = np.arange(len(section)) - np.repeat(np.cumsum(counts) - counts, counts)
    t = (within / (counts - 1)[section] * durations[section])[:, None]
    a = np.array(spline.coefficients).reshape(-1, 3, 4)[section]
    return TipSamples(
        times_s=starts[section] + t[:, 0],
        section=section,
        position_m=a[:, :, 0] + t * (a[:, :, 1] + t * (a[:, :, 2] + t * a[:, :, 3])),
        velocity_m_s=a[:, :, 1] + t * (2.0 * a[:, :, 2] + t * 3.0 * a[:, :, 3]),
        acceleration_m_s2=2.0 * a[:, :, 2] + t * 6.0 * a[:, :, 3],
    )


def solve_joints(kinematics: PoseKinematics, task: Task, tip: TipSamples, posture: Sequence[Array]) -> JointSamples:
    """Joint samples nearest to a posture: its angles, which are the seeds, speeds and accelerations (m, n).

        J qd = v,    J qdd = a - Jdot qd

    Rows that are held only nearly leave terms out of this; then the rates are differences over time.
    """
    posture_rad, posture_speed, posture_acceleration = posture
    rotation = None if tip.turn is None else tip.turn.rotation
    solved = solve(kinematics, task, Targets(tip.position_m, rotation), posture_rad)
    jacobian = solved.tip.jacobian
    if task.nearest:
        speed = _slopes(tip, solved.q_rad)
        acceleration = _slopes(tip, speed)
    else:
        velocity, change = _twists(tip)
        speed = joint_rates(task, jacobian, velocity, posture_speed)
        change = change - _bias(kinematics, solved.q_rad, speed)
        acceleration = joint_rates(task, jacobian, change, posture_acceleration)
    return JointSamples(solved.q_rad, speed, acceleration, margins(task, jacobian), solved.is_solved, jacobian, solved.error)


def _twists(tip: TipSamples) -> tuple[Array, Array]:
    """Velocity and angular velocity (m, 6), and their rates."""
    if tip.turn is None:
        nothing = np.zeros_like(tip.velocity_m_s)
        return np.hstack((tip.velocity_m_s, nothing)), np.hstack((tip.acceleration_m_s2, nothing))
    return (
        np.hstack((tip.velocity_m_s, tip.turn.velocity_rad_s)),
        np.hstack((tip.acceleration_m_s2, tip.turn.acceleration_rad_s2)),
    )


def _bias(kinematics: PoseKinematics, q: Array, speed: Array) -> Array:
    """Jdot qd (m, 6) by a central difference of J along qd: 1e-9 relative, enough for a limit."""
    step = _SLOPE_RAD / np.maximum(np.abs(speed).max(axis=1, keepdims=True), 1e-9)
    change = kinematics.batch(q + step * speed).jacobian - kinematics.batch(q - step * speed).jacobian
    return np.asarray((change @ speed[:, :, None])[:, :, 0] / (2.0 * step))


def _slopes(tip: TipSamples, values: Array) -> Array:
    """Differences over time within each section (m, n)."""
    slopes = np.empty_like(values)
    bounds = [*np.flatnonzero(np.diff(tip.section, prepend=-1)), len(values)]
    for first, end in pairwise(bounds):
        slopes[first:end] = np.gradient(values[first:end], tip.times_s[first:end], axis=0, edge_order=2)
    return slopes


# Smallest singular value of J [m/rad] allowed on a path: with less, a tip speed of 0.02 m/s needs 1
# rad/s.
LEAST_SINGULAR_M_RAD = 0.02
# How far the tip may go below the board it touches: the cavities' own depth and a calibrated arm's error.
TOUCH_TOLERANCE_M = 0.0005
# The board reaches this far beyond its outermost cavity.
_BOARD_MARGIN_M = 0.03
_ROUNDING_RAD = 1e-6
_DEEPER_M = 1e-6  # rounding


@dataclass(frozen=True, slots=True)
class Demand:
    """A limit and how many times slower the path would have to be for it at each sample: `factors` (m,)."""

    limit: str
    factors: Array


@dataclass(frozen=True, slots=True)
class Passage:
    """Way-points, and when a path passes each of them."""

    waypoints: Waypoints
    times_s: Sequence[float]

    def nearest(self, time_s: float) -> int:
        """The way-point (1-based) that is nearest in time."""
        return int(np.abs(np.asarray(self.times_s) - time_s).argmin()) + 1

    def error(self, time_s: float, problem: object) -> PathError:
        """The error that says where on the path there is a problem."""
        number = self.nearest(time_s)
        where, passed_s = self.waypoints.name(number), self.times_s[number - 1]
        if abs(passed_s - time_s) >= 1e-9:
            where = f"{'before' if time_s < passed_s else 'after'} {where}"
        return PathError(f"{where}: {problem}; nothing was moved", number)


def check_poses(way: Passage, tip: TipSamples, joints: JointSamples, limits: JointLimits) -> None:
    """Raise PathError unless every pose exists, is within the joints' range and far enough from singular."""
    _require(joints.is_solved, way, tip, lambda i: "the arm cannot follow the path there on this branch")
    for joint in range(joints.q_rad.shape[1]):
        q = joints.q_rad[:, joint]
        low, high = limits.lower_rad[joint], limits.upper_rad[joint]
        beyond = np.maximum(q - high, low - q)

        def say(i: int, joint: int = joint, low: float = low, high: float = high, beyond: Array = beyond) -> str:
            return f"joint {joint + 1} would be {beyond[i]:.4f} rad outside of its range {low:.4f} to {high:.4f}"

        _require(beyond <= _ROUNDING_RAD, way, tip, say, -beyond)
    margin = joints.smallest_singular_m
    _require(
        margin >= LEAST_SINGULAR_M_RAD,
        way,
        tip,
        lambda i: (
            f"the arm is near-singular: {margin[i]:.4f} m of tip travel per rad in its worst direction, least"
            f" allowed {LEAST_SINGULAR_M_RAD} m"
        ),
        margin,
    )


def check_clearance(arm: Arm, setup: str, way: Passage, tip: TipSamples, q_rad: Array) -> None:
    """Raise PathError where tip, forearm or elbow would go below the board (over it) or the floor
    (elsewhere).

    The tip may touch: TOUCH_TOLERANCE_M below is allowed. Over the board the board's plane counts, not the
    floor.
    """
    floor = arm.limits.floor_z_m + arm.limits.floor_clearance_m
    transforms = ForwardKinematics(arm).link_transforms(q_rad)
    elbow = transforms[:, -3, :3, 3] if transforms.shape[1] > 3 else tip.position_m
    for what, share in (("tip", 1.0), ("forearm", 0.75), ("forearm", 0.5), ("forearm", 0.25), ("elbow", 0.0)):
        points = elbow + share * (tip.position_m - elbow)
        heights, is_over = _height_over_board(arm, setup, points)
        height = np.where(is_over, heights, points[:, 2] - floor)
        height = height if what == "tip" else height - arm.links[-1].radius_m

        def say(i: int, what: str = what, height: Array = height, is_over: NDArray[np.bool_] = is_over) -> str:
            return f"the {what} would go {-height[i]:.4f} m below the {'table' if is_over[i] else 'floor'}"

        _require(height >= -TOUCH_TOLERANCE_M, way, tip, say, height)


def check_room(arm: Arm, way: Passage, tip: TipSamples, q_rad: Array) -> None:
    """Raise PathError where any link would meet floor, table or its own base, as the loop's guard sees it.

    An arm that begins inside may move out.
    """
    corners, workspace = Corners(arm), Workspace.of(arm)
    body = LinkThickness(corners.radii_m, corners.first_free)
    for distance_m, what in workspace.clearances(corners.batch(q_rad), body):
        allowed_m = min(float(distance_m[0]), 0.0) - _DEEPER_M

        def say(i: int, what: str = what, distance_m: Array = distance_m) -> str:
            return f"{what}, by {-distance_m[i]:.4f} m"

        _require(distance_m >= allowed_m, way, tip, say, distance_m)


def demands(tip: TipSamples, joints: JointSamples, limits: JointLimits, of_tip: Limits) -> list[Demand]:
    """How much slower the path must be for each limit: speed scales with 1/k, acceleration 1/k^2, jerk 1/k^3.

    Jerk is that within a section; the steps of acceleration at way-points are bounded by the acceleration
    limit.
    """
    needs = [Demand("tip speed", np.linalg.norm(tip.velocity_m_s, axis=1) / of_tip.tip_speed_m_s)]
    if tip.turn is not None:
        speed, acceleration = (np.linalg.norm(rate, axis=1) for rate in (tip.turn.velocity_rad_s, tip.turn.acceleration_rad_s2))
        needs += [
            Demand("turning speed of the tip", speed / of_tip.tip_turn_speed_rad_s),
            Demand("turning acceleration of the tip", np.sqrt(acceleration / of_tip.tip_turn_acceleration_rad_s2)),
        ]
    jerk = _jerk(tip, joints.acceleration_rad_s2)
    for j in range(joints.q_rad.shape[1]):
        name = f"joint {j + 1}"
        needs += [
            Demand(f"{name} speed", np.abs(joints.speed_rad_s[:, j]) / limits.speed_rad_s[j]),
            Demand(f"{name} acceleration", np.sqrt(np.abs(joints.acceleration_rad_s2[:, j]) / limits.acceleration_rad_s2[j])),
            Demand(f"{name} jerk", np.cbrt(np.abs(jerk[:, j]) / limits.jerk_rad_s3[j])),
        ]
    return needs


def _jerk(tip: TipSamples, acceleration: Array) -> Array:
    """Difference of the acceleration to the next sample of the same section (m, n); zero at each section's
    end.
    """
    jerk = np.zeros_like(acceleration)
    same = tip.section[1:] == tip.section[:-1]
    step = np.where(same, np.diff(tip.times_s), 1.0)[:, None]
    jerk[:-1] = np.where(same[:, None], np.diff(acceleration, axis=0) / step, 0.0)
    return jerk


def _height_over_board(arm: Arm, setup: str, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Height above the board's plane (m,) and whether a point is over the board (m,); without a board:
    nowhere.
    """
    table = arm.table
    if table is None or not table.known_pose or table.origin_m is None:
        return np.zeros(len(points)), np.zeros(len(points), dtype=np.bool_)
    rotation = np.array(tables.board_rotation(table, setup))
    local = (points - np.array(table.origin_m)) @ rotation
    cavities = np.array(list(tables.board_cavities(table).values()) or [(0.0, 0.0, 0.0)])
    radius = np.hypot(cavities[:, 0], cavities[:, 1]).max() + _BOARD_MARGIN_M
    return local[:, 2], np.hypot(local[:, 0], local[:, 1]) <= radius


def _require(
    is_good: NDArray[np.bool_], way: Passage, tip: TipSamples, say: Callable[[int], str], margin: Array | None = None
) -> None:
    """Raise PathError for the worst (least margin) or first invalid sample."""
    if is_good.all():
        return
    worst = int(margin.argmin()) if margin is not None else int((~is_good).argmax())
    raise way.error(float(tip.times_s[worst]), say(worst))
