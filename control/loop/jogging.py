"""The active jog: the request, whether it is still renewed, and its motion.

A dead man's switch: the client must keep renewing the request. If it is silent for longer than the limit,
the arm slows to rest and the jog ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import add

from control.errors import ArmError, MotionError
from control.hardware.board_stop import Bridge
from control.kinematics.inverse import InverseKinematics
from control.motion.guard import Guard
from control.motion.jogs import STILL, JointJog, RestGuard, TipJog, Twist
from control.motion.joint_limits import JogLimits
from control.motion.setpoint import SetPoint, Vector


@dataclass(frozen=True, slots=True)
class JointSpeeds:
    """Every joint at its own speed."""

    speed_rad_s: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class JointStep:
    """One joint (0-based) by an angle."""

    joint: int
    by_rad: float
    speed_rad_s: float


@dataclass(frozen=True, slots=True)
class TipVelocity:
    """The tip along and about the axes of the base, or of the tip as they are when the request begins."""

    velocity_m_s: Vector
    turn_rad_s: Vector = (0.0, 0.0, 0.0)
    of_tip: bool = False


@dataclass(frozen=True, slots=True)
class TipStep:
    """The tip along x (0), y or z [m], or about x (3), y or z [rad]; axes as with TipVelocity."""

    axis: int
    by: float
    speed: float
    of_tip: bool = False


JogRequest = JointSpeeds | JointStep | TipVelocity | TipStep
AnyJog = JointJog | TipJog


class Jogging:
    """One jog, from HOLDING to HOLDING. Changing between joints needs no stop; changing from joints to the tip does."""

    def __init__(self, limits: JogLimits, inverse: InverseKinematics, guard: Guard | None) -> None:
        """`guard`: None for an arm that is not homed; its poses are unknown."""
        self._limits = limits if guard is not None else limits.unhomed()
        self._inverse = inverse
        self._asked: JogRequest | None = None
        self._guard = guard
        self._objection = ""  # what the arm would meet
        self._must_rest = False  # before another request
        self._motion: AnyJog | None = None
        self._next: JogRequest | None = None  # once the arm has come to rest
        self._is_step = False
        self._asked_s = 0.0
        self._has_ceased = False

    @property
    def limited(self) -> str:
        """What limits the jog, as text; empty if nothing does."""
        return self._objection or ("" if self._motion is None else self._motion.limited)

    @property
    def _is_moving(self) -> bool:
        return self._motion is not None and not self._motion.is_at_rest

    @property
    def is_over(self) -> bool:
        """Whether the arm is at rest and no request is active."""
        is_done = self._is_step or self._has_ceased
        return is_done and self._next is None and (self._motion is None or self._motion.is_at_rest)

    def ask(self, now_s: float, request: JogRequest, set_point: SetPoint) -> None:
        """Start, change or renew a request. ArmError says why it is refused; then nothing changes."""
        if not (self._must_rest and self._is_moving) and self._begun(request, set_point):
            self._next, self._must_rest = None, False
        else:
            self._next = request
            self._cease()
        self._has_ceased = False
        self._asked_s = now_s

    def renew(self, now_s: float) -> None:
        """Renew the request."""
        if not self._has_ceased:
            self._asked_s = now_s

    def advance(self, now_s: float, elapsed_s: float, set_point: SetPoint) -> SetPoint:
        """Return the next set-point. Raises whatever makes the motion impossible."""
        if not self._has_ceased and now_s - self._asked_s > self._limits.silence_s:
            self._has_ceased, self._next = True, None
            self._cease()
        if self._next is not None and self._motion is not None and self._motion.is_at_rest:
            self._motion, self._must_rest = None, False
            request, self._next = self._next, None
            try:
                self._begun(request, set_point)
            except ArmError:  # the arm is elsewhere than at the request; the next renewal reports why
                self._is_step = True
        return set_point if self._motion is None else self._guarded(self._motion, elapsed_s, set_point)

    def _guarded(self, motion: AnyJog, elapsed_s: float, set_point: SetPoint) -> SetPoint:
        """The motion's next set-point; the motion comes to rest where the arm would meet something.

        A tip jog looks at the end of its own stop.
        """
        wanted = motion.advance(elapsed_s)
        if self._guard is None or self._must_rest:
            return wanted
        if not isinstance(motion, JointJog):
            self._objection = ""
            return wanted
        self._objection = self._guard.jog_objection(wanted, set_point)
        if not self._objection:
            return wanted
        self._must_rest = True
        self._motion = JointJog(set_point, self._limits.joints)  # the stop that was looked at with the last set-point
        self._asked = None
        return self._motion.advance(elapsed_s)

    def take_up(self, set_point: SetPoint, bridge: Bridge) -> SetPoint:
        """Go on after a pause of the host in which the boards slowed the arm down."""
        return set_point if self._motion is None else self._motion.take_up(bridge.motion_s, bridge.speed_share)

    def _begun(self, request: JogRequest, set_point: SetPoint) -> bool:
        """Whether the request could start at once; else the arm must first come to rest."""
        motion = self._motion
        is_step = isinstance(request, JointStep | TipStep)
        if motion is not None and (is_step or self._is_step or not _suits(motion, request)) and not motion.is_at_rest:
            return False
        if motion is None or not _suits(motion, request):
            motion = self._new(request, set_point)
        if isinstance(motion, JointJog):
            _tell(motion, request)
        elif request != self._asked or motion is not self._motion or is_step:
            self._tell_tip(motion, request, set_point)
        self._motion, self._is_step, self._asked = motion, is_step, request
        return True

    def _tell_tip(self, motion: TipJog, request: JogRequest, set_point: SetPoint) -> None:
        """The request along the base's axes. ArmError if the arm has no joints for a turn, or cannot get there."""
        if isinstance(request, TipStep):
            way = [0.0] * 6
            way[request.axis] = request.by
            twist = self._in_base(way, request.of_tip, set_point)
            if self._inverse.follows_position:  # then the step's end is known at once
                x, y, z = map(add, self._inverse.kinematics.tip(*set_point.q_rad), twist[:3])
                try:
                    self._inverse.follow((x, y, z), set_point.q_rad)
                except ArmError as error:
                    raise MotionError(f"jog: the tip cannot go there: {error}") from error
            motion.step(twist, request.speed)
        elif isinstance(request, TipVelocity):
            motion.want(self._in_base((*request.velocity_m_s, *request.turn_rad_s), request.of_tip, set_point))

    def _in_base(self, twist: Sequence[float], of_tip: bool, set_point: SetPoint) -> Twist:
        a, b, c, d, e, f = twist
        if any(twist[3:]) and not self._inverse.held.has_orientation:
            count = len(set_point.q_rad)
            raise MotionError(
                f"jog: an arm of {count} joints cannot turn its tip: its orientation follows from its position;"
                " turn a joint instead (`armwright jog --joint`)"
            )
        if not of_tip:
            return a, b, c, d, e, f
        rows = self._inverse.poses.at(*set_point.q_rad)[1]
        x, y, z = (r * a + s * b + t * c for r, s, t in rows)
        u, v, w = (r * d + s * e + t * f for r, s, t in rows)
        return x, y, z, u, v, w

    def _new(self, request: JogRequest, set_point: SetPoint) -> AnyJog:
        if isinstance(request, JointSpeeds | JointStep):
            return JointJog(set_point, self._limits.joints)
        if self._guard is None:
            raise ArmError("a tip jog needs every joint homed: home the arm first (`armwright home`)")
        guard = RestGuard(self._guard.resting_pose, self._guard.objection)
        return TipJog(set_point, self._inverse.poses, self._inverse.held, self._limits, guard)

    def _cease(self) -> None:
        if isinstance(self._motion, JointJog):
            self._motion.want((0.0,) * len(self._limits.joints.speed_rad_s))
        elif self._motion is not None:
            self._motion.want(STILL)
        self._asked = None


def _suits(motion: AnyJog, request: JogRequest) -> bool:
    return isinstance(motion, JointJog) == isinstance(request, JointSpeeds | JointStep)


def _tell(motion: JointJog, request: JogRequest) -> None:
    if isinstance(request, JointSpeeds):
        motion.want(request.speed_rad_s)
    elif isinstance(request, JointStep):
        motion.step(request.joint, request.by_rad, request.speed_rad_s)
