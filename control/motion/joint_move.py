"""Joint moves and stops: jerk-limited and time-optimal, by ruckig, calculated once and evaluated every cycle."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from control.errors import MotionError
from control.model.rules import ANGLE
from control.motion.joint_limits import JointLimits
from control.motion.setpoint import SetPoint, at_rest

if TYPE_CHECKING:
    import ruckig

# A joint may end a motion beyond its range only by rounding errors.
_ROUNDING_RAD = 1e-9
# Search for the turning points of a move: fine enough that a joint does not turn twice within a step unseen.
_SEARCH_STEPS, _BISECTIONS = 100, 30
# Steps of harder braking (acceleration, jerk) where the normal stop would leave a joint's range, or meet something. The jerk
# limit spares the gears, so it goes first; three times the acceleration is well inside the reference arm's
# means (24 Nm at the current limit on about 0.5 kg m^2).
_HARDER = ((1.0, 1.0), (1.0, 4.0), (1.0, 25.0), (1.5, 100.0), (2.0, 100.0), (3.0, 100.0))
HARDEST = len(_HARDER) - 1


class JointMove:
    """Synchronised move of all joints from a state, at rest or moving, to rest at `q_to_rad`.

    A move to where the arm already rests has duration 0.

    Raises:
        MotionError: not finite, wrong count, a target or the way to it out of the joint limits.
    """

    __slots__ = ("_end", "_trajectory", "duration_s")

    def __init__(self, start: SetPoint | Sequence[float], q_to_rad: Sequence[float], limits: JointLimits) -> None:
        state = start if isinstance(start, SetPoint) else at_rest(tuple(start))
        target = tuple(float(q) for q in q_to_rad)
        _require_sane("joint move", state, target, limits)
        target = _inside(target, limits)
        self._trajectory = _calculate(state, target, limits)
        self._end = at_rest(target)
        self.duration_s: float = self._trajectory.duration
        if any(state.speed_rad_s) or any(state.acceleration_rad_s2):
            _require_way_inside(self._trajectory, state, limits)

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start, clamped to the motion's time."""
        if time_s >= self.duration_s:
            return self._end
        return _sample(self._trajectory, time_s)


class StopMotion:
    """Jerk-limited stop of each joint from `state`, each as soon as its limits allow.

    If the normal stop would leave a joint's range, that joint brakes harder, by the steps of `_HARDER`.
    If none of them suffices, the hardest is used and `overshoot_rad` (per joint) is what remains.
    """

    __slots__ = ("_end", "_trajectories", "duration_s", "overshoot_rad")

    def __init__(self, state: SetPoint, limits: JointLimits) -> None:
        _require_sane("stop", state, state.q_rad, limits)
        joints = [_stop_one(_one(state, j), _one_limit(limits, j)) for j in range(len(state.q_rad))]
        self._trajectories = tuple(trajectory for trajectory, _ in joints)
        self.overshoot_rad = tuple(overshoot for _, overshoot in joints)
        self.duration_s: float = max(trajectory.duration for trajectory in self._trajectories)
        ends = (_sample(trajectory, trajectory.duration).q_rad[0] for trajectory in self._trajectories)
        self._end = at_rest(tuple(ends))

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start of the stop, clamped to its time."""
        if time_s >= self.duration_s:
            return self._end
        each = [_sample(trajectory, min(time_s, trajectory.duration)) for trajectory in self._trajectories]
        q, speed, acceleration = (tuple(column[0] for column in columns) for columns in zip(*each, strict=True))
        return SetPoint(q, speed, acceleration)


class StraightStop:
    """Stop of all joints by one law, on the straight line of angles on which they move: q = q0 + v s(t), s' from 1 to 0.

    It brakes as hard as the step `hardness`, at most HARDEST, allows every joint. The acceleration along the line goes on.
    At least one joint must move.
    """

    __slots__ = ("_start", "_trajectory", "duration_s", "is_in_range")

    def __init__(self, state: SetPoint, limits: JointLimits, hardness: int) -> None:
        means, speed = limits.braking(*_HARDER[hardness]), state.speed_rad_s
        most, jerk = (
            min(limit / abs(v) for limit, v in zip(each, speed, strict=True) if v)
            for each in (means.acceleration_rad_s2, means.jerk_rad_s3)
        )
        along = sum(a * v for a, v in zip(state.acceleration_rad_s2, speed, strict=True)) / sum(v * v for v in speed)
        begun = SetPoint((0.0,), (1.0,), (min(max(along, -most), most),))
        line = JointLimits((-math.inf,), (math.inf,), (1.0,), (most,), (jerk,))
        self._start, self._trajectory = state, _calculate(begun, None, line)
        self.duration_s: float = self._trajectory.duration
        ranges = (_range(limits, state, j) for j in range(len(speed)))
        end_rad = self.at(self.duration_s).q_rad
        self.is_in_range = all(lower <= q <= upper for q, (lower, upper) in zip(end_rad, ranges, strict=True))

    def at(self, time_s: float) -> SetPoint:
        """Set-point `time_s` after the start of the stop, clamped to its time."""
        (s,), (rate,), (change,) = _sample(self._trajectory, min(time_s, self.duration_s))
        if time_s >= self.duration_s:
            rate = change = 0.0
        q, speed, _ = self._start
        return SetPoint(
            tuple(p + v * s for p, v in zip(q, speed, strict=True)),
            tuple(v * rate for v in speed),
            tuple(v * change for v in speed),
        )


def _stop_one(state: SetPoint, limits: JointLimits) -> "tuple[ruckig.Trajectory, float]":
    """The gentlest stop of one joint within its range, or else the hardest one, and its overshoot [rad]."""
    for acceleration, jerk in _HARDER:
        trajectory = _calculate(state, None, limits.braking(acceleration, jerk))
        ((low, high),) = [(bound.min, bound.max) for bound in trajectory.position_extrema]
        lower, upper = _range(limits, state, 0)
        overshoot = max(high - upper, lower - low, 0.0)
        if overshoot <= _ROUNDING_RAD:
            return trajectory, 0.0
    return trajectory, overshoot


def _calculate(state: SetPoint, target: tuple[float, ...] | None, limits: JointLimits) -> "ruckig.Trajectory":
    """Trajectory to rest at `target`, joints synchronised; or to rest anywhere if `target` is None."""
    import ruckig

    count = len(state.q_rad)
    asked: Any = ruckig.InputParameter(count)
    asked.current_position, asked.current_velocity = list(state.q_rad), list(state.speed_rad_s)
    asked.current_acceleration = list(state.acceleration_rad_s2)
    asked.max_velocity, asked.max_acceleration = list(limits.speed_rad_s), list(limits.acceleration_rad_s2)
    if target is None:
        asked.control_interface = ruckig.ControlInterface.Velocity
        asked.synchronization = ruckig.Synchronization.No
    else:
        asked.target_position = list(target)
        asked.synchronization = ruckig.Synchronization.Phase  # a straight line in joint space where possible
    return calculated(asked, limits.jerk_rad_s3, f"joint move from {state} to {target or 'rest'}")


def _sample(trajectory: "ruckig.Trajectory", time_s: float) -> SetPoint:
    q, speed, acceleration = trajectory.at_time(max(time_s, 0.0))
    return SetPoint(tuple(q), tuple(speed), tuple(acceleration))


def _searched_extrema(trajectory: "ruckig.Trajectory", joint: int) -> tuple[float, float]:
    """Least and greatest position of a joint [rad] on a move from a moving state, at changes of direction.

    ruckig's `position_extrema` leaves out the braking that comes before such a move (0.19.4: up to 0.15 rad
    short).
    """
    duration = trajectory.duration
    extrema_rad = [_sample(trajectory, time).q_rad[joint] for time in (0.0, duration)]
    times = [duration * i / _SEARCH_STEPS for i in range(_SEARCH_STEPS + 1)]
    speeds = [_sample(trajectory, time).speed_rad_s[joint] for time in times]
    for (low, high), (before, after) in zip(pairwise(times), pairwise(speeds), strict=True):
        if before != 0.0 and before * after <= 0.0:
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                is_before = _sample(trajectory, middle).speed_rad_s[joint] * before > 0.0
                low, high = (middle, high) if is_before else (low, middle)
            extrema_rad.append(_sample(trajectory, low).q_rad[joint])
    return min(extrema_rad), max(extrema_rad)


def _range(limits: JointLimits, state: SetPoint, joint: int) -> tuple[float, float]:
    """A joint's range, extended to the joint's present position (it may always come back)."""
    here = state.q_rad[joint]
    return min(limits.lower_rad[joint], here), max(limits.upper_rad[joint], here)


def _one(state: SetPoint, joint: int) -> SetPoint:
    return SetPoint(*((values[joint],) for values in state))


def _one_limit(limits: JointLimits, joint: int) -> JointLimits:
    return JointLimits(
        (limits.lower_rad[joint],),
        (limits.upper_rad[joint],),
        (limits.speed_rad_s[joint],),
        (limits.acceleration_rad_s2[joint],),
        (limits.jerk_rad_s3[joint],),
    )


def _require_sane(what: str, state: SetPoint, target: tuple[float, ...], limits: JointLimits) -> None:
    """Raise MotionError unless all have the limits' number of joints and are finite."""
    count = len(limits.speed_rad_s)
    for values in (*state, target):
        if len(values) != count or not all(map(math.isfinite, values)):
            raise MotionError(f"{what}: expected {count} finite numbers for angles, speeds ..., got {values}")


def _inside(target: tuple[float, ...], limits: JointLimits) -> tuple[float, ...]:
    """The target, on its range where rounding has put it beyond: the loop's last guard lets no set-point out.

    MotionError for the first joint whose target is farther outside.
    """
    for joint, (q, low, high) in enumerate(zip(target, limits.lower_rad, limits.upper_rad, strict=True), 1):
        beyond = max(q - high, low - q)
        if beyond > _ROUNDING_RAD:
            raise MotionError(
                f"joint move: joint {joint} cannot go to {q:.4f} rad, {beyond:.4f} rad outside of its range"
                f" {low:.4f} .. {high:.4f} rad{ANGLE.doubt(q)}"
            )
    return tuple(map(min, map(max, target, limits.lower_rad), limits.upper_rad))


def _require_way_inside(trajectory: "ruckig.Trajectory", state: SetPoint, limits: JointLimits) -> None:
    """Raise MotionError if a moving start would take a joint out of its range."""
    for joint in range(len(state.q_rad)):
        low, high = _searched_extrema(trajectory, joint)
        lower, upper = _range(limits, state, joint)
        beyond = max(high - upper, lower - low)
        if beyond > _ROUNDING_RAD:
            raise MotionError(
                f"joint move: joint {joint + 1} is too fast and would leave its range by {beyond:.4f} rad: stop first"
            )


# Calls ruckig, the library for jerk-limited trajectories, so that every way in which it can fail is one error.
#
# Slow to import, so a client imports it with its first motion; the loop's process does before its first cycle (`prepare`).
# `intermediate_positions` is never set: the community version sends
# them to a remote service.

if TYPE_CHECKING:
    import ruckig

# ruckig 0.19.4 finds no trajectory over exactly 2 a^3 / j^2, where the acceleration limit is touched for no time: 0.05 rad with
# 10 rad/s^2 and 200 rad/s^3. A little less jerk and it does.
_JERK_SHARES = (1.0, 1.0 - 1e-7, 1.0 - 1e-4)


def prepare() -> None:
    """Import what motions need now: later it would cost cycles, or fail for want of memory or file descriptors."""
    import ruckig

    ruckig.Ruckig(1)


def calculated(asked: Any, jerk: Sequence[float], what: str) -> "ruckig.Trajectory":
    """The trajectory of an InputParameter that is complete but for its `max_jerk`. MotionError names `what` if there is none."""
    import ruckig

    trajectory = ruckig.Trajectory(len(jerk))
    for share in _JERK_SHARES:
        asked.max_jerk = [limit * share for limit in jerk]
        try:
            result = ruckig.Ruckig(len(jerk)).calculate(asked, trajectory)
        except (ruckig.RuckigError, ValueError):  # ValueError: a result that its own Result does not know, such as -101
            continue
        if result in (ruckig.Result.Working, ruckig.Result.Finished):
            return trajectory
    raise MotionError(f"{what}: there is no jerk-limited motion; ask for a slightly different one")
