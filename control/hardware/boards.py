"""The arm's hardware: encoder boards on serial lines, motor boards on one CAN bus.

Corrects the wiring signs, sends one COMMAND per cycle to each motor board, and collects the replies in one `Feedback`.
Mock boards are connected behind the links; the code here is the same for both.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass

from control.dynamics.gains import Gains
from control.hardware.board_stop import board_stop, can_hold
from control.hardware.interface import Feedback, OutputMode
from control.model.arm import Arm, Drive
from control.model.joint_map import JointMap
from firmware_iface.clock import Clock
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.errors import BoardFaulted, BoardSilent, LinkError, MisuseError
from firmware_iface.motor.board import MotorBoard, MotorBus
from firmware_iface.motor.cia402 import State
from firmware_iface.motor.wire import Mode, Output, Parameter

REPORT_WAIT_S = 0.05  # a stream runs at 500 Hz or more; only a pause of the host lasts longer
ASK_COUNT_S = 0.04  # between two questions for a motor board's own count: 3 % of a 500 Hz bus
FRESH_CYCLES = 2  # age of a count that is compared with one of another board
NO_GAINS = Gains(0.0, 0.0, 0.0, 0.001)  # a board without gains brakes
FULL_INTEGRAL = 0.5  # of the supply: limit of the board's integral in position mode


@dataclass(frozen=True, slots=True)
class JointWiring:
    """The wiring of a joint: boards, channel, signs; gains in volts, for the board's own position control."""

    encoder: EncoderBoard
    channel: int
    motor: MotorBoard
    drive: Drive
    gains: Gains


def start_stream(encoder: EncoderBoard, period_s: float) -> None:
    """Stream two reports per cycle if the line is fast enough, so that the newest is at most half a cycle old."""
    try:
        encoder.stream(0.5 * period_s)
    except MisuseError:
        encoder.stream(period_s)


def _serial_numbers(wired: JointWiring) -> tuple[int | None, int | None]:
    boards = (wired.encoder.identity, wired.motor.identity)
    encoder, motor = (None if known is None else known.serial_number for known in boards)
    return encoder, motor


class BoardHardware:
    """Implements `control.hardware.interface.Hardware` on boards; made and checked by control.hardware.connect."""

    def __init__(
        self, arm: Arm, clock: Clock, bus: MotorBus, wiring: Sequence[JointWiring], period_s: float
    ) -> None:
        self.feedback = Feedback(len(wiring))
        self._clock = clock
        self._period_s = period_s
        self._bus = bus
        self._wiring = tuple(wiring)
        self._encoders = tuple(dict.fromkeys(joint.encoder for joint in wiring))
        self._joint_of_channel = {(joint.encoder, joint.channel): j for j, joint in enumerate(wiring)}
        self._channels = {
            board: sorted(joint.channel for joint in wiring if joint.encoder is board)
            for board in self._encoders
        }
        self._motor_signs = tuple(joint.drive.motor_direction for joint in wiring)
        self._maps = tuple(JointMap(joint.drive) for joint in wiring)
        self._board_stop = board_stop(arm, period_s)
        self._watchdog_ms = round(arm.limits.watchdog_s * 1e3)
        self._is_wanted_enabled = False
        self._configured_resets = [-1] * len(wiring)
        self._serial_numbers = [_serial_numbers(wired) for wired in wiring]  # of encoder and motor board
        self._position_offset_count = [0] * len(wiring)
        self._asked: tuple[int, int] | None = (
            None  # joint whose motor board was asked for its count, and its count then
        )
        self._ask_joint, self._ask_in = 0, 0
        self._ask_every = max(1, round(ASK_COUNT_S / period_s))

    # ---- every cycle

    def read(self) -> Feedback:
        """Drain the links into `feedback`. Raises LinkLost, BoardReset, ProtocolViolation."""
        feedback = self.feedback
        try:
            self._update()
        finally:
            oldest_s = math.inf
            for joint, wired in enumerate(self._wiring):
                report = wired.encoder.latest
                if report is not None:
                    feedback.count[joint] = report.counts[wired.channel]
                    feedback.counted_at_s[joint] = wired.encoder.board_time_s
                    feedback.channel_flags[joint] = report.flags[wired.channel]
                feedback.reported_at_s[joint] = reported_s = wired.encoder.fresh_at_s
                oldest_s = min(oldest_s, reported_s)
                self._take_reply(joint, wired.motor)
            feedback.encoder_at_s = oldest_s
            feedback.reports, feedback.lost = self._encoders[0].reports, self._encoders[0].lost
            self._take_motor_count()
        return feedback

    def _take_motor_count(self) -> None:
        """Pair the count of a motor board with that of the encoder board when it was asked for."""
        self.feedback.motor_counts.clear()
        if self._asked is not None:
            joint, count = self._asked
            wired = self._wiring[joint]
            if (motor_count := wired.motor.count_taken()) is not None:
                sign = wired.drive.motor_direction * wired.drive.encoder_direction
                self.feedback.motor_counts.append((joint, count, sign * motor_count))
                self._asked = None

    def _ask_motor_count(self) -> None:
        """Ask one motor board after the other for the count of its own encoder, while the other count is fresh."""
        self._ask_in -= 1
        if self._ask_in > 0 or not self._is_wanted_enabled:
            return
        joint = (self._ask_joint + 1) % len(self._wiring)
        if not can_hold(self._wiring[joint].drive):
            self._ask_joint = joint
        elif self._clock.now_s() - self.feedback.reported_at_s[joint] <= FRESH_CYCLES * self._period_s:
            self._ask_in, self._ask_joint = self._ask_every, joint
            self._asked = (joint, self.feedback.count[joint] - self.feedback.shift_count[joint])
            self._wiring[joint].motor.ask_count()

    def _update(self) -> None:
        """Update all boards, even if one of them raises."""
        try:
            for encoder in self._encoders:
                encoder.update()
        finally:
            self._bus.update()

    def _take_reply(self, joint: int, motor: MotorBoard) -> None:
        feedback, reply = self.feedback, motor.reply
        feedback.reply_at_s[joint] = motor.reply_at_s
        if reply is None:
            feedback.statusword[joint] = 0
            return
        feedback.current_A[joint] = reply.current_A * self._motor_signs[joint]
        feedback.supply_V[joint] = reply.supply_V
        feedback.temperature_C[joint] = reply.temperature_degC
        feedback.statusword[joint] = reply.statusword
        feedback.drive_faults[joint] = reply.faults

    def write(self, mode: OutputMode, output: Sequence[float], feedforward_V: Sequence[float]) -> None:
        """Send one COMMAND to each board; a board not in its target state gets the next state command instead."""
        wanted = State.OPERATION_ENABLED if self._is_wanted_enabled else State.SWITCH_ON_DISABLED
        is_voltage, sent_V = mode is OutputMode.VOLTAGE, self.feedback.sent_V
        for joint, wired in enumerate(self._wiring):
            is_driven = is_voltage and wired.motor.state is State.OPERATION_ENABLED
            sent_V[joint] = output[joint] if is_driven else math.nan
            if wired.motor.state is wanted or wired.motor.state is State.FAULT:
                self._command(joint, wired.motor, mode, output[joint], feedforward_V[joint])
            else:
                with contextlib.suppress(BoardFaulted):  # the watch sees it in the feedback
                    wired.motor.step_towards(wanted)
        self._ask_motor_count()

    def _command(
        self, joint: int, motor: MotorBoard, mode: OutputMode, output: float, forward_V: float
    ) -> None:
        sign = self._motor_signs[joint]
        if mode is OutputMode.VOLTAGE:
            motor.command_voltage(sign * output)
        elif mode is OutputMode.CURRENT:
            motor.command_current(sign * output)
        elif mode is OutputMode.POSITION:
            motor.command_position(self._board_count(joint, output), sign * forward_V)
        elif mode is OutputMode.HOLD:
            motor.command_hold()
        else:
            motor.command_off()

    def _board_count(self, joint: int, q_rad: float) -> int:
        """Set-point in counts of the motor board's own encoder, which counts up with positive voltage."""
        drive = self._wiring[joint].drive
        sign = drive.motor_direction * drive.encoder_direction
        return sign * self._maps[joint].count(q_rad) + self._position_offset_count[joint]

    def is_any_enabled(self) -> bool:
        """Whether a drive was in OPERATION ENABLED in its last reply."""
        return any(wired.motor.state is State.OPERATION_ENABLED for wired in self._wiring)

    @property
    def reports_a_cycle(self) -> int:
        """How many reports the first encoder board sends in a cycle; 0 if none."""
        stream_s = self._encoders[0].stream_period_s
        return round(self._period_s / stream_s) if stream_s > 0.0 else 0

    # ---- outside of the cycle: these wait for answers

    def enable(self) -> None:
        """Upload the boards' parameters and let `write` bring them to OPERATION ENABLED."""
        self._configure()
        self._is_wanted_enabled = True

    def disable(self) -> None:
        """Let `write` bring the drives to SWITCH ON DISABLED, where the boards short the windings."""
        self._is_wanted_enabled = False

    def reset_drive_faults(self) -> None:
        """Acknowledge the drives' faults and restore the state of boards that were reset.

        Raises BoardFaulted, and WrongIdentity where another board has taken the place of one.
        """
        for wired, (serial_number, _) in zip(self._wiring, self._serial_numbers, strict=True):
            if wired.encoder.latest is None:
                wired.encoder.identify(serial_number=serial_number)
                start_stream(wired.encoder, self._period_s)
                self._fresh_count(wired)
        for wired in self._wiring:
            wired.motor.acknowledge_fault()
        self._configure()

    def emergency_stop(self) -> None:
        """Broadcast the emergency stop. Never raises: the boards' watchdogs do the same a little later."""
        with contextlib.suppress(LinkError):
            self._bus.emergency_stop(1)

    def arm_index(self, joint: int) -> None:
        """Arm the index latch of the joint."""
        wired = self._wiring[joint]
        wired.encoder.arm_index(wired.channel)

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None."""
        wired = self._wiring[joint]
        return wired.encoder.index_latch(wired.channel)

    def watch_indices(self, is_wanted: bool) -> None:
        """Arm the index latches of all joints again and again, or end that."""
        for board, channels in self._channels.items():
            board.watch_indices(channels if is_wanted else ())

    def passed_indices(self) -> list[tuple[int, int]]:
        """(joint, count) of the watched index pulses that came since the last call."""
        return [
            (self._joint_of_channel[board, channel], count)
            for board in self._encoders
            for channel, count in board.passed_indices()
        ]

    def shift_count(self, joint: int, counts: int) -> None:
        """Shift the counter of a joint at rest; the motor may move by at most one count meanwhile."""
        wired = self._wiring[joint]
        wired.encoder.set_zero(wired.channel, self._fresh_count(wired) + counts)
        self._fresh_count(wired)
        self.feedback.shift_count[joint] += counts
        self._asked, self._ask_in = None, 2  # until the next read, `count` is from before the shift
        self._follow_position_count(joint)

    def _fresh_count(self, wired: JointWiring) -> int:
        """The count of the next report. BoardSilent if there is none."""
        asked_s = self._clock.now_s()
        while (now_s := self._clock.now_s()) - asked_s < REPORT_WAIT_S:
            self._clock.wait_until_s(now_s + 0.0005)
            wired.encoder.update()
            if wired.encoder.latest is not None and wired.encoder.latest_at_s > asked_s:
                return wired.encoder.latest.counts[wired.channel]
        raise BoardSilent(f"{wired.encoder.where}: no report for {REPORT_WAIT_S} s while a zero was set")

    def _configure(self) -> None:
        for joint, wired in enumerate(self._wiring):
            if self._configured_resets[joint] != wired.motor.resets:
                if wired.motor.resets:
                    wired.motor.identify(self._serial_numbers[joint][1])
                wired.motor.go_to(State.SWITCH_ON_DISABLED)
                for index, value in self._parameters(joint):
                    wired.motor.write(index, value)
                self._configured_resets[joint] = wired.motor.resets
            self._follow_position_count(joint)

    def _parameters(self, joint: int) -> list[tuple[Parameter, int]]:
        """Parameters of a board: limits, what it does without the host, and its PID in volts per count of its own encoder."""
        drive = self._wiring[joint].drive
        gains = self._wiring[joint].gains if can_hold(drive) else NO_GAINS
        per_count = abs(self._maps[joint].radians_per_count)
        volts_per_rad_s = drive.gear_ratio * drive.torque_constant_Nm_A
        parameters = [
            (Parameter.WATCHDOG_ms, self._watchdog_ms),
            (Parameter.WATCHDOG_ACTION, Output.HOLD),
            (Parameter.STOP_AFTER_ms, round(self._board_stop.after_s * 1e3)),
            (Parameter.STOP_TIME_ms, round(self._board_stop.time_s * 1e3)),
            (Parameter.DISABLED_OUTPUT, Output.BRAKE),
            (Parameter.VOLTAGE_LIMIT_mV, round(drive.supply_V * 1e3)),
            (Parameter.KP_uV_count, round(gains.kp * per_count * 1e6)),
            (Parameter.KI_uV_count_s, round(gains.ki * per_count * 1e6)),
            (Parameter.KD_nV_s_count, round(gains.kd * per_count * 1e9)),
            (Parameter.DERIVATIVE_FILTER_us, round(gains.derivative_filter_s * 1e6)),
            (Parameter.INTEGRAL_LIMIT_mV, round(FULL_INTEGRAL * drive.supply_V * 1e3)),
            (Parameter.SPEED_FEEDFORWARD_nV_s_count, round(volts_per_rad_s * per_count * 1e9)),
        ]
        if math.isfinite(drive.current_limit_A):
            parameters.append((Parameter.CURRENT_LIMIT_mA, round(drive.current_limit_A * 1e3)))
        return parameters

    def _follow_position_count(self, joint: int) -> None:
        """Offset of the motor board's count from the encoder board's, both read at rest."""
        wired = self._wiring[joint]
        if wired.drive.pid.mode != Mode.POSITION.name.lower():
            return
        sign = wired.drive.motor_direction * wired.drive.encoder_direction
        count = self._fresh_count(wired)
        self._position_offset_count[joint] = wired.motor.read(Parameter.POSITION_COUNT) - sign * count
