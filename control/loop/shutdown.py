"""Shutdown from any mode to OFF (stop, hold, brake, off; a step whenever the arm is at rest), and from OFF back to HOLDING.

Writes `is_shutting_down`, `is_quitting` and `is_hold_pending`.
"""

from control.loop.arm_state import ArmState
from control.loop.homing import require_plausible, take_known_zeros
from control.loop.motion_modes import stop
from control.loop.readiness import ENABLE_LIMIT_S, is_any_enabled
from control.safety.table import Event, Mode


def begin(state: ArmState, quits: bool) -> None:
    """Start the shutdown: stop, hold, brake, off. The cycle continues it."""
    state.is_shutting_down = True
    state.is_hold_pending = False
    state.is_quitting = state.is_quitting or quits


def follow(state: ArmState) -> None:
    """Take the next step of the shutdown when the arm is ready for it."""
    if not state.is_shutting_down or (event := state.monitor.next_towards_off(state.is_still())) is None:
        return
    if event is Event.STOP:
        stop(state)
        return
    state.on(event)
    if state.monitor.mode is Mode.OFF:
        state.is_shutting_down = False
        state.drives.forget()
        state.parts.hardware.disable()


def has_left(state: ArmState) -> bool:
    """Whether the arm is off and its drives have confirmed it or have had enough time to."""
    if state.monitor.mode is not Mode.OFF:
        return False
    has_waited_long = state.now_s - state.stillness.mode_from_s > ENABLE_LIMIT_S
    return has_waited_long or not is_any_enabled(state.parts.hardware.feedback)


def want_hold(state: ArmState) -> None:
    """Get to HOLDING from OFF, BRAKED or GUIDING, through the modes in between."""
    if state.monitor.mode is Mode.OFF:
        state.monitor.require_no_faults("ENABLE")
        require_plausible(state)
        state.has_waited = True
        state.parts.hardware.enable()
        state.drives.expect(state.now_s)
    elif state.monitor.mode is Mode.GUIDING:
        state.on(Event.BRAKE)
    elif state.monitor.mode is not Mode.BRAKED:
        state.monitor.on(Event.ENABLE)  # raises the reason
    state.is_shutting_down = False
    state.is_hold_pending = True


def follow_hold(state: ArmState) -> None:
    """Take the next step towards HOLDING if it is requested and the drives are ready."""
    if not (state.is_hold_pending and state.drives.is_ready):
        return
    if state.monitor.mode is Mode.OFF:
        state.on(Event.CONNECT)
        take_known_zeros(state)
    elif state.monitor.mode is Mode.BRAKED:
        state.is_hold_pending = False
        state.parts.servo.reset()
        state.on(Event.ENABLE)
