"""One control cycle, call by call: read, measure, watch, plan, servo, write, record.

    cycle(now_s, late_s, missed, missed_in_row)
      _read            hardware.read(), then angles and speeds from counts, camera, averages
      _watch           limits, stale data, board faults, contradictions -> faults -> the state machine
      _advance         the mode's change of the set-point (hold, motion, jog, homing, stop, nothing)
      _aim             encoder set-points, on an arm whose gears or belt are known
      _drive           set-point -> feed-forward + PID -> hardware.write()
      _drive_end       gripper and digital outputs
      _record          one row

The runtime never waits and opens nothing: hardware, recorder and the rest are passed in (control.server.assemble). The
same object runs in its own process in real time and in a test on a stepped clock. Its state is ArmState; the
modes are in control.loop.set_points, motion_modes, homing, shutdown and fault_reactions.
"""

import contextlib
from collections.abc import Sequence

from control.end_effector.grip_state import State as GripperState
from control.errors import ArmError
from control.hardware.interface import Hardware, OutputMode
from control.loop import fault_reactions, homing, motion_modes, set_points, shutdown
from control.loop.arm_state import ArmState
from control.loop.jogging import JogRequest
from control.loop.parts import NOWHERE
from control.loop.row import row_of
from control.loop.watch import Expectation
from control.motion.pace import Limited
from control.motion.setpoint import Motion, SetPoint
from control.safety.fault import Fault, Reaction
from control.safety.table import Event, Mode
from firmware_iface.errors import AnotherHost, BoardReset, LinkError

# Feed-forward and PID share the weight: 1 kg at 0.75 m is 7 Nm, which the PID takes over in a second without being noticed.
PAYLOAD_RATE_kg_s = 1.0
RECORDING_LOOK_cycles = 50  # 0.1 s at 500 Hz; asking costs a system call
NO_GRIP_MODES = (Mode.OFF, Mode.BRAKED, Mode.FAULT)
TOOL_MODES = (
    Mode.OFF,
    Mode.BRAKED,
    Mode.HOLDING,
)  # in which nothing moves, so that the tip may be another one
UNRECORDED_STOPS = (Mode.MOVING, Mode.HOMING)
HOMING_CURRENT_FRACTION = 0.5  # during homing, and while joints without a zero are jogged


class Runtime(ArmState):
    """The arm under control. `cycle` is called every period; the requests are in control.server.requests."""

    # ---- the cycle

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
            if self.bridge is not None:
                motion_modes.take_up(self, self.bridge)
            self._watch(missed_in_row)
            self._follow_loads()
            self._advance()
            self._aim()
            self._drive()
            self._drive_end()
        except Exception as error:  # whatever fails here, the arm must not be left moving
            self._break_down(error)
        self._record(late_s)
        return not (self.is_quitting and shutdown.has_left(self))

    def _read(self) -> None:
        feedback = self.parts.hardware.feedback
        try:
            self.parts.hardware.read()
        finally:  # one board that fails does not hide where the others' joints are
            if self.parts.measurement.update(feedback.count, feedback.shift_count, feedback.counted_at_s):
                set_points.follow_shift(self)
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
            self.fail(fault)
        measured, watch = self.parts.measurement, self.parts.checks.watch
        # In every mode, and first: they are the cause of whatever else such a count looks like.
        if wrong := watch.miscounts(measured.leap_rad, measured.has_lost_turns, self.monitor.is_homed):
            for fault in wrong:
                self.fail(fault)
            return
        if self.monitor.mode is Mode.OFF:
            return
        aim, paused_s = self.aim, self.elapsed_s - self.parts.period_s
        q_set_rad: Sequence[float] = aim.q_rad
        if paused_s > 0.0:  # the boards have moved on with their last command
            q_set_rad = [q + paused_s * v for q, v in zip(aim.q_rad, aim.speed_rad_s, strict=True)]
        is_controlled = self.is_controlled()
        found = watch.look(
            self.now_s, self.parts.hardware.feedback, measured.q_rad, measured.speed_rad_s,
            q_set_rad, aim.speed_rad_s, missed_in_row if is_controlled else 0,
            # The arm is where its boards' stop brought it: following is expected from the next cycle on.
            Expectation(self.drives.is_ready, self.monitor.is_homed, is_controlled and self.bridge is None),
        )  # fmt: skip
        for fault in (*found, *self._contradictions()):
            self.fail(fault)

    def _contradictions(self) -> list[Fault]:
        """What the boards' values say against each other, while they are fresh and the drives are on."""
        parts, feedback, checks = self.parts, self.parts.hardware.feedback, self.parts.checks
        if not self.drives.is_ready:
            checks.motors.forget()
            checks.motor_counts.forget()
            return []
        faults = checks.motor_counts.look(feedback.motor_counts, parts.measurement.speed_rad_s)
        if self.monitor.reaction in (Reaction.HOLD, Reaction.BRAKE):
            checks.motors.forget()
            return [] if self.monitor.is_zero_doubted else faults  # the counts are all that is left to doubt
        if self.has_missed:
            checks.motors.forget_speeds()
        model_A = parts.servo.model_A
        faults += checks.motors.look(
            self.now_s, self.elapsed_s, feedback, parts.measurement.speed_rad_s, model_A
        )
        is_homed = self.monitor.is_homed
        parts.hardware.watch_indices(is_homed)
        passed = parts.hardware.passed_indices()
        if is_homed:
            faults += checks.indices.look(passed)
            faults += checks.switches.look(self.elapsed_s, parts.measurement.q_rad, feedback.channel_flags)
        return faults

    def _advance(self) -> None:
        mode = self.monitor.mode
        if mode in (Mode.MOVING, Mode.PAUSED, Mode.STOPPING) or self.monitor.is_held_fault:
            motion_modes.follow_motion(self)
        elif mode is Mode.JOGGING:
            motion_modes.follow_jog(self)
        elif mode is Mode.HOMING:
            homing.follow(self)
        elif mode is not Mode.HOLDING:
            set_points.stay(self)
            shutdown.follow_hold(self)
        if self.is_shutting_down:
            shutdown.follow(self)

    def _follow_loads(self) -> None:
        """Let the model's masses follow tool and payload as stated: at once while nothing depends on them, else slowly."""
        if self.monitor.mode in (Mode.OFF, Mode.BRAKED):
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
            fault = parts.gripper.cycle(
                self.now_s, self.drives.is_ready, mode is Mode.FAULT, mode is Mode.OFF
            )
            if fault is not None:
                self.fail(fault)
        if parts.outputs is not None:
            parts.outputs.cycle(self.now_s, mode in (Mode.OFF, Mode.FAULT) or not self.drives.is_ready)

    def _mode_without_control(self) -> OutputMode:
        """0 V, or the boards' own hold after a fault that leaves them their feedback."""
        return OutputMode.HOLD if self.monitor.reaction is Reaction.HOLD else OutputMode.VOLTAGE

    def _servo(self) -> None:
        measured, servo, set_point = self.parts.measurement, self.parts.servo, self.set_point
        fraction = HOMING_CURRENT_FRACTION if self.is_searching() else 1.0
        joints = None if self.aim is set_point else set_point
        servo.update(self.aim, measured.q_rad, measured.speed_rad_s, self.monitor.is_homed, fraction, joints)
        self.parts.hardware.write(servo.modes, servo.output, servo.feedforward_V)

    def _write_all(self, mode: OutputMode, output: Sequence[float]) -> None:
        """Command all joints in one mode, whatever their own is."""
        self.parts.hardware.write((mode,) * len(output), output, self.parts.servo.feedforward_V)

    def _watch_the_hand(self) -> None:
        """An arm that moves faster than a hand guides it falls, or is carried away: a fault."""
        speed_rad_s = self.parts.measurement.speed_rad_s
        if (fault := self.parts.gravity_compensation.too_fast(speed_rad_s, self.is_weightless)) is not None:
            self.fail(fault)

    def _carry(self) -> None:
        """Apply gravity compensation."""
        measured = self.parts.measurement
        amperes = self.parts.gravity_compensation.update(
            set_points.joints_standing(self, measured.q_rad), measured.speed_rad_s
        )
        self._write_all(OutputMode.CURRENT, amperes)

    def _record(self, late_s: float) -> None:
        self.parts.recorder.write(row_of(self, late_s))
        if self.cycles % RECORDING_LOOK_cycles == 0:
            self.unrecorded = self.parts.recorder.problem()
            if self.unrecorded and not self.parts.allows_unrecorded and self.monitor.mode in UNRECORDED_STOPS:
                self.stop()

    def require_recording(self) -> None:
        """ArmError if nothing is recorded now, and arm.toml says that no motion begins then."""
        if self.unrecorded and not self.parts.allows_unrecorded:
            raise ArmError(
                f"nothing is recorded ({self.unrecorded}), so no motion begins: make room on the disk, or set"
                ' [recording] unrecorded = "allow" in arm.toml; jogs and hand guiding are free'
            )

    def _break_down(self, error: Exception) -> None:
        """The cycle raised: fault, and the boards hold; where a link is gone, they do so by themselves."""
        is_first = self.monitor.mode is not Mode.FAULT
        if not (self.is_quitting and self.monitor.mode is Mode.OFF):
            self.fail(fault_reactions.fault_of(error))
        if isinstance(error, BoardReset):
            self.monitor.forget_home()  # `home` uses the zeros of boards that still have them
            self.parts.checks.motor_counts.forget()
        shutdown.follow(self)
        servo = self.parts.servo
        servo.silence()
        with contextlib.suppress(LinkError):
            self._write_all(self._mode_without_control(), servo.output)
        if isinstance(error, AnotherHost) and self.drives.is_ready and not is_first:
            self.parts.hardware.emergency_stop()  # else its commands and ours take turns at the motor

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

    # ---- requests

    def fail(self, fault: Fault) -> None:
        """Go to FAULT with the fault's reaction, and save the cycles before it."""
        fault_reactions.fail(self, fault)

    def acknowledge(self) -> tuple[Fault, ...]:
        """Acknowledge the faults on a person's request. Faulted drives are reset and enabled again at 0 V."""
        if self.parts.gripper is not None and self.parts.gripper.state is GripperState.FAILED:
            self.parts.gripper.recover()
            self.has_waited = True
            self.parts.hardware.reset_gripper()
        are_drives_faulted = any(self.parts.hardware.feedback.drive_faults)
        if are_drives_faulted or (self.monitor.mode is Mode.FAULT and not self.monitor.is_held_fault):
            self.has_waited = True
            try:
                self.parts.hardware.reset_drive_faults()
            except BoardReset:  # nobody saw it restart: it was silent
                self.monitor.forget_home()
                raise
            if self.monitor.mode is Mode.FAULT:
                self.drives.expect(self.now_s)
            else:
                self.drives.forget()
            if not self.monitor.faults:
                return ()  # drives that were in FAULT before this runtime started
        cleared = self.monitor.acknowledge()
        self.stillness.enter_mode(self.now_s)
        return cleared

    def want_hold(self) -> None:
        """Get to HOLDING from OFF, BRAKED or GUIDING, through the modes in between."""
        shutdown.want_hold(self)

    def go_off(self, quits: bool) -> None:
        """Start the shutdown: stop, hold, brake, off. The cycle continues it."""
        shutdown.begin(self, quits)

    def require_staying(self) -> None:
        """ArmError if the arm is being switched off: nothing begins then."""
        if self.is_shutting_down:
            raise ArmError(
                "the arm is being switched off, so nothing begins: wait until it is off, then enable it"
            )

    def state_payload(self, mass_kg: float) -> None:
        """State the mass in the gripper. ArmError if it is more than the arm may carry."""
        most_kg = self.parts.payload_limit_kg
        if not 0.0 <= mass_kg <= most_kg:
            raise ArmError(
                f"payload: expected mass_kg from 0 to {most_kg:g} kg ([limits] payload_limit_kg), got {mass_kg:g}"
            )
        self.stated_payload_kg = mass_kg
        self.parts.loads.state(self.parts.tool.tool, mass_kg)

    def change_tool(self, name: str) -> None:
        """Another tool is on: the tip, the masses and what the arm must not meet are its. ArmError if the arm is not at rest."""
        if name not in self.parts.tools:
            known = ", ".join(tool for tool in self.parts.tools if tool)
            raise ArmError(
                f"tool: no tool {name!r}: expected one of {known}"
                if known
                else f"tool: no tool {name!r}: arm.toml names none; add a [[tool]] for each, with a name"
            )
        if self.monitor.mode not in TOOL_MODES:
            raise ArmError(
                f"the arm is {self.monitor.mode.name}, so its tool cannot be changed: it must hold at rest, or be off"
            )
        self.parts = self.parts.with_tool(name)
        self.parts.loads.state(self.parts.tool.tool, self.stated_payload_kg)

    def take_known_zeros(self) -> bool:
        """Use the boards' zeros if all of them were set since power-up; return whether they were."""
        return homing.take_known_zeros(self)

    def start_homing(self) -> None:
        """Home every joint, one after the other. ArmError if arm.toml does not describe how."""
        self.require_staying()
        self.require_recording()
        homing.start(self)

    def start(self, motion: Motion, as_encoders: bool = False, beside: Sequence[Limited] = ()) -> None:
        """Start a checked motion that begins, at rest, at the arm's position `seen`; `beside`: others that keep its pace."""
        self.require_staying()
        self.require_recording()
        motion_modes.start(self, motion, as_encoders, beside)

    def jog(self, request: JogRequest) -> None:
        """Start, change or renew a jog; ArmError says why it is refused, and then nothing changes."""
        self.require_staying()
        motion_modes.jog(self, request)

    def renew_jog(self) -> None:
        """Renew the active jog; ArmError if there is none."""
        motion_modes.renew_jog(self)

    def pause(self) -> None:
        """Slow to rest along the motion's path and hold there."""
        self.on(Event.PAUSE)

    def resume(self) -> None:
        """Resume the motion."""
        self.require_recording()
        self.on(Event.RESUME)

    def stop(self, why: str = "") -> None:
        """Controlled stop, of the gripper, too; legal in every mode. `why`: for the client of the motion, if not by request."""
        if self.parts.gripper is not None:
            self.parts.gripper.stop()
        motion_modes.stop(self, why)

    def brake(self) -> None:
        """Short the windings now, without a controlled stop (see `stop`); the gripper stops and holds."""
        if self.parts.gripper is not None:
            self.parts.gripper.stop()
        motion_modes.brake(self)

    def grip(self, action: str, opening_m: float | None, force_N: float | None) -> None:
        """Open, close or move the gripper. ArmError says why not, and then nothing changes."""
        gripper = self.parts.gripper
        if gripper is None:
            raise ArmError("gripper: arm.toml describes none: add a [gripper]")
        if action == "stop":
            gripper.stop()
            return
        if self.monitor.mode in NO_GRIP_MODES or self.is_shutting_down:
            raise ArmError(
                f"the arm is {self.monitor.mode.name}, so the gripper does not move: the arm must hold, move or be guided"
            )
        gripper.ask(action, opening_m, force_N)

    def set_output(self, name: str, level: bool) -> None:
        """Set a digital output. ArmError says why not."""
        if self.parts.outputs is None:
            raise ArmError("digital: arm.toml names no pins: add a [[digital]]")
        self.parts.outputs.set(name, level)

    def guide(self, weightless: bool) -> None:
        """Start hand guiding: circuits open, so somebody must hold the arm; or `weightless`, with gravity compensation.

        A board that cannot open its circuit shorts the windings: its joint resists the hand. `weightless` needs a homed arm,
        and boards that take a current: ArmError if not.
        """
        self.monitor.require(Event.GUIDE)
        if weightless and OutputMode.CURRENT not in self.parts.hardware.offers:
            raise ArmError(
                "weightless hand guiding is not possible: not all of this arm's boards take a current as command"
                " (docs/boards.md): guide without it"
            )
        if weightless and not self.monitor.is_homed:
            raise ArmError("gravity compensation needs a homed arm: home it first (`armwright home`)")
        self.is_weightless = weightless
        self.on(Event.GUIDE)
        self.run_number += 1

    def joint_rad(self) -> tuple[set_points.Angles, set_points.Angles]:
        """Actual and set joint angles, corrected for the modelled effects between joints and encoders."""
        measured, wanted = set_points.joint_rad(self)
        return tuple(measured), wanted

    def seen(self, as_encoders: bool) -> SetPoint:
        """The present set-point, as joint angles or as encoder angles."""
        return set_points.seen(self, as_encoders)
