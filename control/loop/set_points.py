"""Set-points: of the joints, and the aim, which is the set-point of their encoders; and the active motion that gives them, a
planned one or the stop that replaces it.

Writes `set_point`, `aim` and `is_of_encoders`, `paced` and `stops_along`. Set-point and aim are equal on an arm without effects
behind its encoders; else `control.dynamics.joint_side` converts between them, once the arm is homed.
"""

from collections.abc import Sequence

from control.loop.arm_state import ArmState
from control.motion.pace import Limited, Paced
from control.motion.setpoint import Motion, SetPoint, at_rest
from control.safety.limits import Clip, limit_set_point
from control.safety.modes import Mode

Angles = tuple[float, ...]
ON_PATH = (Mode.MOVING, Mode.PAUSED)


def joints_standing(state: ArmState, encoder_rad: Sequence[float]) -> Angles:
    """Joint angles of an arm at rest at its encoder angles; before homing they are equal."""
    side = state.parts.joint_side
    if side is None or not state.monitor.is_homed:
        return tuple(encoder_rad)
    return side.stand(encoder_rad)


def measured(state: ArmState) -> SetPoint:
    """The present motion of the arm as a set-point."""
    found = state.parts.measurement
    return SetPoint(joints_standing(state, found.q_rad), tuple(found.speed_rad_s), state.no_motion)


def stay(state: ArmState) -> None:
    """Let the set-point follow the arm while nothing is controlled."""
    state.set_point, state.is_of_encoders = (at_rest(joints_standing(state, state.parts.measurement.q_rad)), False)


def rest(state: ArmState) -> None:
    """End a motion: hold the set-point, again as joint angles."""
    at_rad = state.set_point.q_rad
    state.set_point = at_rest(joints_standing(state, at_rad) if state.is_of_encoders else at_rad)
    state.is_of_encoders = False


def take(state: ArmState, wanted: SetPoint) -> Clip | None:
    """Apply a motion's set-point through the final limits: its plan was checked, so a clip means an error.

    A stop is not limited: it may brake harder than a motion to stay in a joint's range. Nor is a jog of joints
    without a zero: it has its own limits of speed and acceleration.
    """
    mode = state.monitor.mode
    if not (mode in ON_PATH or (mode is Mode.JOGGING and state.monitor.is_homed)):
        state.set_point = wanted
        return None
    last = state.set_point
    allowed = limit_set_point(wanted.q_rad, last.q_rad, last.speed_rad_s, state.parts.set_point_limits, state.elapsed_s)
    if not allowed.reasons:
        state.set_point = wanted
        return None
    state.set_point = SetPoint(allowed.q_rad, allowed.speed_rad_s, state.no_motion)
    return allowed.reasons[0]


def objection(state: ArmState, wanted: SetPoint) -> str:
    """Why the arm must not get to a motion's set-point: floor, table, its own base; empty if it may.

    Motions were checked before they began, so this finds what that check missed. A jog looks ahead by itself
    (control.loop.jogging); a stop and poses without a zero are not checked.
    """
    if state.monitor.mode not in ON_PATH:
        return ""
    return state.parts.tool.guard.passing_objection(wanted.q_rad, state.set_point.q_rad)


def aim(state: ArmState) -> Clip | None:
    """Compute the encoders' set-point for that of the joints, within its own limits; returns the clip, if any."""
    side = state.parts.joint_side
    if side is None or not state.monitor.is_homed:
        state.aim = state.set_point
        return None
    wanted = SetPoint(*side.aim(state.set_point, state.elapsed_s))
    if state.is_of_encoders:
        state.aim = state.set_point
        return None
    if state.monitor.mode not in (*ON_PATH, Mode.JOGGING) or state.bridge is not None:
        state.aim = wanted
        return None
    last = state.aim
    allowed = limit_set_point(wanted.q_rad, last.q_rad, last.speed_rad_s, state.parts.aim_limits, state.elapsed_s)
    if not allowed.reasons:
        state.aim = wanted
        return None
    state.aim = SetPoint(allowed.q_rad, allowed.speed_rad_s, state.no_motion)
    return allowed.reasons[0]


def joint_rad(state: ArmState) -> tuple[Sequence[float], Angles]:
    """Actual and set joint angles, corrected for the modelled effects between joints and encoders."""
    side, encoder_rad = state.parts.joint_side, state.parts.measurement.q_rad
    if side is None or not state.monitor.is_homed:
        return encoder_rad, state.set_point.q_rad
    return side.joint_rad(encoder_rad), seen(state, as_encoders=False).q_rad


def seen(state: ArmState, as_encoders: bool) -> SetPoint:
    """The present set-point, as joint angles or as encoder angles."""
    side = state.parts.joint_side
    if side is None or not state.monitor.is_homed or as_encoders == state.is_of_encoders:
        return state.set_point
    return at_rest(state.aim.q_rad if as_encoders else side.joint_rad(state.aim.q_rad))


def follow_shift(state: ArmState) -> None:
    """Shift the set-point with a counter that was shifted, so that a held joint does not move."""
    shifts = state.parts.measurement.shifted_rad
    state.set_point, state.aim = (
        point._replace(q_rad=tuple(q + shift for q, shift in zip(point.q_rad, shifts, strict=True)))
        for point in (state.set_point, state.aim)
    )


STOP_WITHIN_S = 0.4  # from full speed and pace it takes 0.3 s, the joints' own stops 0.25 s


def begin(state: ArmState, motion: Motion, pace: float, beside: Sequence[Limited] = ()) -> None:
    """Start `motion` now; `beside`: motions of other arms that keep its pace."""
    state.stops_along = False
    state.paced = Paced(motion, limits_of(state), pace, beside)


def limits_of(state: ArmState) -> Sequence[float]:
    """Of each joint's acceleration [rad/s2]."""
    return [limit.acceleration_rad_s2 for limit in state.parts.set_point_limits]


def stop_along(state: ArmState) -> bool:
    """Let the active motion slow down to rest on its own path, if that is soon enough; return whether it is."""
    state.stops_along = state.paced is not None and state.paced.can_rest(STOP_WITHIN_S)
    return state.stops_along


def stop_from(state: ArmState, point: SetPoint) -> None:
    """Plan the jerk-limited stop from `point`; brake if there is none."""
    if point is not state.set_point:
        state.set_point = point
        state.parts.servo.reset()
    plan = state.parts.tool.guard.stop_from if state.monitor.is_homed else state.parts.stop_from
    begin(state, plan(point), 1.0)
