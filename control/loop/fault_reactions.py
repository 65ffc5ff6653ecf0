"""Reactions to a fault: a controlled stop or braking, and saving the cycles before it.

Writes `fault_rows`, and ends motions and averages: `paced`, `jogging`, `homing`, `averaging`, `was_stopped`,
`bound`.
"""

from dataclasses import replace
from typing import Final

from control.errors import ArmError
from control.loop import set_points
from control.loop.arm_state import ArmState
from control.loop.set_points import stop_along, stop_from
from control.safety.limits import Clip
from control.safety.modes import TRAVELLING_MODES, Fault, Mode, Reaction
from firmware_iface.errors import LinkError

# The arm does not get to its set-point: a stop from there would push on what holds it back.
_RESISTED: Final = frozenset({"following_error", "unexplained_torque"})
_LEFT_THE_PATH: Final = "set_point_limit"


def fail(state: ArmState, fault: Fault) -> None:
    """Go to FAULT with the fault's reaction, and save the cycles before it."""
    monitor = state.monitor
    was_let_go, was_on_path = _is_let_go(state), monitor.mode in set_points.ON_PATH or state.stops_along
    is_first = monitor.mode is not Mode.FAULT
    monitor.fault(_sharpened(state, fault))
    if is_first:
        state.stillness.enter_mode(state.now_s)
        state.fault_rows = state.parts.recorder.last_rows()
        state.homing = state.jogging = None
        state.averaging = None  # counts from before and after a fault have no mean
    state.end_way_to_hold()
    state.was_stopped = True
    if monitor.is_held_fault and is_first:
        _stop(state, fault.code, was_on_path)
    elif not was_let_go and _is_let_go(state):
        state.paced = None


def _stop(state: ArmState, code: str, was_on_path: bool) -> None:
    """The controlled stop after a fault: on the path of the motion, where the arm is on it."""
    if code in _RESISTED:
        stop_from(state, set_points.measured(state))
    elif code == _LEFT_THE_PATH or not (was_on_path and stop_along(state)):
        stop_from(state, state.set_point)


def _is_let_go(state: ArmState) -> bool:
    """Whether the loop has left the arm to its boards, or to the shorted windings."""
    return state.monitor.reaction in (Reaction.HOLD, Reaction.BRAKE)


def _sharpened(state: ArmState, fault: Fault) -> Fault:
    """Escalate to braking if the arm does not even follow the stop."""
    is_stop_lost = fault.code == "following_error" and state.monitor.is_held_fault and state.now_s > state.stillness.mode_from_s
    return replace(fault, reaction=Reaction.BRAKE) if is_stop_lost else fault


def lose_motion(state: ArmState, error: Exception) -> None:
    """The motion raised instead of giving a set-point: controlled stop, or brake if it was the stop itself."""
    is_stop = state.monitor.mode not in TRAVELLING_MODES
    fault = Fault(
        "motion",
        "motion",
        f"it could not continue: {_text_of(error)}",
        "plan it again; if it was planned for this arm, report it with the recording of this run",
        Reaction.BRAKE if is_stop else Reaction.CONTROLLED,
    )
    fail(state, fault)


def refuse(state: ArmState, clip: Clip) -> None:
    """A motion exceeded a limit and was clipped: controlled stop."""
    fault = Fault(
        "set_point_limit",
        state.parts.joint_names[clip.joint - 1],
        f"the motion exceeds a limit: {clip}",
        "plan the motion again with this arm.toml",
        Reaction.CONTROLLED,
    )
    fail(state, fault)


def fault_of(error: Exception) -> Fault:
    """The fault for an exception that was raised within a cycle."""
    if isinstance(error, LinkError):
        return link_fault(str(error))
    remedy = "report it with the recording of this run"
    return Fault("internal", "control loop", _text_of(error), remedy, Reaction.HOLD)


def link_fault(why: str) -> Fault:
    """The fault of a port, a bus, or a board on it."""
    return Fault("link", "links", why, "check cables and supply", Reaction.HOLD)


def _text_of(error: Exception) -> str:
    return str(error) if isinstance(error, ArmError) else f"{type(error).__name__}: {error}"
