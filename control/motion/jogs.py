"""Jogs: of single joints, and of the tip, jerk-limited, with limits for a motion that nobody has planned."""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from control.errors import MotionError
from control.kinematics import rotation as rotations
from control.kinematics.kinematics import PoseKinematics
from control.kinematics.pose_inverse import TURN_LENGTH_M, Task
from control.model.rules import ANGLE
from control.motion.joint_limits import (
    JogLimits,
    JointLimits,
    TIP_ACCELERATION_m_s2,
    TIP_JERK_m_s3,
    TURN_ACCELERATION_rad_s2,
    TURN_JERK_rad_s3,
    TURN_SPEED_rad_s,
)
from control.motion.joint_move import StopMotion, calculated
from control.motion.setpoint import SetPoint

if TYPE_CHECKING:
    import ruckig

_NEAR_END_rad = 1e-6
_NOTHING_rad_s = 1e-6


class JointJog:
    """Jogs joints from a set-point, at rest or moving, at no more than `speed_rad_s` of the limits, jerk-limited.

    A joint with a requested speed moves towards the end of its range at no more than that speed (ruckig, position control)
    and comes to rest exactly there. A joint with zero requested speed stops at once (velocity control).
    """

    __slots__ = ("_is_endless", "_limits", "_plans", "_state", "_target", "_time_s", "_wanted")

    def __init__(self, start: SetPoint, limits: JointLimits) -> None:
        self._limits = limits
        self._state = start
        self._wanted = [0.0] * len(start.q_rad)
        self._target: list[float | None] = [None] * len(start.q_rad)
        self._time_s = [0.0] * len(start.q_rad)
        self._is_endless = [False] * len(start.q_rad)
        self._plans: list[ruckig.Trajectory | None] = [None] * len(start.q_rad)
        for joint, speed in enumerate(start.speed_rad_s):
            if speed or start.acceleration_rad_s2[joint]:
                self._plan(joint)

    @property
    def is_at_rest(self) -> bool:
        """Whether every joint has come to rest at its goal."""
        return all(plan is None for plan in self._plans)

    @property
    def limited(self) -> str:
        """Why joints do not move as requested, as text; empty if they do."""
        stuck = [joint + 1 for joint in range(len(self._wanted)) if self._is_at_end(joint)]
        return "; ".join(f"joint {joint} is at the end of its range" for joint in stuck)

    def want(self, speed_rad_s: Sequence[float]) -> None:
        """Set the requested speed of each joint, clamped to the joint's limit."""
        for joint, (speed, limit) in enumerate(zip(speed_rad_s, self._limits.speed_rad_s, strict=True)):
            speed = min(max(speed, -limit), limit) if abs(speed) > _NOTHING_rad_s else 0.0
            if speed != self._wanted[joint] or self._target[joint] is not None:
                self._wanted[joint], self._target[joint] = speed, None
                self._plan(joint)

    def step(self, joint: int, by_rad: float, speed_rad_s: float) -> None:
        """Turn one joint (0-based) by an angle, from rest. MotionError if that is outside of its range."""
        lower, upper = self._limits.lower_rad[joint], self._limits.upper_rad[joint]
        goal = self._state.q_rad[joint] + by_rad
        if not lower <= goal <= upper:
            raise MotionError(
                f"jog: joint {joint + 1} cannot go to {goal:.4f} rad, outside of its range {lower:.4f} .. {upper:.4f} rad:"
                f" jog by {lower - self._state.q_rad[joint]:.4f} to {upper - self._state.q_rad[joint]:.4f} rad"
                f"{ANGLE.doubt(by_rad)}"
            )
        speed = min(abs(speed_rad_s), self._limits.speed_rad_s[joint])
        self._wanted[joint], self._target[joint] = math.copysign(speed, by_rad), goal
        self._plan(joint)

    def advance(self, elapsed_s: float) -> SetPoint:
        """Set-point `elapsed_s` after the last one."""
        for joint, plan in enumerate(self._plans):
            if plan is not None:
                self._follow(joint, plan, elapsed_s)
        return self._state

    def take_up(self, motion_s: float, speed_share: float) -> SetPoint:
        """Go on from `motion_s` later, at a share of the present speed: others have slowed the arm down."""
        q, speed, acceleration = self._state
        if motion_s > 0.0:
            q = tuple(a + v * motion_s for a, v in zip(q, speed, strict=True))
        self._state = SetPoint(q, tuple(v * speed_share for v in speed), tuple(0.0 for _ in acceleration))
        for joint, plan in enumerate(self._plans):
            if plan is not None:
                self._plan(joint)
        return self._state

    def _follow(self, joint: int, plan: "ruckig.Trajectory", elapsed_s: float) -> None:
        self._time_s[joint] += elapsed_s
        is_over = self._time_s[joint] >= plan.duration and not self._is_endless[joint]
        time_s = plan.duration if is_over else self._time_s[joint]  # beyond its end the joint keeps its speed
        (q,), (speed,), (acceleration,) = plan.at_time(time_s)
        if is_over:
            speed = acceleration = 0.0
            self._plans[joint] = None
        columns = [list(values) for values in self._state]
        for column, value in zip(columns, (q, speed, acceleration), strict=True):
            column[joint] = value
        self._state = SetPoint(tuple(columns[0]), tuple(columns[1]), tuple(columns[2]))

    def _plan(self, joint: int) -> None:
        import ruckig

        state, limits, wanted = self._state, self._limits, self._wanted[joint]
        asked: Any = ruckig.InputParameter(1)
        asked.current_position = [state.q_rad[joint]]
        asked.current_velocity = [state.speed_rad_s[joint]]
        asked.current_acceleration = [state.acceleration_rad_s2[joint]]
        asked.max_acceleration = [limits.acceleration_rad_s2[joint]]
        goal = self._goal(joint)
        asked.max_velocity = [abs(wanted) if goal is not None else limits.speed_rad_s[joint]]
        speed = 0.0 if self._is_at_end(joint) else wanted
        self._is_endless[joint] = goal is None and speed != 0.0
        if goal is None:
            asked.control_interface = ruckig.ControlInterface.Velocity
            asked.target_velocity = [speed]
        else:
            asked.target_position = [goal]
        what = f"jog of joint {joint + 1} at {wanted} rad/s from {state.q_rad[joint]} rad"
        trajectory = calculated(asked, [limits.jerk_rad_s3[joint]], what)
        self._plans[joint], self._time_s[joint] = trajectory, 0.0

    def _goal(self, joint: int) -> float | None:
        """Where the joint comes to rest by itself; None if it is to stop now or has no range."""
        wanted = self._wanted[joint]
        if (target := self._target[joint]) is not None:
            return target
        end = self._end(joint)
        return None if wanted == 0.0 or math.isinf(end) or self._is_at_end(joint) else end

    def _end(self, joint: int) -> float:
        is_up = self._wanted[joint] > 0.0
        return self._limits.upper_rad[joint] if is_up else self._limits.lower_rad[joint]

    def _is_at_end(self, joint: int) -> bool:
        """Whether the request leads beyond the joint's range, which it may already have left by hand."""
        wanted = self._wanted[joint]
        room = (self._end(joint) - self._state.q_rad[joint]) * wanted
        return wanted != 0.0 and self._target[joint] is None and room <= _NEAR_END_rad * abs(wanted)


Array = NDArray[np.float64]
SAFE_M = 0.04  # m/rad: twice what a path may come down to
MOST_M = 0.03  # m/rad: at 0.1 m/s no joint passes 1.7 rad/s
_NEARLY_M = 1e-3  # of rows that are held as nearly as possible
_SCALE = np.array([1.0] * 3 + [TURN_LENGTH_M] * 3)


class DampedRates:
    """The joints' answer to rates of the tip in one pose; small at singular poses, by damped least squares.

    Near a singular pose the weak directions get s / (s^2 + d^2) instead of 1 / s, with d growing from 0 at SAFE_M to MOST_M at
    the singular pose itself (Siciliano et al., Robotics, 3.5.2). The tip then lags behind what was asked for.
    """

    def __init__(self, task: Task, jacobian: Array) -> None:
        """`jacobian`: (6, n)."""
        self._task = task
        rows = jacobian * _SCALE[:, None]
        exact = rows[list(task.exact)]
        self._nearest = rows[list(task.nearest)]
        u, s, vt = np.linalg.svd(exact) if task.exact else (np.eye(0), np.empty(0), np.eye(rows.shape[1]))
        self.margin_m = float(s[-1]) if task.exact else float(np.linalg.svd(self._nearest, compute_uv=False)[task.rank - 1])
        weakness = max(0.0, 1.0 - (self.margin_m / SAFE_M) ** 2)
        gain = s / (s * s + MOST_M**2 * weakness) if s.size else s
        self._inverse = vt[: len(s)].T @ (gain[:, None] * u.T)
        self._directions, self._shares = u, gain * s
        self._free = vt[len(s) :].T
        self.is_damped = weakness > 0.0

    def share(self, tip: Array) -> float:
        """How much of six rates of the tip the joints still give, of what they hold exactly: 1 far from singular poses."""
        along = self._directions.T @ (tip * _SCALE)[list(self._task.exact)]
        size = float(along @ along)
        return float(self._shares @ along**2) / size if size else 1.0

    def rates(self, tip: Array) -> Array:
        """Joint rates (n,) for six rates of the tip, of the least size."""
        scaled = tip * _SCALE
        held = self._inverse @ scaled[list(self._task.exact)]
        if not self._task.nearest or not self._free.size:
            return np.asarray(held)
        slope = self._nearest @ self._free
        missing = scaled[list(self._task.nearest)] - self._nearest @ held
        damped = slope.T @ slope + _NEARLY_M**2 * np.eye(slope.shape[1])
        return np.asarray(held + self._free @ np.linalg.solve(damped, slope.T @ missing))


Twist = tuple[float, float, float, float, float, float]  # m/s, rad/s in the base frame
STILL: Twist = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_EASY = 0.5  # of the joints' limits: bound of the tip's rates
_HARD = 0.95  # of the joints' limits: bound of every set-point
_SLOWEST = 1e-3
_PARTLY = 0.5  # of what was asked for: with less, the jog says that the joints cannot follow
_REST = 1e-9
_ARRIVED = 1e-7


class TipRate(NamedTuple):
    """Way since the request [m, rad], its rate and the rate's change, along and about the base's axes."""

    way: Twist
    rate: Twist
    change: Twist


class RestGuard(NamedTuple):
    """What a set-point is held against: where it could come to rest, and why the arm must not get there."""

    resting_pose: Callable[[SetPoint], tuple[float, ...]]
    objection: Callable[[Sequence[float], Sequence[float]], str]


class TipJog:
    """Tip jog, for arms of any number of joints: along and about the axes of the base or of the tip, jerk-limited.

    The tip's rate, three of velocity and three of turning, is moved by ruckig. Each cycle takes one Newton step to the target
    pose, which holds what was not asked to move: a jog along an axis keeps the orientation, a turn keeps the position, as far
    as the arm has joints for it. Near singular poses the steps are damped and the jog is slowed so that no joint needs more
    than half of its speed; the target then follows the tip, so that nothing is caught up later.

    A set-point is accepted only if no joint exceeds its limits and the arm, braking each joint for itself, comes to rest
    inside the joints' ranges, meets nothing, and gets no nearer to a singular pose where the joints give less than half of
    what is asked for: from there the tip could not be jogged back. Otherwise it takes that stop, and says why.

    Jogs the tip of any arm, from rest.
    """

    def __init__(self, start: SetPoint, kinematics: PoseKinematics, task: Task, limits: JogLimits, guard: RestGuard) -> None:
        self._kinematics, self._task, self._guard = kinematics, task, guard
        self._limits, self._most_m_s = limits.of_motion, limits.tip_speed_m_s  # joints: as in every motion
        self._joints = start
        self._tip = TipRate(STILL, STILL, STILL)
        self._wanted: Twist = STILL
        self._goal: Twist | None = None
        self._stop: StopMotion | None = None  # once the jog has met an obstacle
        self._stop_s = 0.0
        self.limited = ""
        self._is_slow = False  # near a singular pose, or since a joint has no more speed
        self._aim_here()

    def _aim_here(self) -> None:
        """Hold the present pose of the tip."""
        self._seen = self._at(self._joints.q_rad)
        self._position, self._rotation = self._seen[:2]
        self._rates = DampedRates(self._task, self._seen[2])

    def _at(self, q_rad: Sequence[float]) -> tuple[Array, Array, Array]:
        """Position (3,), rotation (3, 3) and Jacobian (6, n) of a pose."""
        position, rotation, jacobian = self._kinematics.at(*q_rad)
        return np.array(position), np.array(rotation), np.array(jacobian)

    @property
    def is_at_rest(self) -> bool:
        """Whether the tip is at rest, at its goal or without one."""
        if self._stop is not None:
            return self._stop_s >= self._stop.duration_s
        is_still = all(abs(rate) < _REST for rate in self._tip.rate)
        return is_still and (self._wanted == STILL or self._has_reached())

    def _has_reached(self) -> bool:
        return self._goal is not None and math.dist(self._goal, self._tip.way) < _ARRIVED

    def want(self, twist: Twist) -> None:
        """Set the requested velocity and turning in the base frame, scaled down to the limits if needed."""
        over = max(math.hypot(*twist[:3]) / self._most_m_s, math.hypot(*twist[3:]) / TURN_SPEED_rad_s, 1.0)
        wanted = _twist(rate / over for rate in twist)
        if wanted != self._wanted or self._goal is not None:
            self._wanted, self._goal = wanted, None
            self._resume()

    def step(self, way: Twist, speed: float) -> None:
        """Move or turn the tip by a way along or about one axis, from rest, at a speed [m/s or rad/s]."""
        most = self._most_m_s if any(way[:3]) else TURN_SPEED_rad_s
        length = math.hypot(*way)
        self._tip = TipRate(STILL, STILL, STILL)
        self._wanted = _twist(min(abs(speed), most) * part / length for part in way)
        self._goal = way
        self._resume()

    def _resume(self) -> None:
        """Begin a new request; after a stop, from where the arm has come to."""
        self.limited = ""
        if self._stop is not None:
            self._stop = None
            self._tip = TipRate(STILL, STILL, STILL)
            self._aim_here()

    def advance(self, elapsed_s: float) -> SetPoint:
        """Set-point `elapsed_s` after the last one."""
        if self._stop is None:
            proposed = self._proposed(elapsed_s)
            if not (obstacle := self._obstacle(proposed)):
                self._joints = proposed
                return proposed
            self.limited = f"the jog stopped: {obstacle}"
            self._stop, self._stop_s = StopMotion(self._joints, self._limits), 0.0
        self._stop_s += elapsed_s
        self._joints = self._stop.at(self._stop_s)
        return self._joints

    def take_up(self, motion_s: float, speed_share: float) -> SetPoint:
        """Go on from `motion_s` later, at a share of the present speed: others have slowed the arm down."""
        q, speed, _ = self._joints
        here = tuple(a + v * motion_s for a, v in zip(q, speed, strict=True))
        self._joints = SetPoint(here, tuple(v * speed_share for v in speed), (0.0,) * len(q))
        self._tip = TipRate(self._tip.way, _twist(rate * speed_share for rate in self._tip.rate), STILL)
        self._aim_here()
        if self._stop is not None:
            self._stop, self._stop_s = StopMotion(self._joints, self._limits), 0.0
        return self._joints

    # ---- one cycle

    def _proposed(self, elapsed_s: float) -> SetPoint:
        """The next set-point: the tip's rate, the target, and one Newton step to it."""
        share, ease = self._slowness()
        tip = _sample(self._trajectory(share, ease), elapsed_s)
        self._advance_target(np.subtract(tip.way, self._tip.way))
        error = np.zeros(6)
        error[:3] = self._position - self._seen[0]
        if self._task.has_orientation:
            error[3:] = rotations.logarithms((self._rotation @ self._seen[1].T)[None])[0]
        q = tuple((np.array(self._joints.q_rad) + self._rates.rates(error)).tolist())
        self._seen, self._tip = self._at(q), tip
        self._rates = after = DampedRates(self._task, self._seen[2])
        if after.is_damped or 0 in self._task.nearest:  # what the joints cannot do is not caught up later
            self._position = self._seen[0]
        if after.is_damped or 3 in self._task.nearest:
            self._rotation = self._seen[1]
        speed = after.rates(np.array(tip.rate))
        acceleration = (speed - self._joints.speed_rad_s) / elapsed_s
        self._note(share, after, speed)
        return SetPoint(q, tuple(speed.tolist()), tuple(acceleration.tolist()))

    def _advance_target(self, way: Array) -> None:
        self._position = self._position + way[:3]
        if any(way[3:]):
            self._rotation = rotations.exponentials(way[None, 3:])[0] @ self._rotation

    def _note(self, share: float, after: DampedRates, speed: Array) -> None:
        """Say what limits the jog, if anything does."""
        self.limited = ""
        rate = np.array(self._tip.rate)
        self._is_slow = after.is_damped or share < 1.0
        if self._is_slow:
            where = " near a singular pose" if after.is_damped else ""
            self.limited = f"slowed{where}: joint speeds are limited"
        elif self._task.nearest and any(self._tip.rate):
            moved = self._seen[2] @ speed
            if float(moved @ rate) < _PARTLY * float(rate @ rate):
                self.limited = f"the arm's {len(speed)} joints cannot move the tip this way, or only partly"

    def _obstacle(self, joints: SetPoint) -> str:
        """Why a set-point is not allowed, as text; empty if it is."""
        limits = self._limits
        rates = zip(joints.speed_rad_s, joints.acceleration_rad_s2, strict=True)
        for joint, (speed, acceleration) in enumerate(rates):
            most, quickest = _HARD * limits.speed_rad_s[joint], _HARD * limits.acceleration_rad_s2[joint]
            if abs(speed) > most or abs(acceleration) > quickest:
                return f"joint {joint + 1} would have to turn too fast near a singular pose"
        rest = self._guard.resting_pose(joints)
        for joint, (q, lower, upper) in enumerate(zip(rest, limits.lower_rad, limits.upper_rad, strict=True)):
            here = self._joints.q_rad[joint]
            if (q > upper and q > here) or (q < lower and q < here):
                return f"joint {joint + 1} would leave its range"
        if self._is_slow:
            there, rate = DampedRates(self._task, self._at(rest)[2]), np.array(self._tip.rate)
            if there.margin_m < self._rates.margin_m and there.share(rate) < _PARTLY:
                return "the arm would come too near a singular pose; the joints can hardly move the tip this way"
        return self._guard.objection(rest, self._joints.q_rad)

    def _slowness(self) -> tuple[float, float]:
        """Shares of the tip's requested rate and acceleration that half of the joints' limits allow."""
        wanted = self._wanted if self._wanted != STILL else self._tip.rate
        size = max(math.hypot(*wanted[:3]) / TIP_ACCELERATION_m_s2, math.hypot(*wanted[3:]) / TURN_ACCELERATION_rad_s2)
        if size == 0.0:
            return 1.0, 1.0
        share = ease = 1.0
        for joint, rate in enumerate(self._rates.rates(np.array(wanted)).tolist()):
            if rate != 0.0:
                share = min(share, _EASY * self._limits.speed_rad_s[joint] / abs(rate))
                ease = min(ease, _EASY * self._limits.acceleration_rad_s2[joint] * size / abs(rate))
        return share, max(ease, _SLOWEST)

    def _trajectory(self, share: float, ease: float) -> "ruckig.Trajectory":
        """From the present rate to the requested one, or to rest at the goal; `ease` scales acceleration and jerk."""
        import ruckig

        asked: Any = ruckig.InputParameter(6)
        asked.current_position, asked.current_velocity = list(self._tip.way), list(self._tip.rate)
        asked.current_acceleration = list(self._tip.change)
        asked.max_acceleration = [ease * TIP_ACCELERATION_m_s2] * 3 + [ease * TURN_ACCELERATION_rad_s2] * 3
        rates = [share * rate for rate in self._wanted]
        if self._goal is None:
            asked.max_velocity = [1.0] * 3 + [10.0] * 3
            asked.control_interface = ruckig.ControlInterface.Velocity
            asked.target_velocity = rates
        else:
            asked.max_velocity = [max(map(abs, rates))] * 6
            asked.target_position = list(self._goal)
        asked.synchronization = ruckig.Synchronization.Phase  # a straight line where that is possible
        jerk = [ease * TIP_JERK_m_s3] * 3 + [ease * TURN_JERK_rad_s3] * 3
        return calculated(asked, jerk, f"jog of the tip at {self._wanted} m/s and rad/s")


def _sample(trajectory: "ruckig.Trajectory", time_s: float) -> TipRate:
    """State at a time; beyond the end it keeps its rate, or is exactly at rest."""
    way, rate, change = trajectory.at_time(time_s)
    if time_s >= trajectory.duration and all(abs(x) < _REST for x in rate):
        return TipRate(_twist(trajectory.at_time(trajectory.duration)[0]), STILL, STILL)
    return TipRate(_twist(way), _twist(rate), _twist(change))


def _twist(values: Any) -> Twist:
    a, b, c, d, e, f = values
    return a, b, c, d, e, f
