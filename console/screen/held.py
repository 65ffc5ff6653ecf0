"""Detects whether a key is still held; terminals report presses but not releases.

A held key repeats after a delay of a quarter to half a second, then 10 to 40 times a second. So each press that
arrives renews the jog, and nothing else does: the first press moves the arm a little (until the runtime's dead man's
switch ends it), repeats keep it moving, and when they stop, for whatever reason, the arm stops.
"""

from dataclasses import dataclass

REPEAT_s = 0.2  # closer presses of a key count as holding it
RENEWAL_least_s = 0.04  # closer renewals are skipped


@dataclass(frozen=True, slots=True)
class Press:
    """Meaning of a key press: whether it starts a jog, and whether to notify the runtime."""

    is_new: bool
    is_due: bool


class HeldKey:
    """Follows the presses of jog keys."""

    def __init__(self) -> None:
        self._key = ""
        self._pressed_s = self._sent_s = -1e9

    def press(self, key: str, now_s: float) -> Press:
        """Process a press of `key` at a time of any monotonic clock."""
        is_new = key != self._key or now_s - self._pressed_s > REPEAT_s
        is_due = is_new or now_s - self._sent_s >= RENEWAL_least_s
        self._key, self._pressed_s = key, now_s
        if is_due:
            self._sent_s = now_s
        return Press(is_new, is_due)

    def forget(self) -> None:
        """Treat the next press as a new one."""
        self._key = ""
