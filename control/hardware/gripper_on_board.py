"""The gripper's motor on a bought board: one more motor to the board's own driver, with a `Feedback` of its own.

The driver knows it as the joint behind the arm's last one, whose angle is that of the motor (`Arm.motors`).
"""

import contextlib
import math
from typing import Protocol, cast

from control.hardware.gripper_board import CountedTravel, GripperFeedback, TorqueWithTheArm, in_words
from control.hardware.interface import Feedback, OutputMode
from control.hardware.roles import Drives, Encoders, Opened, collect
from control.hardware.words import OPERATION_ENABLED, STATE_MASK, ZERO_SET
from control.model.arm import Drive
from control.model.end_effector import Gripper
from control.model.joint_map import JointMap
from firmware_iface.errors import BoardFaulted, BoardReset
from firmware_iface.motor.wire import MotorFault


class GripperOnBoard:
    """Meets `control.hardware.gripper_board.GripperHardware` with a driver of one motor."""

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
    """Meets `control.end_effector.gripper.PlacedHardware`."""

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
