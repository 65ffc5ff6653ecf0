"""Tip jog along the axes of the base frame: jerk-limited, and always with a checked stop.

The set-point is a tip position with its velocity and acceleration, moved by ruckig (velocity control, or position control for a
step). Every cycle proposes the next state and calculates the stop from it. The proposal is accepted only if

- the pose at the end of that stop exists: on the same branch, inside the joints' ranges, clear of singular poses,
- the arm meets nothing there (control.motion.guard),
- no joint exceeds its limits of speed and acceleration in the proposed state, nor could at that end.

Otherwise the arm follows the stop that was checked with the last state, and reports the obstacle. Before that,
it slows down: near a singular pose the joints move ever faster for the same tip speed, so the tip's speed and acceleration
are limited to what half of the joints' limits allow at the end of the stop.

For arms of three joints, whose tip position fixes the joint angles on a branch.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from control.errors import ArmError, JointLimitViolated, NearSingular, OutOfReach
from control.motion.errors import MotionError
from control.motion.jog_limits import TIP_ACCELERATION_m_s2, TIP_JERK_m_s3
from control.motion.joint_limits import JointLimits
from control.motion.path import Differentiates, Follows, inverse_of, times
from control.motion.setpoint import SetPoint, Vector
from control.motion.trajectory import calculated

if TYPE_CHECKING:
    import ruckig

Objection = Callable[[Sequence[float], Sequence[float]], str]
ZERO: Vector = (0.0, 0.0, 0.0)
_EASY = 0.5  # of the joints' limits: bound of the tip's speed
_HARD = 0.95  # of the joints' limits: bound of every proposal
_SLOWEST = 1e-3  # of the tip's acceleration, so that a stop always ends
_SINGULAR = {
    "elbow": "the arm would be nearly stretched or folded (a singular pose)",
    "shoulder": "the tip would be nearly over axis 1 (a singular pose)",
}
_AT_REST_m_s = 1e-9
_ARRIVED_m = 1e-8


class TipState(NamedTuple):
    """Position [m], velocity and acceleration of the tip in the base frame."""

    position_m: Vector
    velocity_m_s: Vector
    acceleration_m_s2: Vector


class _Looked(NamedTuple):
    """A checked state: its set-point, the stop from it, and the joints at the end of the stop."""

    tip: TipState
    joints: SetPoint
    stop: "ruckig.Trajectory"
    q_end: tuple[float, ...]


class TipJog:
    """Jogs the tip, from rest.

    Raises:
        ArmError: the pose is singular or outside of the joints' ranges; jog joints instead.
    """

    __slots__ = (
        "_goal_m", "_inverse", "_kinematics", "_limits", "_looked", "_most_m_s", "_objection", "_stop_s", "_stopping", "_wanted",
        "limited",
    )  # fmt: skip

    def __init__(
        self,
        start: SetPoint,
        inverse: Follows,
        kinematics: Differentiates,
        limits: JointLimits,
        tip_speed_m_s: float,
        objection: Objection = lambda wanted_rad, here_rad: "",
    ) -> None:
        """`limits`: those of every motion, not of a jog; `tip_speed_m_s`: the largest tip speed.

        `objection` says why the arm must not get from one pose to another; empty if it may.
        """
        if len(start.q_rad) != 3:
            raise MotionError(
                f"jog: a tip jog needs an arm of 3 joints, got {len(start.q_rad)}: jog its joints"
            )
        self._inverse, self._kinematics, self._limits = inverse, kinematics, limits
        self._most_m_s, self._objection = tip_speed_m_s, objection
        self._wanted: Vector = ZERO
        self._goal_m: Vector | None = None
        self._stopping = False  # until rest, or until another request
        self._stop_s = 0.0
        self.limited = ""
        tip = kinematics.tip_jacobian(*start.q_rad)[0]
        try:
            self._looked = self._look(TipState(tip, ZERO, ZERO), start.q_rad, 1.0)
        except ArmError as error:
            raise MotionError(f"jog: {_in_words(error)}; jog joints away from this pose") from error

    @property
    def is_at_rest(self) -> bool:
        """Whether the tip is at rest, at its goal or without one."""
        is_still = all(abs(v) < _AT_REST_m_s for v in self._looked.tip.velocity_m_s)
        return is_still and (self._stopping or self._wanted == ZERO or self._has_reached())

    def _has_reached(self) -> bool:
        return self._goal_m is not None and math.dist(self._goal_m, self._looked.tip.position_m) < _ARRIVED_m

    def want(self, velocity_m_s: Vector) -> None:
        """Set the requested velocity in the base frame, scaled down to the limit if needed."""
        speed = math.hypot(*velocity_m_s)
        if speed > self._most_m_s:
            x, y, z = velocity_m_s
            share = self._most_m_s / speed
            velocity_m_s = (x * share, y * share, z * share)
        if velocity_m_s == self._wanted and self._goal_m is None:
            return
        self._wanted, self._goal_m = velocity_m_s, None
        self._resume()

    def step(self, way_m: Vector, speed_m_s: float) -> None:
        """Move the tip by a way, from rest. ArmError if it cannot come to rest there."""
        (x, y, z), (dx, dy, dz) = self._looked.tip.position_m, way_m
        goal_m = (x + dx, y + dy, z + dz)
        share = min(abs(speed_m_s), self._most_m_s) / math.hypot(*way_m)
        try:
            self._inverse.follow(goal_m, self._looked.joints.q_rad)
        except ArmError as error:
            raise MotionError(f"jog: the tip cannot go there: {_in_words(error)}") from error
        self._goal_m, self._wanted = goal_m, (share * dx, share * dy, share * dz)
        self._resume()

    def advance(self, elapsed_s: float) -> SetPoint:
        """Set-point `elapsed_s` after the last one."""
        if not self._stopping:
            try:
                self._looked = self._proposed(elapsed_s)
                self._stop_s = 0.0
                return self._looked.joints
            except ArmError as obstacle:
                self._stopping = True
                self.limited = f"the jog stopped: {_in_words(obstacle)}"
        self._stop_s += elapsed_s
        tip = _sample(self._looked.stop, self._stop_s)
        self._looked = self._looked._replace(tip=tip, joints=self._joints(tip, self._looked.joints.q_rad))
        return self._looked.joints

    def take_up(self, motion_s: float, speed_share: float) -> SetPoint:
        """Go on from `motion_s` later, at a share of the present speed: others have slowed the arm down."""
        position, velocity, _ = self._looked.tip
        x, y, z = (p + v * motion_s for p, v in zip(position, velocity, strict=True))
        vx, vy, vz = (v * speed_share for v in velocity)
        tip = TipState((x, y, z), (vx, vy, vz), ZERO)
        joints = self._joints(tip, self._looked.joints.q_rad)
        stop = _trajectory(tip, ZERO, None, 1.0, 1.0)
        self._looked, self._stop_s = self._looked._replace(tip=tip, joints=joints, stop=stop), 0.0
        return joints

    def _resume(self) -> None:
        """Leave a stop for a new request, checking from the present state."""
        self.limited = ""
        self._stopping = False

    def _proposed(self, elapsed_s: float) -> _Looked:
        """The next checked state. ArmError names the obstacle."""
        last = self._looked
        share, ease = self._slowness(last)
        self.limited = "slowed near a singular pose: joint speeds are limited" if share < 1.0 else ""
        tip = _sample(_trajectory(last.tip, self._wanted, self._goal_m, share, ease), elapsed_s)
        return self._look(tip, last.joints.q_rad, ease)

    def _look(self, tip: TipState, q_near: tuple[float, ...], ease: float) -> _Looked:
        """Check `tip` and its stop; ArmError if either is not allowed."""
        joints = self._joints(tip, q_near)
        stop = _trajectory(tip, ZERO, None, 1.0, ease)
        end = _sample(stop, stop.duration)
        q_end = self._inverse.follow(end.position_m, joints.q_rad)
        self._require_within(joints)
        if objection := self._objection(q_end, q_near):
            raise MotionError(objection)
        if tip.velocity_m_s != ZERO:
            speed, braking = self._rates(q_end, tip.velocity_m_s), ease * TIP_ACCELERATION_m_s2
            fastest = math.hypot(*tip.velocity_m_s)
            for joint, (rate, fast, quick) in enumerate(
                zip(speed, self._limits.speed_rad_s, self._limits.acceleration_rad_s2, strict=True), 1
            ):
                if abs(rate) > _HARD * fast or abs(rate) / fastest * braking > _HARD * quick:
                    raise MotionError(f"joint {joint} would have to turn too fast near a singular pose")
        return _Looked(tip, joints, stop, q_end)

    def _require_within(self, joints: SetPoint) -> None:
        limits = zip(joints.speed_rad_s, joints.acceleration_rad_s2, strict=True)
        for joint, (speed, acceleration) in enumerate(limits):
            if (
                abs(speed) > _HARD * self._limits.speed_rad_s[joint]
                or abs(acceleration) > _HARD * self._limits.acceleration_rad_s2[joint]
            ):
                raise MotionError(f"joint {joint + 1} would exceed its speed or acceleration")

    def _slowness(self, looked: _Looked) -> tuple[float, float]:
        """Shares of the tip's requested speed and acceleration that half of the joints' limits allow."""
        wanted = self._wanted if self._wanted != ZERO else looked.tip.velocity_m_s
        speed = math.hypot(*wanted)
        if speed == 0.0:
            return 1.0, 1.0
        share = ease = 1.0
        for joint, rate in enumerate(self._rates(looked.q_end, wanted)):
            if rate != 0.0:
                share = min(share, _EASY * self._limits.speed_rad_s[joint] / abs(rate))
                most = _EASY * self._limits.acceleration_rad_s2[joint] * speed / abs(rate)
                ease = min(ease, most / TIP_ACCELERATION_m_s2)
        return share, max(ease, _SLOWEST)

    def _rates(self, q: tuple[float, ...], velocity_m_s: Vector) -> Vector:
        """Joint speeds [rad/s] for a tip velocity in a pose."""
        return times(inverse_of(self._kinematics.tip_jacobian(*q)[1]), velocity_m_s)

    def _joints(self, tip: TipState, q_near: tuple[float, ...]) -> SetPoint:
        q = self._inverse.follow(tip.position_m, q_near)
        inverse = inverse_of(self._kinematics.tip_jacobian(*q)[1])
        speed = times(inverse, tip.velocity_m_s)
        (ax, ay, az), (bx, by, bz) = tip.acceleration_m_s2, self._kinematics.tip_bias(q, speed)
        return SetPoint(q, speed, times(inverse, (ax - bx, ay - by, az - bz)))


def _in_words(obstacle: ArmError) -> str:
    """Describe the obstacle for an operator."""
    if isinstance(obstacle, JointLimitViolated):
        return f"joint {obstacle.joint} would leave its range"
    if isinstance(obstacle, NearSingular):
        return _SINGULAR.get(obstacle.which, "the pose would be nearly singular")
    return "it would be out of reach" if isinstance(obstacle, OutOfReach) else str(obstacle)


def _trajectory(
    tip: TipState, wanted: Vector, goal_m: Vector | None, share: float, ease: float
) -> "ruckig.Trajectory":
    """From `tip` to the requested velocity, or to rest at the goal; `ease` scales acceleration and jerk."""
    import ruckig

    asked: Any = ruckig.InputParameter(3)
    asked.current_position, asked.current_velocity = list(tip.position_m), list(tip.velocity_m_s)
    asked.current_acceleration = list(tip.acceleration_m_s2)
    most_m_s2 = ease * TIP_ACCELERATION_m_s2
    asked.max_acceleration = [most_m_s2] * 3
    speeds = [share * v for v in wanted]
    if goal_m is None:
        asked.max_velocity = [1.0] * 3
        asked.control_interface = ruckig.ControlInterface.Velocity
        asked.target_velocity = speeds
    else:
        asked.max_velocity = [max(map(abs, speeds))] * 3
        asked.target_position = list(goal_m)
    asked.synchronization = ruckig.Synchronization.Phase  # a straight line where that is possible
    return calculated(
        asked, [ease * TIP_JERK_m_s3] * 3, f"jog of the tip from {tip.position_m} at {wanted} m/s"
    )


def _sample(trajectory: "ruckig.Trajectory", time_s: float) -> TipState:
    """State at a time; beyond the end it keeps its velocity, or is exactly at rest."""
    p, v, a = trajectory.at_time(time_s)
    if time_s >= trajectory.duration and all(abs(x) < _AT_REST_m_s for x in v):
        p, v, a = trajectory.at_time(trajectory.duration)[0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    return TipState((p[0], p[1], p[2]), (v[0], v[1], v[2]), (a[0], a[1], a[2]))
