"""The gripper's motor board, for the loop: its current and opening, and the voltage that it gets. `sign`: opening is positive."""

import contextlib
import math
from dataclasses import dataclass
from typing import Protocol

from control.hardware.board_stop import BoardStop
from control.hardware.words import Wanted
from control.model.end_effector import Gripper
from firmware_iface.errors import BoardFaulted, LinkError
from firmware_iface.motor.board import MotorBoard
from firmware_iface.motor.cia402 import DriveState
from firmware_iface.motor.wire import IdleOutput, MotorFault, MotorParameter

FULL_FORCE_AT_m = 1e-3  # of the board's own hold: it pushes with the whole current at this distance from where it was


@dataclass(slots=True)
class GripperFeedback:
    """The board's latest values. `moved_m`: by the motor since power-up, opening positive; NaN without an encoder."""

    current_A: float = 0.0
    moved_m: float = math.nan
    moved_at_s: float = -math.inf
    reply_at_s: float = -math.inf
    is_enabled: bool = False
    faults: str = ""  # of its board, in words
    problem: LinkError | None = None  # it restarted, or sent nonsense; once


def in_words(faults: MotorFault) -> str:
    """The faults of a board by name; empty without any."""
    return ", ".join(str(fault.name).replace("_", " ").lower() for fault in faults)


class TorqueWithTheArm:
    """What is wanted of the gripper's drive: as of the arm's; and ENABLING when its fault was acknowledged."""

    def __init__(self) -> None:
        self._wanted = Wanted.AS_FOUND
        self._is_coming = False

    @property
    def wanted(self) -> Wanted:
        """Of the arm's drives, with ENABLING until this one is there."""
        return Wanted.ENABLING if self._is_coming and self._wanted.is_on else self._wanted

    @wanted.setter
    def wanted(self, of_arm: Wanted) -> None:
        self._is_coming |= of_arm.is_on and not self._wanted.is_on
        self._wanted = of_arm if of_arm is not Wanted.ENABLING else Wanted.ENABLED

    def take_back(self) -> None:
        """Its fault was acknowledged."""
        self._is_coming = True

    def note(self, is_enabled: bool) -> None:
        """Whether it is in operation: from then on it is not taken back."""
        self._is_coming &= not is_enabled


class GripperHardware(Protocol):
    """The gripper's motor, on a board of any kind."""

    feedback: GripperFeedback
    torque: TorqueWithTheArm

    def read(self, now_s: float) -> GripperFeedback:
        """The values by now; the links have been drained before."""
        ...

    def write(self, volts: float | None, now_s: float) -> None:
        """Take the drive a step towards what is wanted, or command a voltage, opening positive, or an open circuit (None)."""
        ...

    def has_torque(self) -> bool:
        """Whether the board drives its motor, or holds it by itself."""
        ...

    def prepare(self) -> None:
        """Upload what the board does not have. Waits."""
        ...

    def reset_fault(self) -> None:
        """Acknowledge the board's fault, if it has one."""
        ...

    def emergency_stop(self) -> None:
        """Stop now, where the joints' stop does not reach it."""
        ...


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
