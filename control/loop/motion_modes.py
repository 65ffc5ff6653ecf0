"""Motions, pauses, jogs and stops: how they start, and how they change the set-point each cycle.

Writes `paced`, `jogging`, `run_number`, `was_stopped` and `stop_reason`, and ends a way to hold (`bound`); the set-point through
control.loop.set_points.
"""

from collections.abc import Sequence

from control.errors import ArmError
from control.hardware.board_stop import Bridge
from control.loop import set_points
from control.loop.arm_state import ArmState
from control.loop.fault_reactions import fail, lose_motion, refuse
from control.loop.jogging import JogRequest
from control.loop.set_points import begin, stop_along, stop_from
from control.motion.pace import Limited
from control.motion.setpoint import Lookout, Motion, SetPoint
from control.safety.modes import TRAVELLING_MODES, Event, Fault, Mode, Reaction

WORKSPACE_REMEDY = (
    "move or jog the arm away; [limits] and [table] of arm.toml say where floor, table and base are, cell.toml where other"
    " arms are"
)
# Members of an enumeration are slow to look up in Python 3.11, and each cycle asks for these.
_MOVING, _PAUSED = Mode.MOVING, Mode.PAUSED


def follow_motion(state: ArmState) -> None:
    """Advance the active motion, if any, by one cycle."""
    if state.paced is None:
        return
    try:
        wanted = state.paced.advance(state.elapsed_s, _wanted_pace(state))
        if state.monitor.mode in set_points.ON_PATH and not _is_clear_ahead(state, state.paced.time_s):
            return
    except Exception as error:  # the feedback is still good, so the arm can stop under control
        if state.stops_along:
            stop_from(state, state.set_point)
        else:
            lose_motion(state, error)
        return
    _take(state, wanted)
    if state.paced is not None and (state.paced.is_over or (state.stops_along and state.paced.pace == 0.0)):
        _come_to_rest(state, Event.ARRIVED if state.monitor.mode in set_points.ON_PATH else Event.STOPPED)


def _is_clear_ahead(state: ArmState, time_s: float) -> bool:
    """Whether nothing is met on the next part of the motion; else a controlled stop before it."""
    guard = state.parts.tool.guard
    for pose in () if state.lookout is None else state.lookout.poses(time_s):
        if objection := guard.fixed_objection(pose.q_rad, state.set_point.q_rad):
            _meet(state, objection)
            return False
    return True


def take_up(state: ArmState, bridge: Bridge) -> None:
    """After a pause of the host: go on from where, and as fast as, the boards' own stop has left the arm."""
    try:
        if state.jogging is not None:
            state.set_point = state.jogging.take_up(state.set_point, bridge)
        elif state.homing is not None:
            state.set_point = state.homing.take_up(state.set_point, bridge)
        elif state.paced is not None:
            state.set_point = state.paced.take_up(bridge.motion_s, bridge.speed_share)
            if state.monitor.mode not in set_points.ON_PATH and not state.stops_along:
                stop_from(state, state.set_point)
    except Exception as error:
        lose_motion(state, error)


def _wanted_pace(state: ArmState) -> float:
    mode = state.monitor.mode
    if mode is _PAUSED or state.stops_along:
        return 0.0
    return state.override if mode is _MOVING else 1.0


def follow_jog(state: ArmState) -> None:
    """Advance the jog by one cycle."""
    if state.jogging is None:
        return
    try:
        wanted = state.jogging.advance(state.now_s, state.elapsed_s, state.set_point)
    except Exception as error:
        lose_motion(state, error)
        return
    _take(state, wanted)
    if state.jogging is not None and state.jogging.is_over:
        _come_to_rest(state, Event.ARRIVED)


def _take(state: ArmState, wanted: SetPoint) -> None:
    if objection := set_points.objection(state, wanted):
        _meet(state, objection)
        return
    if (clip := set_points.take(state, wanted)) is not None:
        refuse(state, clip)


def _meet(state: ArmState, objection: str) -> None:
    what = f"it was stopped: {objection}"
    fail(state, Fault("workspace", "motion", what, WORKSPACE_REMEDY, Reaction.CONTROLLED))


def _come_to_rest(state: ArmState, event: Event) -> None:
    state.paced = state.jogging = None
    state.stops_along = False
    set_points.rest(state)
    state.on(event)


def start(state: ArmState, motion: Motion, as_encoders: bool, beside: Sequence[Limited] = ()) -> None:
    """Start a checked motion that begins, at rest, at the arm's position `seen`; `beside`: others that keep its pace."""
    state.on(Event.MOVE)
    state.set_point, state.is_of_encoders = set_points.seen(state, as_encoders), as_encoders
    state.run_number += 1
    state.was_stopped, state.stop_reason = False, ""
    begin(state, motion, state.override, beside)
    state.lookout = Lookout(motion)


def jog(state: ArmState, request: JogRequest) -> None:
    """Start, change or renew a jog; ArmError says why it is refused, and then nothing changes."""
    if state.jogging is not None and state.monitor.mode is Mode.JOGGING:
        state.jogging.ask(state.now_s, request, state.set_point)
        return
    state.monitor.require(Event.JOG)
    jogging = state.parts.tool.jogging(state.monitor.is_homed)
    jogging.ask(state.now_s, request, state.set_point)
    state.on(Event.JOG)
    state.run_number += 1
    state.was_stopped, state.stop_reason = False, ""
    state.jogging = jogging


def renew_jog(state: ArmState) -> None:
    """Renew the active jog; ArmError if there is none."""
    if state.jogging is None or state.monitor.mode is not Mode.JOGGING:
        raise ArmError(f"the arm is {state.monitor.mode.name}: no jog to renew")
    state.jogging.renew(state.now_s)


def stop(state: ArmState, why: str = "") -> None:
    """Controlled stop, of a motion on its path where that is soon enough; legal in every mode."""
    before = state.monitor.mode
    state.on(Event.STOP)
    state.end_way_to_hold()
    if state.monitor.mode is not before:
        state.stop_reason = why
    if state.monitor.mode is Mode.STOPPING and before is not Mode.STOPPING:
        state.was_stopped = True
        state.homing = state.jogging = None
        if before not in set_points.ON_PATH or not stop_along(state):
            stop_from(state, state.set_point)


def brake(state: ArmState) -> None:
    """Short the windings now, without a controlled stop (see `stop`)."""
    if state.monitor.mode in TRAVELLING_MODES or state.monitor.mode is Mode.STOPPING:
        remedy = "acknowledge when it is safe"
        fail(state, Fault("brake", "operator", "braked while moving", remedy, Reaction.BRAKE))
    else:
        state.on(Event.BRAKE)
    state.end_way_to_hold()
