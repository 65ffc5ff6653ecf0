"""Clocks. Everything that waits does so through a Clock.

In real time, waiting sleeps. On the stepped mock, waiting advances the simulation to that time.
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
        """Return once `now_s() >= t`; immediately if `t` has passed.

        `t` is absolute, so lateness does not accumulate.
        """
        ...


class MonotonicClock:
    """The machine's monotonic clock."""

    def now_s(self) -> float:
        """Seconds since an arbitrary moment."""
        return time.monotonic()

    def wait_until_s(self, t: float) -> None:
        """Sleep until the absolute time `t` [s]."""
        # A sleep may end early by the clock's resolution: check again.
        while (left_s := t - time.monotonic()) > 0.0:
            time.sleep(left_s)
