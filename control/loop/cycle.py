"""One control cycle, call by call: read, measure, watch, plan, servo, write, record.

    cycle(now_s, late_s, missed, missed_in_row)
      _read            hardware.read(), then angles and speeds from counts, camera, averages
      _watch           limits, stale data, board faults, contradictions -> faults -> the state machine
      _advance         the mode's change of the set-point (hold, motion, jog, homing, stop, nothing)
      _aim             encoder set-points, on an arm whose gears or belt are known
      _drive           set-point -> feed-forward + PID -> hardware.write()
      _drive_end       gripper and digital outputs
      _record          one row

The cycle never waits and opens nothing: hardware, recorder and the rest are passed in (control.server.assemble). The
same object runs in its own process in real time and in a test on a stepped clock. Its state is ArmState; the
modes are in control.loop.set_points, motion_modes, on_and_off and fault_reactions.
"""

import contextlib
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from control.end_effector import GripState
from control.hardware.interface import Hardware, OutputMode, Wanted
from control.loop import fault_reactions, motion_modes, on_and_off, set_points
from control.loop.arm_state import NOWHERE, ArmState
from control.loop.drives import Bound, drives_wanted
from control.loop.watch import Expectation
from control.recording.record import COUNT_MOST
from control.safety.modes import Event, Fault, Mode, Reaction
from firmware_iface.errors import AnotherHost, BoardReset, LinkError

# Feed-forward and PID share the weight: 1 kg at 0.75 m is 7 Nm, which the PID takes over in a second without being noticed.
PAYLOAD_RATE_kg_s = 1.0
RECORDING_LOOK_cycles = 50  # 0.1 s at 500 Hz; asking costs a system call
NO_PINS: Mapping[str, bool | None] = MappingProxyType({})
UNRECORDED_STOPS = (Mode.MOVING, Mode.HOMING)
UNWATCHED = frozenset({Mode.OFF, Mode.HELD})  # nothing is commanded, so nothing is compared with it
UNLOADED = UNWATCHED | {Mode.BRAKED}  # nothing depends on the model's masses
MOTION_MODES = frozenset({Mode.MOVING, Mode.PAUSED, Mode.STOPPING})
BY_BOARDS = (Reaction.HOLD, Reaction.BRAKE)
OPEN_MODES = frozenset({Mode.GUIDING, Mode.OFF})  # whose voltages are no commands
HOMING_CURRENT_FRACTION = 0.5  # during homing, and while joints without a zero are jogged


class Cycle(ArmState):
    """The arm under control: `cycle` is called every period. What clients ask of it is in control.loop.runtime."""

    @property
    def period_s(self) -> float:
        """Period of the loop."""
        return self.parts.period_s

    @property
    def hardware(self) -> Hardware:
        """The arm's boards."""
        return self.parts.hardware

    def attend(self, until_s: float) -> None:
        """Wait until then, and serve boards that must be asked."""
        self.parts.hardware.attend(until_s)

    def cycle(self, now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
        """Run one control cycle that began at `now_s`; False once a requested shutdown is complete."""
        self.now_s = now_s
        self.cycles += 1
        self.elapsed_s = (1 + missed) * self.parts.period_s
        self.bridge = self.parts.board_stop.bridge(self.elapsed_s) if missed else None
        if self.bridge is not None:
            self.elapsed_s = self.parts.period_s
        self.punctuality.begin(late_s, missed)
        self.has_missed = missed > 0
        if missed:
            self.parts.checks.watch.note_pause(now_s, missed * self.parts.period_s)
        try:
            self._read()
            if gone := self.parts.hardware.gone:
                self._leave_to_boards(fault_reactions.link_fault(gone))
            else:
                self._control(missed_in_row)
        except Exception as error:  # whatever fails here, the arm must not be left moving
            self._break_down(error)
        self._record(late_s)
        return not (self.bound.is_off and self.bound is Bound.QUIT and on_and_off.has_left(self))

    def _control(self, missed_in_row: int) -> None:
        if self.bridge is not None:
            motion_modes.take_up(self, self.bridge)
        self._watch(missed_in_row)
        self._follow_loads()
        self._advance()
        self._aim()
        self._drive()
        self._drive_end()

    def _read(self) -> None:
        feedback = self.parts.hardware.feedback
        try:
            self.parts.hardware.read()
        finally:  # one board that fails does not hide where the others' joints are
            if self.parts.measurement.update(feedback.count, feedback.shift_count, feedback.counted_at_s, feedback.count_late_s):
                set_points.follow_shift(self)
            if self.parts.checks.limit_switches.are_there:
                self.parts.checks.limit_switches.mark_homes(self._levels(), feedback.channel_flags)
            if self.parts.second_encoders:
                self.parts.motor_leads.update(feedback.motor_counts, self.parts.measurement.q_rad)
        camera = self.parts.camera
        seen = None if camera is None else camera.newest()
        is_in_base = camera is not None and not camera.has_own_frame
        self.new_camera_m = seen[0] if seen is not None and is_in_base else NOWHERE
        if self.new_camera_m is not NOWHERE:
            self.camera_m, self.camera_at_s = self.new_camera_m, self.now_s
        if self.averaging is not None:
            self.averaging.add(self.now_s, self.parts.measurement, feedback.current_A, seen, is_in_base)

    def _watch(self, missed_in_row: int) -> None:
        for fault in self.drives.follow(self.now_s, self.parts.hardware.feedback):
            # A runtime on its way out would otherwise go from OFF to FAULT and back, and never leave.
            if not (self.bound is Bound.QUIT and self.monitor.mode is Mode.OFF):
                self.fail(fault)
        measured, watch = self.parts.measurement, self.parts.checks.watch
        # In every mode, and first: they are the cause of whatever else such a count looks like.
        if wrong := watch.miscounts(measured.leap_rad, measured.has_lost_turns, self.monitor.is_homed):
            for fault in wrong:
                self.fail(fault)
            return
        if self.monitor.mode in UNWATCHED:
            if on_and_off.is_left_held(self) and not self.parts.hardware.has_torque():
                self.on(Event.RELEASED)
            return
        aim, paused_s = self.aim, self.elapsed_s - self.parts.period_s
        if paused_s > 0.0:  # the boards have moved on with their last command
            aim = aim._replace(q_rad=tuple(q + paused_s * v for q, v in zip(aim.q_rad, aim.speed_rad_s, strict=True)))
        is_controlled = self.is_controlled()
        faults = watch.look(
            self.now_s,
            self.parts.hardware.feedback,
            measured,
            aim,
            missed_in_row if is_controlled else 0,
            # The arm is where its boards' stop brought it: following is expected from the next cycle on.
            Expectation(self.drives.is_ready, self.monitor.is_homed, is_controlled and self.bridge is None),
        )
        for fault in (*faults, *self._contradictions(), *self._at_limit_switches()):
            self.fail(fault)

    def _at_limit_switches(self) -> list[Fault]:
        """What is about to move past the end of its range."""
        watch = self.parts.checks.limit_switches
        if not watch.are_there:
            return []
        if not self.is_controlled():
            watch.forget()
            return []
        flags, is_homing = self.parts.hardware.feedback.channel_flags, self.monitor.mode is Mode.HOMING
        q_rad, speed_rad_s = self.parts.measurement.q_rad, self.set_point.speed_rad_s
        return watch.look(self._levels(), flags, q_rad, speed_rad_s, is_homing)

    def _levels(self) -> Mapping[str, bool | None]:
        """At the named pins of the boards."""
        return NO_PINS if self.parts.outputs is None else self.parts.outputs.levels

    def _contradictions(self) -> list[Fault]:
        """What the boards' values say against each other, while they are fresh and the drives are on."""
        parts, feedback, checks = self.parts, self.parts.hardware.feedback, self.parts.checks
        if not self.drives.is_ready:
            checks.motors.forget()
            self._forget_turns()
            return []
        faults = checks.motor_counts.look(feedback.motor_counts, parts.measurement.speed_rad_s)
        if parts.second_encoders:
            faults += checks.leads.look(parts.motor_leads.lead_rad, parts.measurement.speed_rad_s)
        if self.monitor.reaction in BY_BOARDS:
            checks.motors.forget()
            return [] if self.monitor.is_zero_doubted else faults  # the counts are all that is left to doubt
        if self.has_missed:
            checks.motors.forget_speeds()
        model_A = parts.servo.model_A
        faults += checks.motors.look(self.now_s, self.elapsed_s, feedback, parts.measurement.speed_rad_s, model_A)
        is_homed = self.monitor.is_homed
        parts.hardware.watch_indices(is_homed)
        passed = parts.hardware.passed_indices()
        if is_homed:
            faults += checks.indices.look(passed)
            faults += checks.switches.look(self.elapsed_s, parts.measurement.q_rad, feedback.channel_flags)
        return faults

    def _forget_turns(self) -> None:
        """How far motors and joints have turned: a board was off."""
        self.parts.checks.motor_counts.forget()
        self.parts.checks.leads.forget()
        self.parts.motor_leads.forget()

    def _advance(self) -> None:
        mode = self.monitor.mode
        if mode in MOTION_MODES or self.monitor.is_held_fault:
            motion_modes.follow_motion(self)
        elif mode is Mode.JOGGING:
            motion_modes.follow_jog(self)
        elif mode is Mode.HOMING:
            on_and_off.follow_homing(self)
        elif mode is not Mode.HOLDING:
            set_points.stay(self)
            on_and_off.follow_hold(self)
        on_and_off.follow_off(self)

    def _follow_loads(self) -> None:
        """Let the model's masses follow tool and payload as stated: at once while nothing depends on them, else slowly."""
        if self.monitor.mode in UNLOADED:
            self.parts.loads.take_at_once()
        else:
            self.parts.loads.follow(PAYLOAD_RATE_kg_s * self.elapsed_s)

    def _aim(self) -> None:
        if (clip := set_points.aim(self)) is not None:
            fault_reactions.refuse(self, clip)

    def _drive(self) -> None:
        if self.is_controlled():
            self._servo()
            return
        servo = self.parts.servo
        servo.silence()
        if self.monitor.mode is Mode.GUIDING:
            self._watch_the_hand()
        if self.monitor.mode is Mode.GUIDING and self.is_weightless:
            self._carry()
            return
        is_free = self.monitor.mode is Mode.GUIDING
        self._write_all(OutputMode.OFF if is_free else self._mode_without_control(), servo.output)

    def _drive_end(self) -> None:
        """Gripper and outputs: they follow the drives on and off, and a fault of the arm."""
        parts, mode = self.parts, self.monitor.mode
        if parts.gripper is not None:
            fault = parts.gripper.cycle(self.now_s, self.drives.is_ready, mode is Mode.FAULT, mode in (Mode.OFF, Mode.HELD))
            if fault is not None:
                self.fail(fault)
        if parts.outputs is not None and self.drives.wanted is not Wanted.AS_FOUND:
            parts.outputs.cycle(self.now_s, mode in (Mode.OFF, Mode.FAULT) or not self.drives.is_ready)

    def _mode_without_control(self) -> OutputMode:
        """0 V; or the boards' own hold, after a fault that leaves them their feedback, and while they hold already."""
        is_held = self.monitor.reaction is Reaction.HOLD or self.monitor.mode is Mode.HELD
        return OutputMode.HOLD if is_held else OutputMode.VOLTAGE

    def _servo(self) -> None:
        measured, servo, set_point = self.parts.measurement, self.parts.servo, self.set_point
        fraction = HOMING_CURRENT_FRACTION if self.is_searching() else 1.0
        joints = None if self.aim is set_point else set_point
        servo.update(self.aim, measured, self.monitor.is_homed, fraction, joints)
        self._command(servo.modes, servo.output)

    def _write_all(self, mode: OutputMode, output: Sequence[float]) -> None:
        """Command all joints in one mode, whatever their own is."""
        self._command((mode,) * len(output), output)

    def _command(self, modes: Sequence[OutputMode], output: Sequence[float]) -> None:
        """The only place that commands the drives: what is wanted of them by the mode, and what those in operation do."""
        drives = self.drives
        wanted = drives_wanted(self.monitor.mode, self.bound, drives.wanted, drives.is_taken_over)
        wanted = drives.want(self.now_s, wanted)
        self.parts.hardware.write(wanted, modes, output, self.parts.servo.feedforward_V)

    def _watch_the_hand(self) -> None:
        """An arm that moves faster than a hand guides it falls, or is carried away: a fault."""
        speed_rad_s = self.parts.measurement.speed_rad_s
        if (fault := self.parts.gravity_compensation.too_fast(speed_rad_s, self.is_weightless)) is not None:
            self.fail(fault)

    def _carry(self) -> None:
        """Apply gravity compensation."""
        measured = self.parts.measurement
        amperes = self.parts.gravity_compensation.update(set_points.joints_standing(self, measured.q_rad), measured.speed_rad_s)
        self._write_all(OutputMode.CURRENT, amperes)

    def _record(self, late_s: float) -> None:
        self.parts.recorder.write(row_of(self, late_s))
        if self.cycles % RECORDING_LOOK_cycles == 0:
            self.unrecorded = self.parts.recorder.problem()
            if self.unrecorded and not self.parts.allows_unrecorded and self.monitor.mode in UNRECORDED_STOPS:
                self.stop()

    def _break_down(self, error: Exception) -> None:
        """The cycle raised: fault, and the boards hold."""
        is_first = self.monitor.mode is not Mode.FAULT
        self._leave_to_boards(fault_reactions.fault_of(error))
        if isinstance(error, BoardReset):
            self.monitor.forget_home()  # `home` uses the zeros of boards that still have them
            self._forget_turns()
        if isinstance(error, AnotherHost) and self.drives.is_ready and not is_first:
            self.parts.hardware.emergency_stop()  # else its commands and ours take turns at the motor

    def _leave_to_boards(self, fault: Fault) -> None:
        """Nothing is to be controlled in this cycle: the boards hold; where a link is gone, they do so by themselves."""
        if not (self.bound is Bound.QUIT and self.monitor.mode is Mode.OFF):
            self.fail(fault)
        on_and_off.follow_off(self)
        servo = self.parts.servo
        servo.silence()
        with contextlib.suppress(LinkError):
            self._write_all(self._mode_without_control(), servo.output)

    def ended_wait(self, now_s: float) -> bool:
        """Whether the loop has waited for boards since its last cycle; what was not read meanwhile has not aged."""
        if not self.has_waited:
            return False
        self.has_waited = False
        self.note_wait(now_s)
        return True

    def note_wait(self, now_s: float) -> None:
        """The loop has waited for boards since its last cycle, of this arm or of another one."""
        self.parts.checks.watch.note_wait(now_s, now_s - self.now_s)

    # ---- what the cycle asks for itself

    def fail(self, fault: Fault) -> None:
        """Go to FAULT with the fault's reaction, and save the cycles before it."""
        fault_reactions.fail(self, fault)

    def stop(self, why: str = "") -> None:
        """Controlled stop, of the gripper, too; legal in every mode. `why`: for the client of the motion, if not by request."""
        if self.parts.gripper is not None:
            self.parts.gripper.stop()
        motion_modes.stop(self, why)


GRIPPER_STATE_NUMBER = {state: number for number, state in enumerate(GripState)}
MODE_NUMBER = {mode: number for number, mode in enumerate(Mode)}  # as recorded


def row_of(state: ArmState, late_s: float) -> list[float]:
    """The values of the cycle that is about to end and began `late_s` after its deadline."""
    feedback, measured, volts = (state.parts.hardware.feedback, state.parts.measurement, state.parts.servo.volts)
    mode, aim, lead_rad = state.monitor.mode, state.aim, state.parts.motor_leads.lead_rad
    page_faults, switches = state.punctuality.strain()
    age_s = state.now_s - feedback.encoder_at_s
    row = [
        state.now_s,
        state.cycles & 0xFFFFFFFF,
        state.run_number,
        MODE_NUMBER[mode],
        state.punctuality.missed,
        late_s,
        state.punctuality.end(),
        min(page_faults, COUNT_MOST),
        min(switches, COUNT_MOST),
        age_s if age_s < math.inf else math.nan,
        state.stated_payload_kg,
        *state.new_camera_m,
    ]
    joints = set_points.joint_rad(state) if state.parts.joint_side is not None else None
    is_open = mode in OPEN_MODES
    for joint in range(feedback.joint_count):
        row += (
            measured.q_rad[joint],
            aim.q_rad[joint],
            measured.speed_rad_s[joint],
            aim.speed_rad_s[joint],
            feedback.count[joint],
            math.nan if is_open else volts[joint],
            feedback.current_A[joint],
            feedback.supply_V[joint],
            feedback.temperature_C[joint],
            feedback.statusword[joint],
            feedback.drive_faults[joint],
            feedback.channel_flags[joint],
            feedback.counted_at_s[joint],
        )
        if joints is not None:
            row += (joints[0][joint], joints[1][joint])
    row += [lead_rad[joint] for joint in state.parts.second_encoders]
    return row + _end_of(state)


def _end_of(state: ArmState) -> list[float]:
    """The columns of control.recording.record: what is at the end of the arm."""
    parts = state.parts
    row: list[float] = [list(parts.tools).index(parts.tool.tool.name)] if len(parts.tools) > 1 else []
    if (gripper := parts.gripper) is not None:
        goal_m = gripper.goal.opening_m if gripper.goal is not None else None
        row += [
            math.nan if gripper.opening_m is None else gripper.opening_m,
            math.nan if goal_m is None else goal_m,
            gripper.feedback.current_A,
            GRIPPER_STATE_NUMBER[gripper.state],
        ]
    if parts.outputs is not None:
        row.append(sum(1 << bit for bit, level in enumerate(parts.outputs.levels.values()) if level))
    return row
