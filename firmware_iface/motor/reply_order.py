"""Assigns each REPLY to its COMMAND by the 5-bit echoed sequence."""

from firmware_iface.motor.wire import SEQUENCE_MASK

_LATEST_LAG = 16  # half of the 5-bit sequence: an older reply is ambiguous


class ReplyOrder:
    """Distinguishes new replies from late, duplicated and foreign ones, and counts missing ones."""

    def __init__(self) -> None:
        self.lost = 0
        self.stale = 0
        self.doubled = 0
        """Duplicate replies since the last COMMAND that was answered exactly once."""
        self._last: int | None = None
        self._was_doubled = False

    def forget(self) -> None:
        """Reset after a restart of the board."""
        self._last = None

    def is_newer(self, echoed: int, last_sent: int, commands_sent: int) -> bool:
        """Whether a reply answers a newer COMMAND than the latest one answered."""
        lag = (last_sent - echoed) & SEQUENCE_MASK
        if lag >= commands_sent or lag >= _LATEST_LAG:
            self.stale += 1  # to a previous host, or from before a pause
            return False
        step = 1 if self._last is None else (echoed - self._last) & SEQUENCE_MASK
        if step == 0:
            self.stale += 1
            self.doubled += 1
            self._was_doubled = True
            return False
        if step >= _LATEST_LAG:
            self.stale += 1
            return False
        if not self._was_doubled:
            self.doubled = 0
        self._was_doubled = False
        self._last = echoed
        self.lost += step - 1
        return True
