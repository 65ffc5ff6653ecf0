"""The reference boards as an arm's encoders (docs/encoder_board.md) and, on one CAN bus, as its drives (docs/motor_board.md)."""

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from control.dynamics.gains import Gains
from control.hardware.board_stop import board_stop, can_hold
from control.hardware.boards import Opened
from control.hardware.interface import Feedback, OutputMode, Wanted
from control.model.arm import Drive
from control.model.drive import JointMap
from firmware_iface.clock import Clock
from firmware_iface.encoder.board import EncoderBoard
from firmware_iface.errors import BoardFaulted, BoardSilent, LinkError, MisuseError
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.bus import MotorBus
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.motor.wire import IdleOutput, MotorParameter, SetpointMode

REPORT_WAIT_S = 0.05  # a stream runs at 500 Hz or more, and hosts pause for some 40 ms; longer where stale_s is


def start_stream(encoder: EncoderBoard, period_s: float) -> None:
    """Stream two reports per cycle if the line is fast enough, so that the newest is at most half a cycle old."""
    try:
        encoder.stream(0.5 * period_s)
    except MisuseError:
        encoder.stream(period_s)


class ReferenceEncoders:
    """One encoder board; meets `control.hardware.boards.Encoders` and `Line`."""

    is_asked = False

    def __init__(self, board: EncoderBoard, channels: Mapping[int, int], clock: Clock, period_s: float, stale_s: float) -> None:
        """`channels`: the channel of each joint. `stale_s`: how long the arm bears a silent board."""
        self.joints = tuple(channels)
        self._board = board
        self._channels = dict(channels)
        self._pairs = tuple(channels.items())
        self._joints = {channel: joint for joint, channel in channels.items()}
        self._watched = sorted(channels.values())
        self._clock = clock
        self._period_s = period_s
        self._wait_s = max(REPORT_WAIT_S, stale_s)
        self._serial_number = None if board.identity is None else board.identity.serial_number

    def await_counts(self, made_s: float, until_s: float) -> float:
        """When the newest counts were made, by the board's clock, once that is `made_s` or later; waits until then at most."""
        return self._board.await_report(made_s, until_s)

    def update(self) -> None:
        """Drain the line."""
        self._board.update()

    def flush(self) -> None:
        """The board streams by itself."""

    def take(self, feedback: Feedback) -> None:
        """Write the newest report."""
        board = self._board
        report, fresh_at_s, counted_at_s = board.latest, board.fresh_at_s, board.board_time_s
        for joint, channel in self._pairs:
            if report is not None:
                feedback.count[joint] = report.counts[channel]
                feedback.counted_at_s[joint] = counted_at_s
                feedback.channel_flags[joint] = report.flags[channel]
            feedback.reported_at_s[joint] = fresh_at_s

    def fresh_count(self, joint: int) -> int:
        """The count of the next report. BoardSilent if there is none."""
        board, asked_s = self._board, self._clock.now_s()
        while (now_s := self._clock.now_s()) - asked_s < self._wait_s:
            self._clock.wait_until_s(now_s + 0.0005)
            board.update()
            if board.latest is not None and board.latest_at_s > asked_s:
                return board.latest.counts[self._channels[joint]]
        raise BoardSilent(f"{board.where}: no report for {self._wait_s:g} s while a zero was set")

    def arm_index(self, joint: int) -> None:
        """Arm the index latch of the joint."""
        self._board.arm_index(self._channels[joint])

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None."""
        return self._board.index_latch(self._channels[joint])

    def watch_indices(self, is_wanted: bool) -> None:
        """Arm the index latches of all joints again and again, or end that."""
        self._board.watch_indices(self._watched if is_wanted else ())

    def passed_indices(self) -> list[tuple[int, int]]:
        """(joint, count) of the watched index pulses that came since the last call."""
        return [(self._joints[channel], count) for channel, count in self._board.passed_indices()]

    def shift(self, joint: int, counts: int) -> None:
        """Shift the counter of a joint at rest; the motor may move by at most one count meanwhile."""
        self._board.set_zero(self._channels[joint], self.fresh_count(joint) + counts)
        self.fresh_count(joint)

    def restore(self) -> None:
        """Start the stream again where none comes: after a reset, also one that nobody saw.

        WrongIdentity if another board has taken the place of this one, BoardSilent, BoardReset.
        """
        if self._clock.now_s() - self._board.latest_at_s > REPORT_WAIT_S:
            self._board.identify(serial_number=self._serial_number)
            start_stream(self._board, self._period_s)
            self.fresh_count(self.joints[0])


ASK_COUNT_S = 0.04  # between two questions for a motor board's own count: 3 % of a 500 Hz bus
FRESH_CYCLES = 2  # age of a count that is compared with one of another board
NO_GAINS = Gains(0.0, 0.0, 0.0, 0.001)  # a board without gains brakes
# Members of an enumeration are slow to look up in Python 3.11, and each cycle asks for these at every joint.
_ENABLED, _VOLTAGE = DriveState.OPERATION_ENABLED, OutputMode.VOLTAGE
FULL_INTEGRAL = 0.5  # of the supply: limit of the board's integral in position mode


@dataclass(frozen=True, slots=True)
class DriveWiring:
    """A joint (0-based), its motor board and its drive; gains in volts, for the board's own position control."""

    joint: int
    motor: MotorBoard
    drive: Drive
    gains: Gains


class ReferenceDrives:
    """The motor boards of one bus; meets `control.hardware.boards.Drives` and `Line`."""

    def __init__(
        self, opened: Opened, bus: MotorBus, wiring: Sequence[DriveWiring], problems: list[LinkError] | None = None
    ) -> None:
        """`problems`: those of these boards alone, if others on the bus belong to another arm."""
        self.joints = tuple(wired.joint for wired in wiring)
        self._bus, self._problems = bus, problems
        self._wiring = tuple(wiring)
        self._pairs = tuple((wired.joint, wired.motor, float(wired.drive.motor_direction)) for wired in wiring)
        self._motor_of = {wired.joint: wired.motor for wired in wiring}
        self._clock, self._period_s = opened.clock, opened.period_s
        self._maps = {wired.joint: JointMap(wired.drive) for wired in wiring}
        self._motor_maps = {wired.joint: JointMap(wired.drive.at_motor) for wired in wiring}
        self._board_stop = board_stop(opened.arm, opened.period_s)
        self._watchdog_ms = round(opened.arm.limits.watchdog_s * 1e3)
        self._serial_numbers = {
            wired.joint: None if wired.motor.identity is None else wired.motor.identity.serial_number for wired in wiring
        }
        self._configured_resets = dict.fromkeys(self.joints, -1)
        self._position_offset_count = dict.fromkeys(self.joints, 0)
        # entry of `wiring` whose motor board was asked for its count, and the encoder's count then
        self._asked: tuple[int, int] | None = None
        self._ask_next, self._ask_in = 0, 0
        self._ask_every = max(1, round(ASK_COUNT_S / opened.period_s))

    # ---- every cycle

    def update(self) -> None:
        """Drain the bus. Raises LinkLost, and once per event BoardReset or ProtocolViolation."""
        self._bus.update()
        if self._problems:
            raise self._problems.pop(0)

    def flush(self) -> None:
        """Each COMMAND is sent as it is written."""

    def take(self, feedback: Feedback) -> None:
        """Write the latest replies."""
        for joint, motor, sign in self._pairs:
            reply = motor.reply
            feedback.reply_at_s[joint] = motor.reply_at_s
            if reply is None:
                feedback.statusword[joint] = 0
                continue
            feedback.current_A[joint] = reply.current_A * sign
            feedback.supply_V[joint] = reply.supply_V
            feedback.temperature_C[joint] = reply.temperature_degC
            feedback.statusword[joint] = reply.statusword
            feedback.drive_faults[joint] = reply.faults
        if self._asked is not None:
            self._take_motor_count(*self._asked, feedback)

    def write(
        self,
        wanted: Wanted,
        modes: Sequence[OutputMode],
        output: Sequence[float],
        feedforward_V: Sequence[float],
        feedback: Feedback,
    ) -> None:
        """Send one COMMAND to each board; a board not in its target state gets the next state command instead."""
        sent_V, is_on = feedback.sent_V, wanted.is_on
        for joint, motor, sign in self._pairs:
            mode, state = modes[joint], motor.state
            if is_on and state is _ENABLED and mode is _VOLTAGE:
                sent_V[joint] = voltage_V = output[joint]
                motor.command_voltage(sign * voltage_V)
                continue
            sent_V[joint] = math.nan
            if is_on and state is _ENABLED:
                self._command(joint, motor, sign, mode, output[joint], feedforward_V[joint])
                continue
            target = _ENABLED if wanted is Wanted.ENABLING else DriveState.SWITCH_ON_DISABLED
            if wanted is Wanted.AS_FOUND:
                motor.ask_state()
            elif wanted is Wanted.DISABLED and state is DriveState.FAULT and motor.has_torque:
                motor.step_fault_reset()  # the hold that its time-out began ends, as it was asked for
            elif state is target or state is DriveState.FAULT:
                self._command(joint, motor, sign, mode, output[joint], feedforward_V[joint])
            else:
                with contextlib.suppress(BoardFaulted):  # the watch sees it in the feedback
                    motor.step_towards(target)
        if is_on:
            self._ask_motor_count(feedback)

    def _command(self, joint: int, motor: MotorBoard, sign: float, mode: OutputMode, output: float, forward_V: float) -> None:
        if mode is _VOLTAGE:
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
        return self._sense(self._of(joint).drive) * self._motor_maps[joint].count(q_rad) + self._position_offset_count[joint]

    def _take_motor_count(self, at: int, count: int, feedback: Feedback) -> None:
        """Pair the count of a motor board with that of the encoder board when it was asked for."""
        wired = self._wiring[at]
        if (motor_count := wired.motor.count_taken()) is not None:
            feedback.motor_counts.append((wired.joint, count, self._sense(wired.drive) * motor_count))
            self._asked = None

    def _ask_motor_count(self, feedback: Feedback) -> None:
        """Ask one motor board after the other for the count of its own encoder, while the other count is fresh."""
        self._ask_in -= 1
        if self._ask_in > 0:
            return
        at = (self._ask_next + 1) % len(self._wiring)
        wired = self._wiring[at]
        joint = wired.joint
        if not can_hold(wired.drive):
            self._ask_next = at
        elif self._clock.now_s() - feedback.reported_at_s[joint] <= FRESH_CYCLES * self._period_s:
            self._ask_in, self._ask_next = self._ask_every, at
            self._asked = (at, feedback.count[joint] - feedback.shift_count[joint])
            wired.motor.ask_count()

    def is_any_enabled(self) -> bool:
        """Whether a drive was in OPERATION ENABLED in its last reply."""
        return any(motor.state is DriveState.OPERATION_ENABLED for _, motor, _ in self._pairs)

    def has_torque(self, joint: int) -> bool:
        """Whether the board is in operation, or holds after its watchdog has expired."""
        return self._motor_of[joint].has_torque

    # ---- outside of the cycle: these wait for answers

    def configure(self, fresh_count: Callable[[int], int]) -> None:
        """Upload the parameters of every board that does not have them. WrongIdentity if one that was reset is another one."""
        for wired in self._wiring:
            if self._configured_resets[wired.joint] != wired.motor.resets:
                if wired.motor.resets:
                    wired.motor.identify(self._serial_numbers[wired.joint])
                wired.motor.go_to(DriveState.SWITCH_ON_DISABLED)
                for index, value in self._parameters(wired):
                    wired.motor.write(index, value)
                self._configured_resets[wired.joint] = wired.motor.resets
            self._follow_position_count(wired, fresh_count)

    def acknowledge_faults(self) -> None:
        """Acknowledge the drives' faults. Raises BoardFaulted."""
        for wired in self._wiring:
            wired.motor.acknowledge_fault()

    def follow_shift(self, joint: int, fresh_count: Callable[[int], int]) -> None:
        """The encoder's counter was shifted: until the next read, `count` is from before."""
        self._asked, self._ask_in = None, 2
        self._follow_position_count(self._of(joint), fresh_count)

    def emergency_stop(self) -> None:
        """Broadcast the emergency stop."""
        self._bus.emergency_stop(1)

    def _of(self, joint: int) -> DriveWiring:
        return self._wiring[self.joints.index(joint)]

    def _sense(self, drive: Drive) -> int:
        """Sense of the motor board's own encoder, which counts up with positive voltage, relative to that of its map."""
        return drive.motor_direction * drive.at_motor.encoder_direction

    def _parameters(self, wired: DriveWiring) -> list[tuple[MotorParameter, int]]:
        """Parameters of a board: limits, what it does without the host, and its PID in volts per count of its own encoder."""
        drive = wired.drive
        gains = wired.gains if can_hold(drive) else NO_GAINS
        per_count = abs(self._motor_maps[wired.joint].radians_per_count)
        volts_per_rad_s = drive.gear_ratio * drive.torque_constant_Nm_A
        parameters = [
            (MotorParameter.WATCHDOG_ms, self._watchdog_ms),
            (MotorParameter.WATCHDOG_ACTION, IdleOutput.HOLD),
            (MotorParameter.STOP_AFTER_ms, round(self._board_stop.after_s * 1e3)),
            (MotorParameter.STOP_TIME_ms, round(self._board_stop.time_s * 1e3)),
            (MotorParameter.DISABLED_OUTPUT, IdleOutput.BRAKE),
            (MotorParameter.VOLTAGE_LIMIT_mV, round(drive.supply_V * 1e3)),
            (MotorParameter.KP_uV_count, round(gains.kp * per_count * 1e6)),
            (MotorParameter.KI_uV_count_s, round(gains.ki * per_count * 1e6)),
            (MotorParameter.KD_nV_s_count, round(gains.kd * per_count * 1e9)),
            (MotorParameter.DERIVATIVE_FILTER_us, round(gains.derivative_filter_s * 1e6)),
            (MotorParameter.INTEGRAL_LIMIT_mV, round(FULL_INTEGRAL * drive.supply_V * 1e3)),
            (MotorParameter.SPEED_FEEDFORWARD_nV_s_count, round(volts_per_rad_s * per_count * 1e9)),
        ]
        if math.isfinite(drive.current_limit_A):
            parameters.append((MotorParameter.CURRENT_LIMIT_mA, round(drive.current_limit_A * 1e3)))
        return parameters

    def _follow_position_count(self, wired: DriveWiring, fresh_count: Callable[[int], int]) -> None:
        """Offset of the motor board's count from the encoder board's, both read at rest."""
        drive = wired.drive
        if drive.pid.mode != SetpointMode.POSITION.name.lower():
            return
        joint = wired.joint
        count = self._motor_maps[joint].count(self._maps[joint].radians(fresh_count(joint)))
        own_count = wired.motor.read(MotorParameter.POSITION_COUNT)
        self._position_offset_count[joint] = own_count - self._sense(drive) * count
