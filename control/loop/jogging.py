"""The active jog: the request, whether it is still renewed, and its motion.

A dead man's switch: the client must keep renewing the request. If it is silent for longer than the limit,
the arm slows to rest and the jog ends.
"""

from dataclasses import dataclass
from typing import Protocol

from control.errors import ArmError
from control.hardware.board_stop import Bridge
from control.kinematics.inverse import InverseKinematics
from control.motion.guard import Guard
from control.motion.jog_joints import JointJog
from control.motion.jog_limits import JogLimits
from control.motion.jog_tip import TipJog
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
    """The tip, in the base frame."""

    velocity_m_s: Vector


@dataclass(frozen=True, slots=True)
class TipStep:
    """The tip along x (0), y or z of the base frame."""

    axis: int
    by_m: float
    speed_m_s: float


JogRequest = JointSpeeds | JointStep | TipVelocity | TipStep


class _Motion(Protocol):
    @property
    def is_at_rest(self) -> bool: ...

    @property
    def limited(self) -> str: ...

    def advance(self, elapsed_s: float) -> SetPoint: ...

    def take_up(self, motion_s: float, speed_share: float) -> SetPoint: ...


class Jogging:
    """One jog, from HOLDING to HOLDING. Changing between joints needs no stop; changing from joints to the tip does."""

    def __init__(self, limits: JogLimits, inverse: InverseKinematics, guard: Guard | None) -> None:
        """`guard`: None for an arm that is not homed; its poses are unknown."""
        self._limits = limits if guard is not None else limits.unhomed()
        self._inverse = inverse
        self._guard = guard
        self._objection = ""  # what the arm would meet
        self._must_rest = False  # before another request
        self._motion: JointJog | TipJog | None = None
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

    def _guarded(self, motion: JointJog | TipJog, elapsed_s: float, set_point: SetPoint) -> SetPoint:
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
        if any(set_point.speed_rad_s):
            self._must_rest = True
            self._cease()
            return wanted
        self._motion = None  # at rest, and nowhere to go
        return set_point

    def take_up(self, set_point: SetPoint, bridge: Bridge) -> SetPoint:
        """Go on after a pause of the host in which the boards slowed the arm down."""
        return (
            set_point if self._motion is None else self._motion.take_up(bridge.motion_s, bridge.speed_share)
        )

    def _begun(self, request: JogRequest, set_point: SetPoint) -> bool:
        """Whether the request could start at once; else the arm must first come to rest."""
        motion = self._motion
        is_step = isinstance(request, JointStep | TipStep)
        if (
            motion is not None
            and (is_step or self._is_step or not _suits(motion, request))
            and not motion.is_at_rest
        ):
            return False
        if motion is None or not _suits(motion, request):
            motion = self._new(request, set_point)
        _tell(motion, request)
        self._motion, self._is_step = motion, is_step
        return True

    def _new(self, request: JogRequest, set_point: SetPoint) -> JointJog | TipJog:
        if isinstance(request, JointSpeeds | JointStep):
            return JointJog(set_point, self._limits.joints)
        if self._guard is None:
            raise ArmError("a tip jog needs every joint homed: home the arm first (`armwright home`)")
        return TipJog(
            set_point,
            self._inverse,
            self._inverse.kinematics,
            self._limits.of_motion,
            self._limits.tip_speed_m_s,
            self._guard.objection,
        )

    def _cease(self) -> None:
        if isinstance(self._motion, JointJog):
            self._motion.want((0.0,) * len(self._limits.joints.speed_rad_s))
        elif self._motion is not None:
            self._motion.want((0.0, 0.0, 0.0))


def _suits(motion: JointJog | TipJog, request: JogRequest) -> bool:
    return isinstance(motion, JointJog) == isinstance(request, JointSpeeds | JointStep)


def _tell(motion: JointJog | TipJog, request: JogRequest) -> None:
    if isinstance(motion, JointJog) and isinstance(request, JointSpeeds):
        motion.want(request.speed_rad_s)
    elif isinstance(motion, JointJog) and isinstance(request, JointStep):
        motion.step(request.joint, request.by_rad, request.speed_rad_s)
    elif isinstance(motion, TipJog) and isinstance(request, TipVelocity):
        motion.want(request.velocity_m_s)
    elif isinstance(motion, TipJog) and isinstance(request, TipStep):
        motion.step(request.axis, request.by_m, request.speed_m_s)
