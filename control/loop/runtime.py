"""One control cycle, call by call: read, measure, watch, plan, servo, write, record.

    cycle(now_s, late_s, missed, missed_in_row)
      _read            hardware.read(), then angles and speeds from counts, camera, averages
      _watch           limits, stale data, board faults -> faults -> the state machine
      _advance         what the present mode does to the set-point (hold, motion, jog, homing, stop, nothing)
      _drive           set-point -> feed-forward + PID -> hardware.write()
      _record          one row

The runtime never waits and opens nothing: a hardware, a recorder and the rest are handed to it (control.loop.assemble). The
same object runs in a process of its own in real time and inside a test on a stepped clock.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from control.errors import ArmError
from control.loop.averaging import Averaging
from control.loop.carrying import Carrying
from control.loop.hardware import Hardware, OutputMode
from control.loop.homing import HomingFailed, HomingSequence
from control.loop.jogging import Jogging, Wish
from control.loop.measure import Measurement
from control.loop.punctuality import Punctuality
from control.loop.readiness import ENABLE_LIMIT_S, DriveReadiness, is_any_enabled
from control.loop.record import Recorder
from control.loop.servo import Servo
from control.loop.stillness import Stillness
from control.loop.watch import ZERO_SET, Expectation, Watch
from control.model.inverse import InverseKinematics
from control.model.joint_side import JointSide
from control.motion.pace import Paced
from control.motion.setpoint import Motion, SetPoint, at_rest
from control.safety.fault import Fault, Reaction
from control.safety.limits import Clip, SetPointLimits, limit_set_point
from control.safety.monitor import Monitor
from control.safety.table import CONTROLLED_MODES, TRAVELLING_MODES, Event, Mode
from firmware_iface.errors import BoardReset, LinkError

Vector = tuple[float, float, float]
NOWHERE: Vector = (math.nan, math.nan, math.nan)
MODE_NUMBER = {mode: number for number, mode in enumerate(Mode)}  # as recorded
HOMING_CURRENT_FRACTION = 0.5  # in search of the zero, and while joints without one are jogged
_ON_PATH = (Mode.MOVING, Mode.PAUSED)


class Camera(Protocol):
    """Whatever sees the tip."""

    def newest_tip_m(self) -> Vector | None:
        """Tip in the base frame of the newest frame that came since the last call, or None."""
        ...


@dataclass(frozen=True, slots=True)
class Parts:
    """What a runtime is made of; see control.loop.assemble."""

    hardware: Hardware
    recorder: Recorder
    measurement: Measurement
    servo: Servo
    watch: Watch
    set_point_limits: tuple[SetPointLimits, ...]
    homing: Callable[[], HomingSequence]
    carrying: Carrying
    jogging: Callable[[bool], Jogging]  # of an arm that is homed, or not
    stop_from: Callable[[SetPoint], Motion]
    inverse: InverseKinematics
    camera: Camera | None
    joint_names: tuple[str, ...]
    do_counters_span: bool  # the whole travel of their joints, without a wrap
    period_s: float
    stopwatch_s: Callable[[], float]
    aim_limits: tuple[SetPointLimits, ...] = ()  # of the encoders' set-points, for that arm
    joint_side: JointSide | None = None  # of an arm whose encoders do not say where its joints are


class Runtime:
    """The arm under control. `cycle` is called every period; the requests are in control.loop.requests."""

    def __init__(self, parts: Parts) -> None:
        n = len(parts.joint_names)
        self.parts = parts
        self.monitor = Monitor()
        self.punctuality = Punctuality(parts.period_s, parts.stopwatch_s)
        self.now_s = 0.0
        self.cycles = 0
        self.run_number = 0
        self.averaging: Averaging | None = None
        self.camera_m = NOWHERE
        self.camera_at_s = -math.inf
        self.fault_rows: tuple[bytes, ...] = ()
        self.is_quitting = False
        self.has_waited = False  # for boards, outside of a cycle: the deadlines meanwhile do not count
        self.paced: Paced | None = None  # the motion that runs, a stop too
        self.override = 1.0  # pace at which motions run
        self.jogging: Jogging | None = None
        self.was_stopped = False  # the last motion, before its end
        self.is_weightless = False  # while a hand guides the arm: its drives carry it
        self._zeros = (0.0,) * n
        self.set_point = self.aim = at_rest(self._zeros)  # of the joints; of their encoders
        self._is_of_encoders = False  # whether set_point is, while a motion runs that was given so
        self._elapsed_s = parts.period_s
        self._homing: HomingSequence | None = None
        self._drives = DriveReadiness(parts.joint_names)
        self._stillness = Stillness()
        self._wants_hold = False
        self._is_going_off = False
        self._camera_m = NOWHERE

    # ---- the cycle

    def cycle(self, now_s: float, late_s: float, missed: int, missed_in_row: int) -> bool:
        """One control cycle that began at `now_s`; False when the runtime was told to end and the drives are off."""
        self.now_s = now_s
        self.cycles += 1
        self._elapsed_s = (1 + missed) * self.parts.period_s
        self.punctuality.begin(late_s, missed)
        if missed:
            self.parts.watch.note_pause(now_s)
        try:
            self._read()
            self._watch(missed_in_row)
            self._advance()
            self.aim = self.set_point if self.parts.joint_side is None else self._aimed()
            self._drive()
        except Exception as error:  # whatever breaks here, the arm must not be left moving
            self._break_down(error)
        self._record(late_s)
        return not (self.is_quitting and self._has_left())

    def _read(self) -> None:
        feedback = self.parts.hardware.read()
        if self.parts.measurement.update(feedback.count, feedback.shift_count, feedback.counted_at_s):
            self._follow_shift()
        self._camera_m = NOWHERE
        if self.parts.camera is not None and (tip := self.parts.camera.newest_tip_m()) is not None:
            self._camera_m = self.camera_m = tip
            self.camera_at_s = self.now_s
        if self.averaging is not None:
            seen = None if self._camera_m is NOWHERE else self._camera_m
            self.averaging.add(self.now_s, self.parts.measurement, feedback.current_A, seen)

    def _watch(self, missed_in_row: int) -> None:
        for fault in self._drives.follow(self.now_s, self.parts.hardware.feedback):
            self.fail(fault)
        mode = self.monitor.mode
        if mode is Mode.OFF:
            return
        measured = self.parts.measurement
        is_servoing = self._is_controlled()
        found = self.parts.watch.look(
            self.now_s, self.parts.hardware.feedback, measured.q_rad, measured.speed_rad_s,
            self.aim.q_rad, self.aim.speed_rad_s, missed_in_row,
            Expectation(self._drives.is_ready, self.monitor.is_homed, is_servoing),
        )  # fmt: skip
        for fault in found:
            self.fail(fault)

    def _advance(self) -> None:
        mode = self.monitor.mode
        if mode in (Mode.MOVING, Mode.PAUSED, Mode.STOPPING) or self.monitor.is_held_fault:
            self._follow_motion()
        elif mode is Mode.JOGGING:
            self._jog()
        elif mode is Mode.HOMING:
            self._home()
        elif mode is not Mode.HOLDING:
            self._stay()
        if self._is_going_off and (event := self.monitor.next_towards_off(self._is_still())) is not None:
            self._step_towards_off(event)

    def _follow_motion(self) -> None:
        if self.paced is None:
            return
        try:
            wanted = self.paced.advance(self._elapsed_s, self._wanted_pace())
        except Exception as error:  # the feedback is good all the same, so the arm can stop under control
            self._lose_motion(error)
            return
        self._take(wanted)
        if self.paced is not None and self.paced.is_over:
            self._come_to_rest(Event.ARRIVED if self.monitor.mode in _ON_PATH else Event.STOPPED)

    def _wanted_pace(self) -> float:
        if self.monitor.mode is Mode.PAUSED:
            return 0.0
        return self.override if self.monitor.mode is Mode.MOVING else 1.0

    def _jog(self) -> None:
        if self.jogging is None:
            return
        try:
            wanted = self.jogging.advance(self.now_s, self._elapsed_s, self.set_point)
        except Exception as error:
            self._lose_motion(error)
            return
        self._take(wanted)
        if self.jogging is not None and self.jogging.is_over:
            self._come_to_rest(Event.ARRIVED)

    def _come_to_rest(self, event: Event) -> None:
        self.paced = self.jogging = None
        at_rad = self.set_point.q_rad
        self.set_point = at_rest(self._joints(at_rad) if self._is_of_encoders else at_rad)
        self._is_of_encoders = False
        self.on(event)

    def _take(self, wanted: SetPoint) -> None:
        """Follow a motion through the last guard: its plan was checked, so a clip means that something is wrong.

        A stop is not held back: it may brake harder than a motion, where a joint's range asks for it. Nor is a jog of joints
        whose angles mean nothing yet: its speed and acceleration are its own.
        """
        is_guarded = self.monitor.mode in _ON_PATH or (
            self.monitor.mode is Mode.JOGGING and self.monitor.is_homed
        )
        if not is_guarded:
            self.set_point = wanted
            return
        last = self.set_point
        allowed = limit_set_point(
            wanted.q_rad, last.q_rad, last.speed_rad_s, self.parts.set_point_limits, self._elapsed_s
        )
        if not allowed.reasons:
            self.set_point = wanted
            return
        self.set_point = SetPoint(allowed.q_rad, allowed.speed_rad_s, self._zeros)
        self._clipped(allowed.reasons[0])

    def _clipped(self, clip: Clip) -> None:
        self.fail(
            Fault(
                "set_point_limit",
                self.parts.joint_names[clip.joint - 1],
                f"the motion asks for more than its limits: {clip}",
                "plan the motion again with this arm.toml",
                Reaction.CONTROLLED,
            )
        )

    def _stay(self) -> None:
        """Nothing is controlled: the set-point goes with the arm, and holds from there when that is wanted."""
        self.set_point, self._is_of_encoders = at_rest(self._joints(self.parts.measurement.q_rad)), False
        if not (self._wants_hold and self._drives.is_ready):
            return
        if self.monitor.mode is Mode.OFF:
            self.on(Event.CONNECT)
            self.take_known_zeros()
        elif self.monitor.mode is Mode.BRAKED:
            self._wants_hold = False
            self.parts.servo.reset()
            self.on(Event.ENABLE)

    def _drive(self) -> None:
        if self._is_controlled():
            self._servo()
            return
        servo = self.parts.servo
        servo.silence()
        if self.monitor.mode is Mode.GUIDING and self.is_weightless and self._carry():
            return
        is_free = self.monitor.mode is Mode.GUIDING
        output_mode = OutputMode.OFF if is_free else OutputMode.VOLTAGE
        self.parts.hardware.write(output_mode, servo.output, servo.feedforward_V)

    def _carry(self) -> bool:
        """Let the drives carry the arm; not where it moves too fast, which is a fault."""
        measured, servo, carrying = self.parts.measurement, self.parts.servo, self.parts.carrying
        if (fault := carrying.too_fast(measured.speed_rad_s)) is not None:
            self.fail(fault)
            return False
        amperes = carrying.update(self._joints(measured.q_rad), measured.speed_rad_s)
        self.parts.hardware.write(OutputMode.CURRENT, amperes, servo.feedforward_V)
        return True

    def _has_left(self) -> bool:
        """Whether the arm is off and its drives have said so, or have had time enough to."""
        if self.monitor.mode is not Mode.OFF:
            return False
        has_waited_long = self.now_s - self._stillness.mode_from_s > ENABLE_LIMIT_S
        return has_waited_long or not is_any_enabled(self.parts.hardware.feedback)

    def _is_controlled(self) -> bool:
        return self.monitor.mode in CONTROLLED_MODES or self.monitor.is_held_fault

    def _servo(self) -> None:
        measured, servo, set_point = self.parts.measurement, self.parts.servo, self.set_point
        is_searching = self.monitor.mode is Mode.HOMING or (
            self.monitor.mode is Mode.JOGGING and not self.monitor.is_homed
        )
        fraction = HOMING_CURRENT_FRACTION if is_searching else 1.0
        joints = None if self.aim is set_point else set_point
        servo.update(self.aim, measured.q_rad, measured.speed_rad_s, self.monitor.is_homed, fraction, joints)
        self.parts.hardware.write(servo.mode, servo.output, servo.feedforward_V)

    def _record(self, late_s: float) -> None:
        feedback, measured, servo = self.parts.hardware.feedback, self.parts.measurement, self.parts.servo
        row = [
            self.now_s, self.cycles & 0xFFFFFFFF, self.run_number, MODE_NUMBER[self.monitor.mode],
            self.punctuality.missed, late_s, self.punctuality.end(), self.parts.servo.torque_model.payload_kg, *self._camera_m,
        ]  # fmt: skip
        is_open = self.monitor.mode in (Mode.GUIDING, Mode.OFF)
        for joint in range(feedback.joint_count):
            row += (
                measured.q_rad[joint], self.aim.q_rad[joint],
                measured.speed_rad_s[joint], self.aim.speed_rad_s[joint], feedback.count[joint],
                math.nan if is_open else servo.volts[joint], feedback.current_A[joint],
                feedback.supply_V[joint], feedback.temperature_C[joint], feedback.statusword[joint],
                feedback.drive_faults[joint], feedback.channel_flags[joint], feedback.counted_at_s[joint],
            )  # fmt: skip
        self.parts.recorder.write(row)

    # ---- faults

    def fail(self, fault: Fault) -> None:
        """A fault: to FAULT with the reaction that it asks for, the cycles before it kept."""
        was_braking = self.monitor.reaction is Reaction.BRAKE
        is_first = self.monitor.mode is not Mode.FAULT
        if (
            fault.code == "following_error"
            and self.monitor.is_held_fault
            and self.now_s > self._stillness.mode_from_s
        ):
            # Not even the stop is followed: control is not to be trusted.
            fault = replace(fault, reaction=Reaction.BRAKE)
        self.monitor.fault(fault)
        if fault.code == "zero_lost":
            self.monitor.forget_home()
        if is_first:
            self._stillness.enter_mode(self.now_s)
            self.fault_rows = self.parts.recorder.last_rows()
            self._homing = self.jogging = None
            self._wants_hold = False
        self.was_stopped = True
        if self.monitor.is_held_fault and is_first:
            self._stop_where(self.set_point if fault.code != "following_error" else self._measured())
        elif not was_braking and self.monitor.reaction is Reaction.BRAKE:
            self.paced = None

    def _lose_motion(self, error: Exception) -> None:
        """The motion gave no set-point: a controlled stop; brake if it was the stop itself."""
        is_stop = self.monitor.mode not in TRAVELLING_MODES
        self.paced = self.jogging = None
        message = str(error) if isinstance(error, ArmError) else f"{type(error).__name__}: {error}"
        self.fail(
            Fault(
                "motion",
                "motion",
                f"it could not go on: {message}",
                "plan it again; report it with the recording of this run if it was planned for this arm",
                Reaction.BRAKE if is_stop else Reaction.CONTROLLED,
            )
        )

    def _stop_where(self, state: SetPoint) -> None:
        """Plan the jerk-limited stop from `state`; where there is none, brake."""
        if state is not self.set_point:
            self.set_point = state
            self.parts.servo.reset()
        self.paced = self._begun(self.parts.stop_from(state), 1.0)

    def _begun(self, motion: Motion, pace: float) -> Paced:
        limits = [limit.acceleration_rad_s2 for limit in self.parts.set_point_limits]
        return Paced(motion, limits, pace)

    def _measured(self) -> SetPoint:
        measured = self.parts.measurement
        return SetPoint(self._joints(measured.q_rad), tuple(measured.speed_rad_s), self._zeros)

    def _joints(self, encoder_rad: Sequence[float]) -> tuple[float, ...]:
        """Joint angles of an arm that stands where its encoders say; before homing nobody knows better than they."""
        side = self.parts.joint_side
        if side is None or not self.monitor.is_homed:
            return tuple(encoder_rad)
        return side.stand(encoder_rad, self.parts.servo.torque_model.payload_kg)

    def _aimed(self) -> SetPoint:
        """Where the encoders are to be for the joints' set-point, inside their own limits."""
        side = self.parts.joint_side
        if side is None or not self.monitor.is_homed:
            return self.set_point
        aim = SetPoint(*side.aim(self.set_point, self._elapsed_s, self.parts.servo.torque_model.payload_kg))
        if self._is_of_encoders:
            return self.set_point
        if self.monitor.mode not in (*_ON_PATH, Mode.JOGGING):
            return aim
        allowed = limit_set_point(
            aim.q_rad, self.aim.q_rad, self.aim.speed_rad_s, self.parts.aim_limits, self._elapsed_s
        )
        if not allowed.reasons:
            return aim
        self._clipped(allowed.reasons[0])
        return SetPoint(allowed.q_rad, allowed.speed_rad_s, self._zeros)

    def joint_rad(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Angles that the joints have and are to have, as far as the model knows what is between them and their encoders."""
        side, measured = self.parts.joint_side, self.parts.measurement.q_rad
        if side is None or not self.monitor.is_homed:
            return tuple(measured), self.set_point.q_rad
        return side.joint_rad(measured), self.seen(as_encoders=False).q_rad

    def seen(self, as_encoders: bool) -> SetPoint:
        """Where the arm is to stand now, as joint angles or as encoder angles."""
        side = self.parts.joint_side
        if side is None or not self.monitor.is_homed or as_encoders == self._is_of_encoders:
            return self.set_point
        return at_rest(self.aim.q_rad if as_encoders else side.joint_rad(self.aim.q_rad))

    def _break_down(self, error: Exception) -> None:
        """Something in the cycle raised: fault, and 0 V as long as the links still carry it."""
        if isinstance(error, LinkError):
            where, remedy, code = "links", "check cables and supply", "link"
        else:
            where, remedy, code = "control loop", "report it with the recording of this run", "internal"
        message = (
            str(error) if isinstance(error, LinkError | ArmError) else f"{type(error).__name__}: {error}"
        )
        if not (self.is_quitting and self.monitor.mode is Mode.OFF):
            self.fail(Fault(code, where, message, remedy, Reaction.BRAKE))
        if isinstance(error, BoardReset):
            self.monitor.forget_home()  # boards that still know their zero are taken at their word by `home`
        if self._is_going_off and (event := self.monitor.next_towards_off(self._is_still())) is not None:
            self._step_towards_off(event)
        servo = self.parts.servo
        servo.silence()
        try:
            self.parts.hardware.write(OutputMode.VOLTAGE, servo.output, servo.feedforward_V)
        except LinkError:
            self.parts.hardware.emergency_stop()

    # ---- what requests and the modes use

    def on(self, event: Event) -> None:
        """Take an event; IllegalTransition when the mode does not allow it, and nothing has changed."""
        before = self.monitor.mode
        self.monitor.on(event)
        if self.monitor.mode is not before or event is Event.BRAKE:
            self._stillness.enter_mode(self.now_s)

    def want_hold(self) -> None:
        """Get to HOLDING from OFF, BRAKED or GUIDING, through all that lies between."""
        if self.monitor.mode is Mode.OFF:
            self.monitor.require_no_faults("ENABLE")
            self.has_waited = True
            self.parts.hardware.enable()
            self._drives.expect(self.now_s)
        elif self.monitor.mode is Mode.GUIDING:
            self.on(Event.BRAKE)
        elif self.monitor.mode is not Mode.BRAKED:
            self.monitor.on(Event.ENABLE)  # says why not
        self._is_going_off = False
        self._wants_hold = True

    def start(self, motion: Motion, as_encoders: bool = False) -> None:
        """Start a motion that was checked and that begins where the arm is `seen`, at rest."""
        self.on(Event.MOVE)
        self.set_point, self._is_of_encoders = self.seen(as_encoders), as_encoders
        self.run_number += 1
        self.was_stopped = False
        self.paced = self._begun(motion, self.override)

    def jog(self, wish: Wish) -> None:
        """Move as somebody keeps asking; ArmError says why not, and nothing has changed then."""
        if self.jogging is not None and self.monitor.mode is Mode.JOGGING:
            self.jogging.ask(self.now_s, wish, self.set_point)
            return
        self.monitor.require(Event.JOG)
        jogging = self.parts.jogging(self.monitor.is_homed)
        jogging.ask(self.now_s, wish, self.set_point)
        self.on(Event.JOG)
        self.run_number += 1
        self.was_stopped = False
        self.jogging = jogging

    def renew_jog(self) -> None:
        """Whoever jogs still wants it; IllegalTransition where nothing is jogged."""
        if self.jogging is None or self.monitor.mode is not Mode.JOGGING:
            raise ArmError(f"the arm is {self.monitor.mode.name}: there is no jog to go on with")
        self.jogging.renew(self.now_s)

    def pause(self) -> None:
        """Slow to rest along the motion and hold on it."""
        self.on(Event.PAUSE)

    def resume(self) -> None:
        """Go on along the motion."""
        self.on(Event.RESUME)

    def stop(self) -> None:
        """Controlled stop; legal in every mode."""
        before = self.monitor.mode
        self.on(Event.STOP)
        self._wants_hold = False
        if self.monitor.mode is Mode.STOPPING and before is not Mode.STOPPING:
            self.was_stopped = True
            self._homing = self.jogging = None
            self._stop_where(self.set_point)

    def brake(self) -> None:
        """Windings shorted now: under control first to a stop where something moves would be `stop`."""
        if self.monitor.mode in TRAVELLING_MODES or self.monitor.mode is Mode.STOPPING:
            self.fail(
                Fault(
                    "brake", "operator", "braked while moving", "acknowledge when it is safe", Reaction.BRAKE
                )
            )
        else:
            self.on(Event.BRAKE)
        self._wants_hold = False

    def guide(self, weightless: bool) -> None:
        """Let a hand move the arm: circuits open, somebody holds it; or `weightless`, the drives carry it.

        ArmError where it does not know its angles, and so not its weight.
        """
        self.monitor.require(Event.GUIDE)
        if weightless and not self.monitor.is_homed:
            raise ArmError(
                "an arm that is not homed does not know its weight: home it first (`armwright home`)"
            )
        self.is_weightless = weightless
        self.on(Event.GUIDE)
        self.run_number += 1

    def acknowledge(self) -> tuple[Fault, ...]:
        """A human has seen the faults. Drives that faulted are reset and enabled again, at 0 V."""
        are_drives_faulted = any(self.parts.hardware.feedback.drive_faults)
        if are_drives_faulted or (self.monitor.mode is Mode.FAULT and not self.monitor.is_held_fault):
            self.has_waited = True
            self.parts.hardware.reset_drive_faults()
            if self.monitor.mode is Mode.FAULT:
                self._drives.expect(self.now_s)
            else:
                self._drives.forget()
            if not self.monitor.faults:
                return ()  # drives that were faulted before this runtime began
        cleared = self.monitor.acknowledge()
        self._stillness.enter_mode(self.now_s)
        return cleared

    def progress(self) -> float:
        """How much of the present motion is done, 0 to 1; 1 when there is none."""
        return self.paced.progress if self.paced is not None else 1.0

    def pace(self) -> float:
        """How fast the present motion's time runs, 0 to 1; 1 when there is none."""
        return self.paced.pace if self.paced is not None else 1.0

    @property
    def motion(self) -> Motion | None:
        """The motion that runs."""
        return self.paced.motion if self.paced is not None else None

    def go_off(self, quits: bool) -> None:
        """Stop, hold, brake, off: begun here, carried on by the cycle."""
        self._is_going_off = True
        self._wants_hold = False
        self.is_quitting = self.is_quitting or quits

    def _step_towards_off(self, event: Event) -> None:
        if event is Event.STOP:
            self.stop()
            return
        self.on(event)
        if self.monitor.mode is Mode.OFF:
            self._is_going_off = False
            self._drives.forget()
            self.parts.hardware.disable()

    def _is_still(self) -> bool:
        return self._stillness.is_still(self.now_s, self.parts.measurement.speed_rad_s)

    # ---- homing

    def take_known_zeros(self) -> bool:
        """Believe boards that all say that their zero was set since power-up; returns whether they do.

        A counter that wraps inside its joint's travel may have done so while nobody looked: it is never believed.
        """
        if not self.parts.do_counters_span or not all(
            flags & ZERO_SET for flags in self.parts.hardware.feedback.channel_flags
        ):
            return False
        self._become_homed()
        return True

    def _become_homed(self) -> None:
        """The pose is known: the feed-forward now carries the weight that the integrals have carried so far."""
        was_homed = self.monitor.is_homed
        self.on(Event.HOMED)
        if not was_homed:
            self.parts.servo.learn_pose()
            self.set_point = at_rest(self._joints(self.set_point.q_rad))

    def start_homing(self) -> None:
        """Home every joint, one after the other. ArmError when arm.toml does not say how."""
        sequence = self.parts.homing()
        self.on(Event.HOME)
        self.set_point = at_rest(self.aim.q_rad)
        self.run_number += 1
        self.was_stopped = False
        self._homing = sequence

    def _home(self) -> None:
        if self._homing is None:
            return
        try:
            self.set_point = self._homing.step(self.set_point, self.parts.hardware.feedback, self._elapsed_s)
        except HomingFailed as error:
            self.fail(Fault("homing", error.where, error.message, error.remedy, Reaction.CONTROLLED))
            return
        if self._homing.is_done:
            self._homing = None
            self._become_homed()

    def _follow_shift(self) -> None:
        """A counter was shifted under a joint that is held: its set-point is shifted with it, so nothing moves."""
        shifts = self.parts.measurement.shifted_rad
        self.set_point, self.aim = (
            point._replace(q_rad=tuple(q + shift for q, shift in zip(point.q_rad, shifts, strict=True)))
            for point in (self.set_point, self.aim)
        )
