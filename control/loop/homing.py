"""Establishes the arm's pose: from zeros that the boards still have, or by the homing sequence.

Writes `homing` and, when the pose becomes known, the set-point.
"""

from control.errors import ArmError
from control.hardware.interface import ZERO_SET
from control.loop import set_points
from control.loop.arm_state import ArmState
from control.loop.fault_reactions import fail
from control.loop.homing_sequence import HomingFailed
from control.motion.setpoint import at_rest
from control.safety.modes import Event, Fault, Reaction


def doubt(state: ArmState) -> str:
    """Why the pose that absolute encoders tell cannot be the arm's; empty if it can."""
    q_rad, flags = state.parts.measurement.q_rad, state.parts.hardware.feedback.channel_flags
    for turn in state.parts.unique_turns:
        if flags[turn.joint] & ZERO_SET and (why := turn.objection(q_rad[turn.joint])):
            return why
    return ""


def require_plausible(state: ArmState) -> None:
    """ArmError if absolute encoders tell of a pose that cannot be the arm's: nothing may be moved by it."""
    if why := doubt(state):
        raise ArmError(why)


def take_known_zeros(state: ArmState) -> bool:
    """Use the boards' zeros if all of them were set since power-up and none is doubted; return whether they were.

    A counter that can wrap within its joint's travel may have wrapped unobserved, so it is never used.
    """
    flags = state.parts.hardware.feedback.channel_flags
    is_doubted = state.monitor.is_zero_doubted or doubt(state)
    if is_doubted or not (state.parts.do_counters_span and all(flag & ZERO_SET for flag in flags)):
        return False
    _become_homed(state)
    return True


def _become_homed(state: ArmState) -> None:
    """The pose is known: the feed-forward takes over the weight from the integrals."""
    was_homed = state.monitor.is_homed
    state.parts.checks.indices.forget()
    state.on(Event.HOMED)
    if not was_homed:
        state.parts.servo.learn_pose()
        state.set_point = at_rest(set_points.joints_standing(state, state.set_point.q_rad))


def start(state: ArmState) -> None:
    """Home every joint, one after the other. ArmError if arm.toml does not describe how."""
    require_plausible(state)
    sequence = state.parts.homing()
    state.on(Event.HOME)
    state.set_point = at_rest(state.aim.q_rad)
    state.run_number += 1
    state.was_stopped, state.stop_reason = False, ""
    state.homing = sequence


def follow(state: ArmState) -> None:
    """One cycle of the homing sequence."""
    if state.homing is None:
        return
    feedback = state.parts.hardware.feedback
    try:
        state.set_point = state.homing.step(state.set_point, feedback, state.elapsed_s)
    except HomingFailed as error:
        fail(state, Fault("homing", error.where, error.message, error.remedy, Reaction.CONTROLLED))
        return
    if state.homing.is_done:
        state.homing = None
        _become_homed(state)
