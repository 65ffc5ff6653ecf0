"""The jog of a `jog` request: joint speeds, a tip velocity, or a step of one joint or along one axis."""

from msgspec import UNSET

from control.errors import ArmError
from control.loop.jogging import JogRequest, JointSpeeds, JointStep, TipStep, TipVelocity
from control.server.messages import StartJog, numbers

AXES = ("x", "y", "z", "rx", "ry", "rz")
KINDS = ("joint_speed_rad_s", "tip_velocity_m_s", "tip_turn_rad_s", "joint", "axis")
_STILL = (0.0, 0.0, 0.0)


def jog_request(request: StartJog, joint_count: int) -> JogRequest:
    """The jog that is asked for. ArmError says what is wrong; whether the arm can follow is not checked here."""
    kinds = [kind for kind in KINDS if getattr(request, kind) is not UNSET]
    if len(kinds) != 1 and kinds != ["tip_velocity_m_s", "tip_turn_rad_s"]:
        got = " and ".join(kinds) or "none of them"
        raise ArmError(f"request 'jog': expected one of {', '.join(KINDS)}, got {got}")
    if request.joint_speed_rad_s is not UNSET:
        return JointSpeeds(numbers("joint_speed_rad_s", request.joint_speed_rad_s, joint_count))
    if request.tip_velocity_m_s is not UNSET or request.tip_turn_rad_s is not UNSET:
        velocity = _STILL if request.tip_velocity_m_s is UNSET else request.tip_velocity_m_s
        turn = _STILL if request.tip_turn_rad_s is UNSET else request.tip_turn_rad_s
        return TipVelocity(velocity, turn, request.frame == "tip")
    return _joint_step(request, joint_count) if request.joint is not UNSET else _tip_step(request)


def _joint_step(request: StartJog, joint_count: int) -> JointStep:
    if request.joint is UNSET or not 1 <= request.joint <= joint_count:
        raise ArmError(
            f"request 'jog': expected joint to be a whole number from 1 to {joint_count}, got {request.joint}"
        )
    if request.by_rad is UNSET:
        raise ArmError("request 'jog': expected by_rad with joint, the angle of the step")
    return JointStep(request.joint - 1, request.by_rad, request.speed_rad_s)


def _tip_step(request: StartJog) -> TipStep:
    if request.axis not in AXES:
        raise ArmError(f"request 'jog': expected axis to be one of {', '.join(AXES)}, got {request.axis!r}")
    index, of_tip = AXES.index(request.axis), request.frame == "tip"
    by, key, speed = request.by_m, "by_m", request.speed_m_s
    if index > 2:
        by, key, speed = request.by_rad, "by_rad", request.speed_rad_s
    if by is UNSET or by == 0.0:
        raise ArmError(f"request 'jog': expected {key} with axis {request.axis}, the size of the step, not 0")
    return TipStep(index, by, speed, of_tip)
