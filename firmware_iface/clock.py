"""Time as the devices see it: whoever waits, waits through a Clock.

Real time sleeps; the stepped mock lets the simulation run on until the wanted time.
Device code is the same on both.
"""

import time
from typing import Protocol


class Clock(Protocol):
    """A monotonic clock in seconds with an arbitrary zero."""

    def now_s(self) -> float:
        """The time now [s]; never runs backwards."""
        ...

    def wait_until_s(self, t: float) -> None:
        """Return once `now_s() >= t`, at once if that is so already.

        `t` is absolute, so that lateness does not add up.
        """
        ...


class MonotonicClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """Seconds since an arbitrary moment."""
        return time.monotonic()

    def wait_until_s(self, t: float) -> None:
        """Sleep until the absolute time `t` [s]."""
        # A sleep may end early by the clock's resolution: look again until the time has come.
        while (left_s := t - time.monotonic()) > 0.0:
            time.sleep(left_s)
