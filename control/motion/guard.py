"""The last guard of every motion: floor, table and own base (control.safety.workspace), for poses of the arm's joints.

At every moment there is a stop that meets nothing. Whole motions are checked before they begin, and the loop looks at their
poses before the arm can no longer rest ahead of them (control.motion.setpoint). A jog takes no set-point whose stop meets
something. Where joints must stop for themselves, they brake as hard as that takes. An arm that is inside already may move out,
but at no moment deeper than it was before.
"""

import math
from collections import deque
from collections.abc import Sequence
from copy import copy
from operator import mul, sub
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import ArmError, MotionError
from control.kinematics.kinematics import Corners
from control.model.arm import Arm
from control.motion.joint_limits import JointLimits, reach_m, reaches_m
from control.motion.joint_move import HARDEST, StopMotion, StraightStop
from control.motion.joint_path import JointPath
from control.motion.setpoint import Motion, SetPoint
from control.safety.workspace import Clearance, LinkThickness, Workspace

STEP_rad = 0.02  # between checked poses of a joint move: 15 mm at 0.75 m
_STOP_STEP_s = 0.015  # between checked poses of a stop: at 10 m/s^2 the tip departs from their chords by 0.3 mm
_HARDNESSES = (0, 2, HARDEST)  # of the stops that are tried: one cycle must be enough to choose
_POSES_MOST = 500
_DEEPER_m = 1e-6  # rounding
_CLOSE_STEP_s, _CLOSE_POSES = (0.01, 150)  # of a motion that begins inside of something: as close as the loop looks
ROOM_m = 0.05  # an arm with so much is not looked at again until it may have used it up
_REMEDY = "nothing was moved; [limits] floor_z_m, floor_tolerance_m and base_radius_m, and [table], say where they are"


class Obstacles(Protocol):
    """What stands beside the arm, and itself: other arms of its cell."""

    def objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float], looks_ahead: bool) -> str:
        """Why the arm must not get to `wanted_rad` from `here_rad`, as text; empty if it may.

        `looks_ahead`: the arm is to come to rest there, so where the others are going counts too.
        """
        ...


class FarPoses:
    """The last poses that were found far from everything, and how far: near to them, the cycle need not look again.

    A joint that turns by w moves no point of the arm, nor any two of its points against each other, by more than w times its
    reach. So of the room that a pose q had, at least room - sum(reach |p - q|) is left in a pose p.
    """

    def __init__(self, reaches_m: Sequence[float]) -> None:
        """`reaches_m`: of each joint, how far what it moves may be from its axis."""
        self._reaches_m = reaches_m
        # Two, since set-points and the poses ahead of them are looked at in turn.
        self._found: deque[tuple[float, Sequence[float]]] = deque(maxlen=2)

    def note(self, q_rad: Sequence[float], room_m: float) -> None:
        """Note a pose in which nothing is met within `room_m`."""
        self._found.append((room_m, q_rad))

    def are_near(self, q_rad: Sequence[float]) -> bool:
        """Whether a pose is so near to one of them that nothing can be met in it; not if an angle is NaN."""
        for room_m, far_rad in self._found:  # noqa: SIM110  (a generator costs as much as what it sums)
            if sum(map(mul, self._reaches_m, map(abs, map(sub, q_rad, far_rad)))) < room_m:
                return True
        return False


class Guard:
    """Holds poses of one arm against its workspace. Errors are MotionError."""

    def __init__(self, arm: Arm, limits: JointLimits) -> None:
        self._corners, self._workspace, self._limits = Corners(arm), Workspace.of(arm), limits
        self._reach_m = reach_m(arm)
        self._far = FarPoses(reaches_m(arm))
        self.beside: Obstacles | None = None
        self._body = LinkThickness(self._corners.radii_m, self._corners.first_free)
        self._corners.batch([(0.0,) * arm.joint_count])  # compiled now, not between two cycles
        self.clearance((0.0,) * arm.joint_count)

    def clearance(self, q_rad: Sequence[float]) -> Clearance:
        """The least clearance of a pose; below 0: the arm is inside of something."""
        return self._workspace.clearance(self._corners.at(*q_rad), self._body)

    def objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float]) -> str:
        """Why the arm must not come to rest at `wanted_rad` from `here_rad`, as text; empty if it may."""
        return self._objection(wanted_rad, here_rad, looks_ahead=True)

    def passing_objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float]) -> str:
        """As `objection`, for a pose on a motion: it is left again before another arm gets there."""
        return self._objection(wanted_rad, here_rad, looks_ahead=False)

    def _objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float], looks_ahead: bool) -> str:
        if objection := self.fixed_objection(wanted_rad, here_rad):
            return objection
        return "" if self.beside is None else self.beside.objection(wanted_rad, here_rad, looks_ahead)

    def fixed_objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float]) -> str:
        """As `objection`, of what stands still: floor, table and base."""
        if self._far.are_near(wanted_rad):
            return ""
        corners = self._corners.at(*wanted_rad)
        if self._workspace.is_far(corners, self._body, ROOM_m):
            self._far.note(wanted_rad, ROOM_m)
            return ""
        if self._workspace.is_far(corners, self._body, 0.0):
            return ""
        clearance = self._workspace.clearance(corners, self._body)
        return clearance.what if self._is_deeper(clearance, here_rad) else ""

    def jog_objection(self, wanted: SetPoint, here: SetPoint) -> str:
        """As `objection`, for the stop of joints that move as `wanted`: its end, and the way to it."""
        rest_rad = self.resting_pose(wanted)
        if objection := self.objection(rest_rad, here.q_rad):
            return objection
        way_m = self._reach_m * sum(abs(q - p) for q, p in zip(rest_rad, wanted.q_rad, strict=True))
        if self._workspace.is_far(self._corners.at(*rest_rad), self._body, way_m):
            return ""
        deepest = self._deepest(StopMotion(wanted, self._limits))
        return deepest.what if self._is_deeper(deepest, here.q_rad) else ""

    def stop_from(self, state: SetPoint) -> Motion:
        """The gentlest stop that meets nothing: each joint for itself, or all on a line, ever harder; else the least deep one."""
        best: Motion = StopMotion(state, self._limits)
        least = self._deepest(best)
        if not self._is_deeper(least, state.q_rad) or not any(state.speed_rad_s):
            return best
        for hardness in _HARDNESSES:
            stop = StraightStop(state, self._limits, hardness)
            if stop.is_in_range and (deepest := self._deepest(stop)).distance_m > least.distance_m:
                best, least = stop, deepest
                if not self._is_deeper(least, state.q_rad):
                    break
        return best

    def _deepest(self, stop: Motion) -> Clearance:
        """The least clearance on the way of a stop."""
        count = 1 + math.ceil(stop.duration_s / _STOP_STEP_s)
        times_s = (stop.duration_s * k / count for k in range(1, count + 1))
        return min(self.clearance(stop.at(time_s).q_rad) for time_s in times_s)

    def _is_deeper(self, clearance: Clearance, here_rad: Sequence[float]) -> bool:
        """Whether something is met, and more than in the pose `here_rad`."""
        return clearance.distance_m < 0.0 and clearance.distance_m < self.clearance(here_rad).distance_m - _DEEPER_m

    def resting_pose(self, state: SetPoint) -> tuple[float, ...]:
        """Where each joint would be after its jerk-limited stop."""
        limits = zip(self._limits.acceleration_rad_s2, self._limits.jerk_rad_s3, strict=True)
        return tuple(
            q + stopping_distance(speed, acceleration, *limit)
            for q, speed, acceleration, limit in zip(*state, limits, strict=True)
        )

    def require_move(self, motion: Motion, start: SetPoint, end_rad: Sequence[float]) -> None:
        """MotionError if a joint move to `end_rad` meets something on its way."""
        furthest_rad = max(abs(a - b) for a, b in zip(start.q_rad, end_rad, strict=True))
        count = min(2 + int(furthest_rad / STEP_rad), _POSES_MOST)
        times_s = [motion.duration_s * k / (count - 1) for k in range(count)]
        self._require([motion.at(time_s).q_rad for time_s in times_s], times_s, start.q_rad)

    def require_joint_path(self, path: JointPath) -> None:
        """MotionError if a joint path meets something at one of its knots."""
        step = _step(len(path.times_s))
        poses = path.poses(step)
        self._require(poses, path.times_s[::step], poses[0])

    def require_rising(self, motion: Motion) -> None:
        """MotionError if a motion that begins inside of something gets deeper again before it is out: looked at closely."""
        start_rad = motion.at(0.0).q_rad
        if self.clearance(start_rad).distance_m >= 0.0:
            return
        sampled, close_s = copy(motion), min(motion.duration_s, _CLOSE_POSES * _CLOSE_STEP_s)
        times_s = np.unique(
            [*np.arange(0.0, close_s, _CLOSE_STEP_s), *np.linspace(close_s, motion.duration_s, _CLOSE_POSES)]
        ).tolist()
        try:
            self._require([sampled.at(time_s).q_rad for time_s in times_s], times_s, start_rad)
        except MotionError as error:
            raise MotionError(f"{error}. The arm begins inside: jog it out first") from None

    def _require(self, poses: ArrayLike, times_s: ArrayLike, here_rad: Sequence[float]) -> None:
        try:
            corners = self._corners.batch(poses)
        except ArmError as error:
            raise MotionError(str(error)) from None
        self._require_clear(corners, np.asarray(times_s), self.clearance(here_rad), self._body)

    def _require_clear(
        self, corners: list[NDArray[np.float64]], times_s: NDArray[np.float64], here: Clearance, body: LinkThickness
    ) -> None:
        clearances = list(self._workspace.clearances(corners, body))
        if not clearances:
            return
        distances_m = np.stack([np.broadcast_to(distances, times_s.shape) for distances, _ in clearances])
        least_m = distances_m.min(axis=0)
        # As high as the arm has been before each pose: there it may be, and no deeper.
        highest_m = np.maximum.accumulate([here.distance_m, *least_m[:-1]])
        deeper = np.where(least_m < np.minimum(0.0, highest_m - _DEEPER_m), least_m, math.inf)
        k = int(np.argmin(deeper))
        if deeper[k] < math.inf:
            what = clearances[int(np.argmin(distances_m[:, k]))][1]
            raise MotionError(
                f"{what}, {-1e3 * least_m[k]:.4g} mm deeper than allowed, after {float(times_s[k]):.2f} s; {_REMEDY}"
            )


def _step(count: int) -> int:
    """Of a long path only every n-th part is looked at beforehand, to cost no cycle; the loop looks at every set-point."""
    return 1 + (count - 1) // _POSES_MOST


def stopping_distance(speed: float, acceleration: float, most: float, jerk: float) -> float:
    """Signed distance of a jerk-limited stop from `speed` and `acceleration`, with at most `most` and `jerk`.

    In the direction of motion v, the acceleration first goes to zero if it is positive; the braking then rises to its limit, or
    less, and falls to zero again. A braking b at the start means that it began to rise b / jerk ago.
    """
    sign = 1.0 if speed > 0.0 or (speed == 0.0 and acceleration > 0.0) else -1.0
    v, a = abs(speed), sign * acceleration
    before = 0.0
    if a > 0.0:
        t = a / jerk
        before = v * t + a * t * t / 3.0
        v, a = v + 0.5 * a * t, 0.0
    braking = min(-a, most)
    if v <= 0.5 * braking * braking / jerk:  # the last phase, in which the braking falls
        return sign * (before + v * math.sqrt(2.0 * v / jerk) / 3.0)
    t = braking / jerk
    begun = v + 0.5 * braking * t  # speed when the braking began to rise
    done = begun * t - jerk * t**3 / 6.0
    peak = min(most, math.sqrt(begun * jerk))
    whole = 0.5 * begun * (begun / peak + peak / jerk)
    return sign * (before + whole - done)
