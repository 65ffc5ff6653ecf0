"""The last guard of every motion: floor, table and own base (control.safety.workspace), for poses of the arm's joints.

Whole motions are checked before they begin; the loop looks at each set-point, and jogs look at the pose in which they would
come to rest. An arm that is inside already may move out, but no deeper.
"""

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from control.errors import ArmError
from control.kinematics.corners import Corners
from control.model.arm import Arm
from control.motion.errors import MotionError
from control.motion.joint_limits import JointLimits
from control.motion.joint_path import JointPath
from control.motion.plan import PlannedPath
from control.motion.setpoint import Motion, SetPoint
from control.safety.workspace import Body, Clearance, Workspace

STEP_rad = 0.02  # between checked poses of a joint move: 15 mm at 0.75 m
_POSES_MOST = 500
_SECTION_SHARES = np.array([0.0, 0.25, 0.5, 0.75])  # of a path's section, where the tip is checked
_DEEPER_m = 1e-6  # rounding
_TIP_ALONE = Body((0.0,))
_REMEDY = "nothing was moved; [limits] floor_z_m, floor_tolerance_m and base_radius_m, and [table], say where they are"


class Beside(Protocol):
    """What stands beside the arm, and itself: other arms of its cell."""

    def objection(self, wanted_rad: Sequence[float], here_rad: Sequence[float], looks_ahead: bool) -> str:
        """Why the arm must not get to `wanted_rad` from `here_rad`, as text; empty if it may.

        `looks_ahead`: the arm is to come to rest there, so where the others are going counts too.
        """
        ...


class Guard:
    """Holds poses of one arm against its workspace. Errors are MotionError."""

    def __init__(self, arm: Arm, limits: JointLimits) -> None:
        self._corners, self._workspace, self._limits = Corners(arm), Workspace.of(arm), limits
        self.beside: Beside | None = None
        self._body = Body(self._corners.radii_m, self._corners.first_free)
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
        clearance = self.clearance(wanted_rad)
        if (
            clearance.distance_m < 0.0
            and clearance.distance_m < self.clearance(here_rad).distance_m - _DEEPER_m
        ):
            return clearance.what
        return "" if self.beside is None else self.beside.objection(wanted_rad, here_rad, looks_ahead)

    def jog_objection(self, wanted: SetPoint, here: SetPoint) -> str:
        """As `objection`, for the pose in which joints that move as `wanted` could come to rest."""
        return self.objection(self.resting_pose(wanted), here.q_rad)

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
        step = _step(len(path.knots))
        poses = [knot.q_rad for knot in path.knots[::step]]
        self._require(poses, path.times_s[::step], poses[0])

    def require_path(self, path: PlannedPath) -> None:
        """MotionError if the tip's path, or the arm at one of its way-points, meets something."""
        step, times_s = _step(len(path.q_waypoints_rad)), path.spline.times_s
        self._require(path.q_waypoints_rad[::step], times_s[::step], path.q_start_rad)
        start_s, end_s = np.array(times_s[:-1:step]), np.array(times_s[1::step])
        sections = np.array(path.spline.coefficients[::step]).reshape(-1, 3, 4)
        t = ((end_s - start_s)[:, None] * _SECTION_SHARES)[:, None, :]
        a = sections[..., None]
        tips = a[:, :, 0] + t * (a[:, :, 1] + t * (a[:, :, 2] + t * a[:, :, 3]))
        at_s = (start_s[:, None] + t[:, 0]).ravel()
        here = self.clearance(path.q_start_rad)
        self._require_clear([tips.transpose(1, 0, 2).reshape(3, -1)], at_s, here, _TIP_ALONE)

    def _require(self, poses: ArrayLike, times_s: ArrayLike, here_rad: Sequence[float]) -> None:
        try:
            corners = self._corners.batch(poses)
        except ArmError as error:
            raise MotionError(str(error)) from None
        self._require_clear(corners, np.asarray(times_s), self.clearance(here_rad), self._body)

    def _require_clear(
        self, corners: list[NDArray[np.float64]], times_s: NDArray[np.float64], here: Clearance, body: Body
    ) -> None:
        allowed_m = min(0.0, here.distance_m - _DEEPER_m)
        worst_m, what, at_s = math.inf, "", 0.0
        for distances, name in self._workspace.clearances(corners, body):
            k = int(np.argmin(distances))
            if distances[k] < min(worst_m, allowed_m):
                worst_m, what, at_s = float(distances[k]), name, float(times_s[k])
        if what:
            raise MotionError(f"{what}, {-worst_m:.3f} m deeper than allowed, after {at_s:.2f} s; {_REMEDY}")


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
