"""The ways on and off that the arm takes by itself: from OFF, HELD, BRAKED or GUIDING to HOLDING, on the way to a known pose, and
from any mode to OFF.

On: the pose is known from zeros that the boards still have, or by the homing sequence. Off: stop, hold, brake, off; a step
whenever the arm is at rest. Writes `homing`, the set-point when the pose becomes known, and `bound`, in which the latest request
wins; what is wanted of the drives follows from it (control.loop.drives).
"""

from control.errors import ArmError
from control.hardware.interface import WATCHDOG, ZERO_SET, Wanted
from control.loop import set_points
from control.loop.arm_state import ArmState
from control.loop.drives import CHANGE_LIMIT_S, Bound
from control.loop.fault_reactions import fail
from control.loop.homing_sequence import HomingFailed
from control.loop.motion_modes import stop
from control.motion.setpoint import at_rest
from control.safety.modes import CONTROLLED_MODES, Event, Fault, Mode, Reaction


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


def start_homing(state: ArmState) -> None:
    """Home every joint, one after the other. ArmError if arm.toml does not describe how."""
    require_plausible(state)
    sequence = state.parts.homing()
    state.on(Event.HOME)
    state.set_point = at_rest(state.aim.q_rad)
    state.run_number += 1
    state.was_stopped, state.stop_reason = False, ""
    state.homing = sequence


def follow_homing(state: ArmState) -> None:
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


HELD = "the arm is held by its boards"
TAKES_OVER = "`armwright enable` takes it over"
LETS_GO = " `armwright off`, which lets the arm go, and"


def begin_off(state: ArmState, quits: bool, lets_go: bool) -> None:
    """Start the shutdown: stop, hold, brake, off. The cycle continues it. An end of the runtime is not taken back.

    Boards that hold the arm as they were found let it go only with `lets_go`; without, the end of the runtime leaves them so.
    ArmError if they would have to.
    """
    is_ending = quits or state.bound is Bound.QUIT
    if is_left_held(state):
        if not (lets_go or quits):
            raise ArmError(
                f"{HELD}, and falls when they let go: somebody must hold it, then `armwright off` lets it go (socket: `lets_go`);"
                f" {TAKES_OVER}"
            )
        if lets_go:
            state.on(Event.SWITCH_OFF)
    state.end_way_to_hold()
    state.bound = Bound.QUIT if is_ending else Bound.OFF
    if state.monitor.mode is Mode.OFF and not is_ending:
        state.bound = Bound.NOWHERE


def follow_off(state: ArmState) -> None:
    """Take the next step of the shutdown when the arm is ready for it."""
    if not state.bound.is_off or is_left_held(state):
        return
    if (event := state.monitor.next_towards_off(state.is_still())) is None:
        return
    if event is Event.STOP:
        stop(state)
        return
    state.on(event)
    if state.monitor.mode is Mode.OFF and state.bound is Bound.OFF:
        state.bound = Bound.NOWHERE


def is_left_held(state: ArmState) -> bool:
    """Whether the arm is held by its boards, of which this runtime has begun to take over none."""
    return state.monitor.mode in (Mode.HELD, Mode.FAULT) and state.drives.wanted is Wanted.AS_FOUND


def has_left(state: ArmState) -> bool:
    """Whether the runtime may end: the arm is off and its drives have confirmed it, or had time to; or it is left held."""
    if is_left_held(state):
        return True
    if state.monitor.mode is not Mode.OFF:
        return False
    has_waited_long = state.now_s - state.stillness.mode_from_s > CHANGE_LIMIT_S
    return has_waited_long or not state.parts.hardware.has_torque()


def require_staying(state: ArmState) -> None:
    """ArmError while the arm goes on or off by itself: nothing else begins then."""
    if state.bound.is_off:
        raise ArmError("the arm is being switched off, so nothing begins: wait until it is off, then enable it")
    if state.bound.is_hold:
        raise ArmError(f"the arm is being {state.bound.value}, so nothing begins: wait until it holds")


def want_hold(state: ArmState) -> None:
    """Get to HOLDING from OFF, HELD, BRAKED or GUIDING. ArmError if the mode or the drives do not allow it."""
    mode = state.monitor.mode
    if state.bound is Bound.QUIT or (state.bound is Bound.OFF and mode in CONTROLLED_MODES):
        require_staying(state)
    if mode not in (Mode.OFF, Mode.HELD, Mode.BRAKED, Mode.GUIDING):
        state.monitor.require(Event.ENABLE)  # raises the reason
    if mode in (Mode.OFF, Mode.HELD) or not state.drives.is_ready:
        state.monitor.require_no_faults("ENABLE")
        require_plausible(state)
        _prepare(state)
    if mode is Mode.OFF:
        state.on(Event.CONNECT)
    elif mode is Mode.GUIDING:
        state.on(Event.BRAKE)
    elif mode is Mode.HELD:
        state.drives.take_over(state.now_s)
    is_from_off = mode in (Mode.OFF, Mode.HELD) or state.bound is Bound.ON
    state.bound = Bound.ON if is_from_off else Bound.HOLD


def _prepare(state: ArmState) -> None:
    """Let the boards have all that they need. Those that hold after the time-out of another host are taken out of it.

    ArmError if a drive is in FAULT otherwise.
    """
    hardware, is_held = state.parts.hardware, state.monitor.mode is Mode.HELD
    bits_of = hardware.feedback.drive_faults
    expected = (0, WATCHDOG) if is_held else (0,)
    if any(bits not in expected for bits in bits_of):
        names = zip(state.parts.joint_names, bits_of, strict=True)
        raise ArmError(
            f"the drive of {', '.join(name for name, bits in names if bits not in expected)} is in FAULT: make the arm safe, then"
            f"{LETS_GO if is_held else ''} `armwright acknowledge`, which resets it: what it holds may sink"
        )
    state.has_waited = True
    if any(bits_of):
        hardware.reset_drive_faults()
    hardware.prepare()


def follow_hold(state: ArmState) -> None:
    """Take the next step towards HOLDING if it is wanted and the drives are ready. A take-over gets there on its way off, too."""
    if not state.drives.is_ready:
        return
    is_taken_over = state.monitor.mode is Mode.HELD
    if is_taken_over or (state.monitor.mode is Mode.BRAKED and state.bound.is_hold):
        if is_taken_over or state.bound is Bound.ON:
            take_known_zeros(state)
        if not state.bound.is_off:
            state.bound = Bound.NOWHERE
        state.parts.servo.reset()
        state.on(Event.ENABLE)
