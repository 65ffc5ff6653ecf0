"""What is wanted of the drives, and whether they are there: the one record of it, and the comparison in every cycle;
and whether the arm rests, for which the way off waits between its steps.

`drives_wanted` derives it from the mode and from where the arm is on its way to; so OFF cannot leave a drive on, whatever was
asked before and however requests cross. Only a take-over of boards that hold the arm sets it itself, as it begins: nothing leads
back from it. A fault neither: boards on their way hold nothing, and the joint of each would sink. The loop hands it to the boards
with each command.
"""

import math
from collections.abc import Sequence
from enum import Enum

from control.hardware.interface import OPERATION_ENABLED, STATE_MASK, Feedback, Wanted
from control.loop.watch import faults_of_drive
from control.safety.modes import Fault, Mode, Reaction

CHANGE_LIMIT_S = 1.0  # a drive takes three cycles; a second means an emergency stop, or another program


class Bound(Enum):
    """Where the arm is on its way to by itself, by the last request about it: one at a time."""

    NOWHERE = ""
    ON = "switched on"  # from OFF or HELD, and then held
    HOLD = "brought to hold"  # from BRAKED or GUIDING
    OFF = "switched off"
    QUIT = "switched off, and the runtime ends"

    def __init__(self, _: str) -> None:
        self.is_hold: bool = self.name in ("ON", "HOLD")
        """Whether the arm will hold."""
        self.is_off: bool = self.name in ("OFF", "QUIT")
        """Whether the drives will go off."""


# Members of an enumeration are slow to look up in Python 3.11, and each cycle asks for these.
_OFF, _FAULT, _HELD = Mode.OFF, Mode.FAULT, Mode.HELD
_DISABLED, _ENABLING, _ENABLED = Wanted.DISABLED, Wanted.ENABLING, Wanted.ENABLED


def drives_wanted(mode: Mode, bound: Bound, before: Wanted, is_taken_over: bool = False) -> Wanted:
    """What is wanted of the drives in a mode. Only on the way to hold are they switched on; a fault ends that.

    In HELD boards go on by themselves until a take-over begins, which goes to its end; in FAULT what was off stays off.
    `is_taken_over`: boards that held the arm are, and have not all confirmed it.
    """
    if mode is _OFF:
        return _DISABLED
    if not before.is_on and (mode is _FAULT or mode is _HELD):
        return before
    if mode is _HELD or is_taken_over or (bound.is_hold and mode is not _FAULT):
        return _ENABLING
    return _ENABLED


class DriveStates:
    """Compares what the boards say with what is wanted of them; `is_ready` while all of them are in operation, as wanted."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        self.wanted = Wanted.AS_FOUND
        self.is_ready = False
        self.is_taken_over = False  # from the beginning of a take-over until all are in operation, or are late
        self._names = joint_names
        self._since_s = math.inf
        self._unwanted_since_s = [math.inf] * len(joint_names)

    def want(self, now_s: float, wanted: Wanted) -> Wanted:
        """What is wanted from now on; ENABLING of drives that are all in operation is done."""
        if wanted is _ENABLING and self.is_ready and self.wanted.is_on:
            wanted = _ENABLED
        self.is_taken_over &= wanted is _ENABLING
        if wanted is not self.wanted:
            self._since_s = now_s
            self._unwanted_since_s = [math.inf] * len(self._names)
            self.is_ready &= wanted.is_on and self.wanted.is_on
        self.wanted = wanted
        return wanted

    def take_over(self, now_s: float) -> None:
        """Boards that hold the arm are to go on under control."""
        self.want(now_s, Wanted.ENABLING)
        self.is_taken_over = True

    def doubt(self) -> None:
        """Drives were reset or have left operation: they are ready again when all say so."""
        self.is_ready = False

    def out_of_operation(self, feedback: Feedback) -> list[str]:
        """The joints whose drives have left operation and are not taken back."""
        if self.wanted is not Wanted.ENABLED or self.is_ready:
            return []
        return [name for joint, name in enumerate(self._names) if not _is_enabled(feedback, joint)]

    def follow(self, now_s: float, feedback: Feedback) -> list[Fault]:
        """Look at the latest states: faults of each drive that is in FAULT on its way on, or too late on its way on or off."""
        if self.wanted is _DISABLED:
            return self._still_on(now_s, feedback)
        if self.is_ready or not self.wanted.is_on:
            return []
        missing = [joint for joint in range(feedback.joint_count) if not _is_enabled(feedback, joint)]
        self.is_ready = not missing
        if not missing or self.wanted is not Wanted.ENABLING:
            return []
        is_late = now_s - self._since_s > CHANGE_LIMIT_S
        self.is_taken_over &= not is_late
        faults: list[Fault] = []
        for joint in missing:
            if bits := feedback.drive_faults[joint]:
                faults += faults_of_drive(self._names[joint], bits)
            elif is_late:
                faults.append(self._not_enabled(feedback, joint))
        return faults

    def _still_on(self, now_s: float, feedback: Feedback) -> list[Fault]:
        faults = []
        for joint in range(feedback.joint_count):
            if not feedback.has_torque[joint]:
                self._unwanted_since_s[joint] = math.inf
            elif now_s - min(self._unwanted_since_s[joint], now_s) > CHANGE_LIMIT_S:
                faults.append(self._not_disabled(joint))
            elif self._unwanted_since_s[joint] == math.inf:
                self._unwanted_since_s[joint] = now_s
        return faults

    def _not_enabled(self, feedback: Feedback, joint: int) -> Fault:
        return Fault(
            "drive_not_enabled",
            self._names[joint],
            f"its drive did not reach OPERATION ENABLED within {CHANGE_LIMIT_S:.1f} s (statusword"
            f" 0x{feedback.statusword[joint]:02x})",
            "check its supply and the emergency stop",
            Reaction.HOLD,  # boards of a take-over; from OFF there is nothing to hold
        )

    def _not_disabled(self, joint: int) -> Fault:
        return Fault(
            "drive_not_disabled",
            self._names[joint],
            f"its drive has had torque for {CHANGE_LIMIT_S:.1f} s although the arm is off, and does not let it go",
            "cut the supply before anybody touches the arm; then look for another program that commands it",
            Reaction.BRAKE,
        )


def _is_enabled(feedback: Feedback, joint: int) -> bool:
    return feedback.statusword[joint] & STATE_MASK == OPERATION_ENABLED


STILL_S = 0.5
STILL_rad_s = 0.02  # one count of the reference arm in one cycle is 0.015 rad/s
# Shorted windings lower the reference arm from any pose within this time; its encoders may be dead.
SINK_LIMIT_S = 15.0


class Standstill:
    """Follows the joints' speeds since the mode was entered at `mode_from_s`."""

    def __init__(self) -> None:
        self.mode_from_s = 0.0
        self._still_from_s = 0.0

    def enter_mode(self, now_s: float) -> None:
        """Restart the detection because a mode was entered."""
        self.mode_from_s = self._still_from_s = now_s

    def is_still(self, now_s: float, speed_rad_s: Sequence[float]) -> bool:
        """Whether nothing has moved for a while, or so much time has passed that any arm has come to rest."""
        if now_s - self.mode_from_s > SINK_LIMIT_S:
            return True
        if any(abs(speed) > STILL_rad_s for speed in speed_rad_s):
            self._still_from_s = now_s
        return now_s - self._still_from_s >= STILL_S
