"""Parses `jog` requests: joint speeds, a tip velocity, or a step of one joint or along one axis."""

from typing import Any

from control.errors import ArmError
from control.loop.jogging import JogRequest, JointSpeeds, JointStep, TipStep, TipVelocity
from control.server.request_values import number, numbers

Message = dict[str, Any]
AXES = ("x", "y", "z")
KINDS = ("joint_speed_rad_s", "tip_velocity_m_s", "joint", "axis")
LARGEST_STEP_rad, LARGEST_STEP_m = 7.0, 1.0  # more is a mistake in the unit


def jog_request(request: Message, joint_count: int) -> JogRequest:
    """Parse the request. ArmError says what is wrong with it; whether the arm can follow is not checked here."""
    kinds = [kind for kind in KINDS if kind in request]
    if len(kinds) != 1:
        got = " and ".join(kinds) or "none of them"
        raise ArmError(f"request 'jog': expected one of {', '.join(KINDS)}, got {got}")
    if kinds[0] == "joint_speed_rad_s":
        return JointSpeeds(numbers(request, "joint_speed_rad_s", joint_count))
    if kinds[0] == "tip_velocity_m_s":
        x, y, z = numbers(request, "tip_velocity_m_s", 3)
        return TipVelocity((x, y, z))
    return _joint_step(request, joint_count) if kinds[0] == "joint" else _tip_step(request)


def _joint_step(request: Message, joint_count: int) -> JointStep:
    joint = number(request, "joint", 1, joint_count)
    if joint != int(joint):
        raise ArmError(
            f"request 'jog': expected joint to be a whole number from 1 to {joint_count}, got {joint}"
        )
    by_rad = number(request, "by_rad", -LARGEST_STEP_rad, LARGEST_STEP_rad)
    return JointStep(int(joint) - 1, by_rad, number(request, "speed_rad_s", 1e-3, 100.0, default=100.0))


def _tip_step(request: Message) -> TipStep:
    axis = request["axis"]
    if axis not in AXES:
        raise ArmError(f"request 'jog': expected axis to be one of {', '.join(AXES)}, got {axis!r}")
    by_m = number(request, "by_m", -LARGEST_STEP_m, LARGEST_STEP_m)
    return TipStep(AXES.index(axis), by_m, number(request, "speed_m_s", 1e-4, 10.0, default=10.0))
