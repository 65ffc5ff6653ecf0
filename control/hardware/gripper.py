"""The gripper's motor, for the loop: on a reference motor board, or on a bought board, as one more motor to the board's driver.

`GripperBoard` sends volts and takes the board's own count; `sign`: opening is positive. To a bought board's driver the motor is
the joint behind the arm's last one, with a `Feedback` of its own; its angle is that of the motor (`Arm.motors`).
"""

import contextlib
import math
from typing import Protocol, cast

from control.hardware.board_stop import BoardStop
from control.hardware.boards import Drives, Encoders, Opened, collect
from control.hardware.interface import (
    OPERATION_ENABLED,
    STATE_MASK,
    ZERO_SET,
    Feedback,
    GripperFeedback,
    OutputMode,
    TorqueWithTheArm,
    Wanted,
)
from control.model.arm import Drive
from control.model.drive import JointMap
from control.model.end_effector import Gripper
from firmware_iface.errors import BoardFaulted, BoardReset, LinkError
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.motor.wire import IdleOutput, MotorFault, MotorParameter

FULL_FORCE_AT_m = 1e-3  # of the board's own hold: it pushes with the whole current at this distance from where it was


def in_words(faults: MotorFault) -> str:
    """The faults of a board by name; empty without any."""
    return ", ".join(str(fault.name).replace("_", " ").lower() for fault in faults)


class CountedTravel:
    """The way of the fingers from a motor's count of 32 bits, which wraps."""

    def __init__(self, gripper: Gripper) -> None:
        counts = gripper.encoder_counts_per_rev
        self.m_per_count = gripper.motor_direction * gripper.travel_per_turn_m / counts if counts else math.nan
        self._last: int | None = None
        self._moved = 0

    def at(self, count: int) -> float:
        """How far the fingers have moved in all by this count, opening positive."""
        if self._last is not None:
            self._moved += (count - self._last + (1 << 31)) % (1 << 32) - (1 << 31)
        self._last = count
        return self._moved * self.m_per_count

    def count_at(self, moved_m: float) -> int | None:
        """The count at which the fingers have moved by so much; None before there is a count."""
        return None if self._last is None else self._last + round(moved_m / self.m_per_count) - self._moved

    def forget(self) -> None:
        """The next count begins anew: the board has restarted."""
        self._last = None


class GripperBoard:
    """A reference motor board; meets `GripperHardware`.

    Sends one COMMAND for each `write`, and asks for the count of the board's own encoder.
    """

    def __init__(
        self, gripper: Gripper, board: MotorBoard, problems: list[LinkError], watchdog_s: float, stop: BoardStop
    ) -> None:
        """`problems`: those of this board alone. `watchdog_s`, `stop`: as of the joints' boards."""
        self._watchdog_s, self._stop = watchdog_s, stop
        self.feedback = GripperFeedback()
        self._gripper, self._board, self._problems = gripper, board, problems
        self._travel = CountedTravel(gripper)
        self.torque = TorqueWithTheArm()
        self._configured_resets = -1
        self._is_resetting = False
        self._is_asked = False
        self._asked_at_s = -math.inf

    def read(self, now_s: float) -> GripperFeedback:
        """The values by now; the bus has been drained before."""
        feedback, board = self.feedback, self._board
        feedback.problem = self._problems.pop(0) if self._problems else None
        if feedback.problem is not None:
            self._travel.forget()
            self._is_asked = False
        feedback.reply_at_s = board.reply_at_s
        feedback.is_enabled = board.state is DriveState.OPERATION_ENABLED
        self.torque.note(feedback.is_enabled)
        if (reply := board.reply) is not None:
            feedback.current_A = self._gripper.motor_direction * reply.current_A
            feedback.faults = in_words(reply.fault_flags)
        if self._is_asked and (count := board.count_taken()) is not None:
            self._is_asked = False
            feedback.moved_m, feedback.moved_at_s = self._travel.at(count), self._asked_at_s
        return feedback

    def write(self, volts: float | None, now_s: float) -> None:
        """Command a voltage, opening positive, or an open circuit (None). A board on its way gets the next state command."""
        board, torque = self._board, self.torque.wanted
        is_on = torque is Wanted.ENABLING or (torque is Wanted.ENABLED and self.feedback.is_enabled)
        wanted = DriveState.OPERATION_ENABLED if is_on else DriveState.SWITCH_ON_DISABLED
        if torque is Wanted.AS_FOUND:
            board.ask_state()
        elif torque is Wanted.DISABLED and board.state is DriveState.FAULT and board.has_torque:
            board.step_fault_reset()  # the hold that its time-out began ends, as it was asked for
        elif self._is_resetting:
            self._is_resetting = not board.step_fault_reset()
        elif board.state is wanted or board.state is DriveState.FAULT:
            if volts is None:
                board.command_off()
            else:
                board.command_voltage(self._gripper.motor_direction * volts)
        else:
            with contextlib.suppress(BoardFaulted):  # the loop sees it in the feedback
                board.step_towards(wanted)
        if self._gripper.encoder_counts_per_rev and (not self._is_asked or now_s - self._asked_at_s > 0.05):
            self._is_asked, self._asked_at_s = True, now_s
            board.ask_count()

    def has_torque(self) -> bool:
        """Whether the board is in operation, or holds after its watchdog has expired."""
        return self._board.has_torque

    def prepare(self) -> None:
        """Upload the parameters where the board does not have them. Waits."""
        board = self._board
        if self._configured_resets != board.resets:
            if board.state is DriveState.FAULT and board.has_torque:
                board.acknowledge_fault()  # it holds since the time-out of another host
            board.go_to(DriveState.SWITCH_ON_DISABLED)
            for index, value in self._parameters():
                board.write(index, value)
            self._configured_resets = board.resets

    def reset_fault(self) -> None:
        """Let `write` acknowledge the board's fault, if it has one: the arm is held meanwhile, so nothing waits here."""
        self._is_resetting = True
        self.torque.take_back()

    def emergency_stop(self) -> None:
        """The joints' stop is a broadcast, which this board hears, too."""

    def _parameters(self) -> list[tuple[MotorParameter, int]]:
        gripper = self._gripper
        holds = gripper.on_fault == "hold"
        kp_V_m = gripper.resistance_ohm * gripper.current_limit_A / FULL_FORCE_AT_m
        per_count = abs(self._travel.m_per_count) if gripper.encoder_counts_per_rev else 0.0
        return [
            (MotorParameter.WATCHDOG_ms, round(self._watchdog_s * 1e3)),
            (MotorParameter.WATCHDOG_ACTION, IdleOutput.HOLD if holds else IdleOutput.OPEN_CIRCUIT),
            (MotorParameter.STOP_AFTER_ms, round(self._stop.after_s * 1e3)),
            (MotorParameter.STOP_TIME_ms, round(self._stop.time_s * 1e3)),
            (MotorParameter.DISABLED_OUTPUT, IdleOutput.BRAKE if holds else IdleOutput.OPEN_CIRCUIT),
            (MotorParameter.CURRENT_LIMIT_mA, round(gripper.current_limit_A * 1e3)),
            (MotorParameter.VOLTAGE_LIMIT_mV, round(gripper.supply_V * 1e3)),
            (MotorParameter.KP_uV_count, round(kp_V_m * per_count * 1e6)),
            (MotorParameter.KI_uV_count_s, 0),
            (MotorParameter.KD_nV_s_count, 0),
            (MotorParameter.INTEGRAL_LIMIT_mV, round(gripper.resistance_ohm * gripper.current_limit_A * 1e3)),
            (MotorParameter.SPEED_FEEDFORWARD_nV_s_count, round(gripper.constant_N_A * per_count * 1e9)),
        ]


class GripperOnBoard:
    """Meets `control.hardware.interface.GripperHardware` with a driver of one motor."""

    def __init__(self, gripper: Gripper, joint: int, drive: Drives, encoder: Encoders | None) -> None:
        """`joint`: its number to the drivers (0-based); `encoder`: None, or one that nothing turns with, where it has none."""
        self.feedback = GripperFeedback()
        self._joint, self._drive = joint, drive
        self._encoder = encoder if gripper.encoder_counts_per_rev else None
        self._travel = CountedTravel(gripper)
        self._seen = Feedback(joint + 1)
        self.torque = TorqueWithTheArm()
        self._was_known = False  # the count goes on from where it was

    def read(self, now_s: float) -> GripperFeedback:
        """The values by now; the line has been drained before."""
        feedback, seen, joint = self.feedback, self._seen, self._joint
        self._drive.take(seen)
        feedback.problem = None
        feedback.current_A, feedback.reply_at_s = seen.current_A[joint], seen.reply_at_s[joint]
        feedback.is_enabled = seen.statusword[joint] & STATE_MASK == OPERATION_ENABLED
        self.torque.note(feedback.is_enabled)
        feedback.faults = in_words(MotorFault(seen.drive_faults[joint]))
        if self._encoder is not None:
            self._take_count(self._encoder)
        return feedback

    def _take_count(self, encoder: Encoders) -> None:
        feedback, seen, joint = self.feedback, self._seen, self._joint
        encoder.take(seen)
        is_known = bool(seen.channel_flags[joint] & ZERO_SET)
        if self._was_known and not is_known:
            self._was_known = False
            self._travel.forget()
            feedback.problem = BoardReset("gripper: its board restarted and counts anew")
        elif seen.reported_at_s[joint] != feedback.moved_at_s and math.isfinite(seen.reported_at_s[joint]):
            feedback.moved_m = self._travel.at(seen.count[joint])
            feedback.moved_at_s = seen.reported_at_s[joint]

    def write(self, volts: float | None, now_s: float) -> None:
        """Command a voltage, opening positive, or an open circuit (None): shorted windings on a board that cannot open it."""
        self._send(OutputMode.OFF if volts is None else OutputMode.VOLTAGE, volts or 0.0)

    def _send(self, mode: OutputMode, value: float) -> None:
        modes, output = [OutputMode.OFF] * self._joint, [0.0] * self._joint
        modes.append(mode)
        output.append(value)
        self._drive.write(self.torque.wanted, modes, output, output, self._seen)

    def has_torque(self) -> bool:
        """Whether the board drives its motor, or holds it by itself."""
        return self._drive.has_torque(self._joint)

    def prepare(self) -> None:
        """Upload what a restart has lost. Waits for answers."""
        self._drive.configure(self._fresh_count)
        if self._encoder is not None and not self._was_known:
            self._encoder.shift(self._joint, 0)  # the drivers tell by the zero whether a count goes on
            self._travel.forget()
            self._was_known = True

    def reset_fault(self) -> None:
        """Acknowledge the board's fault; it stays where its cause persists."""
        self.torque.take_back()
        with contextlib.suppress(BoardFaulted):
            self._drive.acknowledge_faults()

    def emergency_stop(self) -> None:
        """Stop now; acknowledged with the joints' drives."""
        self._drive.emergency_stop()

    def _fresh_count(self, joint: int) -> int:
        return 0 if self._encoder is None else self._encoder.fresh_count(joint)


class ForceLimited(Drives, Protocol):
    """A driver of motors whose boards close the position loop and keep a force limit."""

    def require_force_limit(self) -> None:
        """Raise WrongIdentity if the board is set up to keep none."""
        ...

    def limit_force(self, current_A: float) -> None:
        """At most so much current from now on; does not wait."""
        ...


class PlacedOnBoard(GripperOnBoard):
    """Meets `control.end_effector.PlacedHardware`."""

    def __init__(self, gripper: Gripper, motor: Drive, drive: ForceLimited, encoder: Encoders) -> None:
        """`motor`: as of `Arm.motors`."""
        super().__init__(gripper, motor.joint - 1, drive, encoder)
        self._force, self._map = drive, JointMap(motor)

    def place(self, moved_m: float | None, force_A: float, now_s: float) -> None:
        """Go to where the fingers have moved by so much, with at most this current; None: let go."""
        self._force.limit_force(force_A)
        count = None if moved_m is None else self._travel.count_at(moved_m)
        if count is None:
            self._send(OutputMode.OFF, 0.0)
        else:
            self._send(OutputMode.POSITION, self._map.radians(count))


def gripper_of(opened: Opened) -> GripperOnBoard | None:
    """The arm's gripper, if a bought board drives it: its drive and encoder are taken out of those that were opened."""
    arm = opened.arm
    gripper, joint = arm.gripper, arm.joint_count
    drive = next((one for one in opened.drives if joint in one.joints), None)
    encoder = next((one for one in opened.encoders if joint in one.joints), None)
    if gripper is None or drive is None:
        return None
    opened.drives.remove(drive)
    if encoder is not None:
        opened.encoders.remove(encoder)
    motor = arm.motors[-1]
    if not arm.kind_of(motor).limits_force or encoder is None:
        return GripperOnBoard(gripper, joint, drive, encoder)
    limited = cast(ForceLimited, drive)
    with collect(opened.failures):
        limited.require_force_limit()
    return PlacedOnBoard(gripper, motor, limited, encoder)
