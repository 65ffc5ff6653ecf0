"""Whether a key is still held, in a terminal that says when a key goes down and never when it comes up.

A held key repeats, after a delay of a quarter to half a second at first and then 10 to 40 times a second. So each press that
arrives is one renewal of the jog, and nothing else is: the first press moves the arm a little (until the runtime's dead man's
switch ends it), repeats keep it moving, and when they cease, for whatever reason, so does the arm.
"""

from dataclasses import dataclass

REPEAT_s = 0.2  # presses of one key nearer than this are one holding
RENEWAL_least_s = 0.04  # renewals nearer than this say nothing new


@dataclass(frozen=True, slots=True)
class Press:
    """What a press of a key means: whether it begins something, and whether the runtime is to hear of it."""

    is_new: bool
    is_due: bool


class HeldKey:
    """Follows the presses of jog keys."""

    def __init__(self) -> None:
        self._key = ""
        self._pressed_s = self._sent_s = -1e9

    def press(self, key: str, now_s: float) -> Press:
        """A press of `key` at a time of any steady clock."""
        is_new = key != self._key or now_s - self._pressed_s > REPEAT_s
        is_due = is_new or now_s - self._sent_s >= RENEWAL_least_s
        self._key, self._pressed_s = key, now_s
        if is_due:
            self._sent_s = now_s
        return Press(is_new, is_due)

    def forget(self) -> None:
        """The next press is a new one."""
        self._key = ""
