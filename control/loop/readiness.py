"""Follows the drives to OPERATION ENABLED; a fault for each that does not get there in time."""

import math
from collections.abc import Sequence

from control.hardware.interface import Feedback
from control.hardware.words import OPERATION_ENABLED, STATE_MASK
from control.safety.fault import Fault, Reaction

ENABLE_LIMIT_S = 1.0  # a drive takes three cycles; a second means an emergency stop


class DriveReadiness:
    """Follows the drives to OPERATION ENABLED; `is_ready` once all of them have been there since `expect`."""

    def __init__(self, joint_names: Sequence[str]) -> None:
        self.is_ready = False
        self._names = joint_names
        self._expected_from_s = math.inf

    @property
    def is_awaited(self) -> bool:
        """Whether drives are still changing state, within the time limit."""
        return not self.is_ready and self._expected_from_s != math.inf

    def expect(self, now_s: float) -> None:
        """The drives were just commanded to OPERATION ENABLED."""
        self.is_ready = False
        self._expected_from_s = now_s

    def forget(self) -> None:
        """Stop expecting the drives to be enabled."""
        self.is_ready = False
        self._expected_from_s = math.inf

    def follow(self, now_s: float, feedback: Feedback) -> list[Fault]:
        """Check the latest states; one fault for each drive that is too late."""
        if self.is_ready or self._expected_from_s == math.inf:
            return []
        missing = [joint for joint in range(feedback.joint_count) if not _is_enabled(feedback, joint)]
        self.is_ready = not missing
        if not missing or now_s - self._expected_from_s <= ENABLE_LIMIT_S:
            return []
        self._expected_from_s = math.inf
        return [self._not_enabled(feedback, joint) for joint in missing]

    def _not_enabled(self, feedback: Feedback, joint: int) -> Fault:
        return Fault(
            "drive_not_enabled",
            self._names[joint],
            f"its drive did not reach OPERATION ENABLED within {ENABLE_LIMIT_S:.1f} s (statusword"
            f" 0x{feedback.statusword[joint]:02x}, fault bits 0x{feedback.drive_faults[joint]:02x})",
            "check its supply and the emergency stop",
            Reaction.BRAKE,
        )


def is_any_enabled(feedback: Feedback) -> bool:
    """Whether a drive was in OPERATION ENABLED in its last reply."""
    return any(_is_enabled(feedback, joint) for joint in range(feedback.joint_count))


def _is_enabled(feedback: Feedback, joint: int) -> bool:
    return feedback.statusword[joint] & STATE_MASK == OPERATION_ENABLED
