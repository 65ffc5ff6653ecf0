"""One control cycle, call by call: read, measure, watch, plan, servo, write, record.

    cycle(now_s, late_s, missed, missed_in_row)
      _read            hardware.read(), then angles and speeds from counts, camera, averages
      _watch           limits, stale data, board faults -> faults -> the state machine
      _advance         what the present mode does to the set-point (hold, motion, jog, homing, stop, nothing)
      _aim             where the encoders have to be for it, on an arm whose gears or belt are known
      _drive           set-point -> feed-forward + PID -> hardware.write()
      _record          one row

The runtime never waits and opens nothing: a hardware, a recorder and the rest are handed to it (control.server.assemble). The
same object runs in a process of its own in real time and inside a test on a stepped clock. What it knows is ArmState; what the
modes do is in control.loop.set_points, motion_modes, homing, shutdown and fault_reactions.
"""

from control.errors import ArmError
from control.hardware.interface import OutputMode
from control.loop import fault_reactions, homing, motion_modes, set_points, shutdown
from control.loop.arm_state import ArmState
from control.loop.jogging import JogRequest
from control.loop.parts import NOWHERE
from control.loop.row import row_of
from control.loop.watch import Expectation
from control.motion.setpoint import Motion, SetPoint
from control.safety.fault import Fault
from control.safety.table import Event, Mode
from firmware_iface.errors import BoardReset, LinkError

HOMING_CURRENT_FRACTION = 0.5  # in search of the zero, and while joints without one are jogged


class Runtime(ArmState):
    """The arm under control. `cycle` is called every period; the requests are in control.server.requests."""

    # ---- the cycle

    def cycle(self, now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
        """One control cycle that began at `now_s`; False when the runtime was told to end and the drives are off."""
        self.now_s = now_s
        self.cycles += 1
        self.elapsed_s = (1 + missed) * self.parts.period_s
        self.punctuality.begin(late_s, missed)
        if missed:
            self.parts.watch.note_pause(now_s)
        try:
            self._read()
            self._watch(missed_in_row)
            self._advance()
            self._aim()
            self._drive()
        except Exception as error:  # whatever breaks here, the arm must not be left moving
            self._break_down(error)
        self._record(late_s)
        return not (self.is_quitting and shutdown.has_left(self))

    def _read(self) -> None:
        feedback = self.parts.hardware.read()
        if self.parts.measurement.update(feedback.count, feedback.shift_count, feedback.counted_at_s):
            set_points.follow_shift(self)
        self.new_camera_m = NOWHERE
        if self.parts.camera is not None and (tip := self.parts.camera.newest_tip_m()) is not None:
            self.new_camera_m = self.camera_m = tip
            self.camera_at_s = self.now_s
        if self.averaging is not None:
            seen = None if self.new_camera_m is NOWHERE else self.new_camera_m
            self.averaging.add(self.now_s, self.parts.measurement, feedback.current_A, seen)

    def _watch(self, missed_in_row: int) -> None:
        for fault in self.drives.follow(self.now_s, self.parts.hardware.feedback):
            self.fail(fault)
        if self.monitor.mode is Mode.OFF:
            return
        measured = self.parts.measurement
        found = self.parts.watch.look(
            self.now_s, self.parts.hardware.feedback, measured.q_rad, measured.speed_rad_s,
            self.aim.q_rad, self.aim.speed_rad_s, missed_in_row,
            Expectation(self.drives.is_ready, self.monitor.is_homed, self.is_controlled()),
        )  # fmt: skip
        for fault in found:
            self.fail(fault)

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

    def _aim(self) -> None:
        if (clip := set_points.aim(self)) is not None:
            fault_reactions.refuse(self, clip)

    def _drive(self) -> None:
        if self.is_controlled():
            self._servo()
            return
        servo = self.parts.servo
        servo.silence()
        if self.monitor.mode is Mode.GUIDING and self.is_weightless and self._carry():
            return
        is_free = self.monitor.mode is Mode.GUIDING
        output_mode = OutputMode.OFF if is_free else OutputMode.VOLTAGE
        self.parts.hardware.write(output_mode, servo.output, servo.feedforward_V)

    def _servo(self) -> None:
        measured, servo, set_point = self.parts.measurement, self.parts.servo, self.set_point
        fraction = HOMING_CURRENT_FRACTION if self.is_searching() else 1.0
        joints = None if self.aim is set_point else set_point
        servo.update(self.aim, measured.q_rad, measured.speed_rad_s, self.monitor.is_homed, fraction, joints)
        self.parts.hardware.write(servo.mode, servo.output, servo.feedforward_V)

    def _carry(self) -> bool:
        """Let the drives carry the arm; not where it moves too fast, which is a fault."""
        measured, servo, gravity_compensation = (
            self.parts.measurement,
            self.parts.servo,
            self.parts.gravity_compensation,
        )
        if (fault := gravity_compensation.too_fast(measured.speed_rad_s)) is not None:
            self.fail(fault)
            return False
        amperes = gravity_compensation.update(
            set_points.joints_standing(self, measured.q_rad), measured.speed_rad_s
        )
        self.parts.hardware.write(OutputMode.CURRENT, amperes, servo.feedforward_V)
        return True

    def _record(self, late_s: float) -> None:
        self.parts.recorder.write(row_of(self, late_s))

    def _break_down(self, error: Exception) -> None:
        """Something in the cycle raised: fault, and 0 V as long as the links still carry it."""
        if not (self.is_quitting and self.monitor.mode is Mode.OFF):
            self.fail(fault_reactions.fault_of(error))
        if isinstance(error, BoardReset):
            self.monitor.forget_home()  # boards that still know their zero are taken at their word by `home`
        shutdown.follow(self)
        servo = self.parts.servo
        servo.silence()
        try:
            self.parts.hardware.write(OutputMode.VOLTAGE, servo.output, servo.feedforward_V)
        except LinkError:
            self.parts.hardware.emergency_stop()

    # ---- what requests ask for

    def fail(self, fault: Fault) -> None:
        """A fault: to FAULT with the reaction that it asks for, the cycles before it kept."""
        fault_reactions.fail(self, fault)

    def acknowledge(self) -> tuple[Fault, ...]:
        """A human has seen the faults. Drives that faulted are reset and enabled again, at 0 V."""
        are_drives_faulted = any(self.parts.hardware.feedback.drive_faults)
        if are_drives_faulted or (self.monitor.mode is Mode.FAULT and not self.monitor.is_held_fault):
            self.has_waited = True
            self.parts.hardware.reset_drive_faults()
            if self.monitor.mode is Mode.FAULT:
                self.drives.expect(self.now_s)
            else:
                self.drives.forget()
            if not self.monitor.faults:
                return ()  # drives that were faulted before this runtime began
        cleared = self.monitor.acknowledge()
        self.stillness.enter_mode(self.now_s)
        return cleared

    def want_hold(self) -> None:
        """Get to HOLDING from OFF, BRAKED or GUIDING, through all that lies between."""
        shutdown.want_hold(self)

    def go_off(self, quits: bool) -> None:
        """Stop, hold, brake, off: begun here, carried on by the cycle."""
        shutdown.begin(self, quits)

    def take_known_zeros(self) -> bool:
        """Believe boards that all say that their zero was set since power-up; returns whether they do."""
        return homing.take_known_zeros(self)

    def start_homing(self) -> None:
        """Home every joint, one after the other. ArmError when arm.toml does not say how."""
        homing.start(self)

    def start(self, motion: Motion, as_encoders: bool = False) -> None:
        """Start a motion that was checked and that begins where the arm is `seen`, at rest."""
        motion_modes.start(self, motion, as_encoders)

    def jog(self, request: JogRequest) -> None:
        """Move as somebody keeps asking; ArmError says why not, and nothing has changed then."""
        motion_modes.jog(self, request)

    def renew_jog(self) -> None:
        """Whoever jogs still wants it; ArmError where nothing is jogged."""
        motion_modes.renew_jog(self)

    def pause(self) -> None:
        """Slow to rest along the motion and hold on it."""
        self.on(Event.PAUSE)

    def resume(self) -> None:
        """Go on along the motion."""
        self.on(Event.RESUME)

    def stop(self) -> None:
        """Controlled stop; legal in every mode."""
        motion_modes.stop(self)

    def brake(self) -> None:
        """Windings shorted now: under control first to a stop where something moves would be `stop`."""
        motion_modes.brake(self)

    def guide(self, weightless: bool) -> None:
        """Let a hand move the arm: circuits open, somebody holds it; or `weightless`, the drives carry it.

        ArmError where it does not know its angles, and so not its weight.
        """
        self.monitor.require(Event.GUIDE)
        if weightless and not self.monitor.is_homed:
            raise ArmError("gravity compensation needs a homed arm: home it first (`armwright home`)")
        self.is_weightless = weightless
        self.on(Event.GUIDE)
        self.run_number += 1

    def joint_rad(self) -> tuple[set_points.Angles, set_points.Angles]:
        """Angles that the joints have and are to have, as far as the model knows what is between them and their encoders."""
        measured, wanted = set_points.joint_rad(self)
        return tuple(measured), wanted

    def seen(self, as_encoders: bool) -> SetPoint:
        """Where the arm is to stand now, as joint angles or as encoder angles."""
        return set_points.seen(self, as_encoders)
