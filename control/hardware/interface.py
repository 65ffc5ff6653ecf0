"""What the loop asks of an arm's hardware: measured values in, outputs out.

The one seam between the loop and the wires. Values are per joint, in the joint's own sign (board wiring signs are undone
below this seam) and in the encoder's counts; the loop maps counts to angles. Nothing here blocks: `read` drains what has
arrived, `write` hands over what is to be sent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol


class OutputMode(Enum):
    """What the numbers given to `write` are. `OFF` opens the motor circuit: the joint is free and a loaded arm drops."""

    OFF = 0
    VOLTAGE = 1
    CURRENT = 2
    POSITION = 3


@dataclass(slots=True)
class Feedback:
    """What the boards last said. One object for the life of the loop, overwritten by every read; lists have one entry a joint."""

    joint_count: int
    encoder_at_s: float = float("-inf")  # the oldest of the last reports, on the host's clock
    counted_at_s: list[float] = field(
        default_factory=list
    )  # when `count` was latched, on its board's own clock
    reported_at_s: list[float] = field(default_factory=list)  # the last report of the joint's encoder board
    reply_at_s: list[float] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    shift_count: list[int] = field(
        default_factory=list
    )  # added by `shift_count`, as far as `count` includes it
    channel_flags: list[int] = field(default_factory=list)
    current_A: list[float] = field(default_factory=list)
    supply_V: list[float] = field(default_factory=list)
    temperature_C: list[float] = field(default_factory=list)
    statusword: list[int] = field(default_factory=list)
    drive_faults: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        n = self.joint_count
        self.reported_at_s, self.reply_at_s = [float("-inf")] * n, [float("-inf")] * n
        for name in ("count", "shift_count", "channel_flags", "statusword", "drive_faults"):
            setattr(self, name, [0] * n)
        for name in ("counted_at_s", "current_A", "supply_V", "temperature_C"):
            setattr(self, name, [0.0] * n)


class Hardware(Protocol):
    """The arm as the loop sees it; boards on wires behind it, real or mock alike."""

    feedback: Feedback

    def read(self) -> Feedback:
        """Drain the links into `feedback`. Raises LinkLost when a link is gone, ProtocolViolation when a board misbehaves."""
        ...

    def write(self, mode: OutputMode, output: Sequence[float], feedforward_V: Sequence[float]) -> None:
        """Command every joint: V, A or counts as `mode` says; `feedforward_V` is added on the board in POSITION mode."""
        ...

    def enable(self) -> None:
        """Walk every drive to OPERATION ENABLED with 0 V output. Raises a firmware_iface error that names each that would not."""
        ...

    def disable(self) -> None:
        """Open the circuits and walk every drive to SWITCH ON DISABLED. Only for an arm that is at rest."""
        ...

    def reset_drive_faults(self) -> None:
        """Acknowledge the drives' own faults. Raises when a drive stays in FAULT."""
        ...

    def emergency_stop(self) -> None:
        """Broadcast the emergency stop: every board shorts its windings and goes to FAULT. Never raises."""
        ...

    def arm_index(self, joint: int) -> None:
        """Let the next index pulse of joint (0-based) latch its count. Waits some ms for the board's answer."""
        ...

    def index_count(self, joint: int) -> int | None:
        """The count latched since `arm_index`, or None as long as no index has passed."""
        ...

    def shift_count(self, joint: int, counts: int) -> None:
        """Add `counts` to the board's counter of joint (0-based), which stands still, and mark its zero as set.

        Waits some ms for the board's answer. From the next read on, `feedback.count` is counted from the new zero and
        `feedback.shift_count` says by how much it was shifted.
        """
        ...
