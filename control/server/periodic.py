"""The cycle timer: absolute deadlines, with a count of those missed.

A deadline is the last one plus the period, never "now plus the period", so lateness does not accumulate; after a pause the
missed deadlines are skipped, not made up in a burst, because a burst of old set-points is worse than a gap. So is one that is
due within half a period after a pause: counts of boards that are timed by their arrival would look too fast.
"""

from firmware_iface.clock import Clock


class PeriodicTimer:
    """Deadlines every `period_s` on a clock.

    `wait` sets `skipped` (deadlines that passed unserved just now), `missed_in_row` and `missed` (all of them). `trim_s` makes
    each period that much longer: see control.server.process.
    """

    def __init__(self, clock: Clock, period_s: float) -> None:
        self.period_s = period_s
        self.trim_s = 0.0
        self.skipped = 0
        self.missed = 0
        self.missed_in_row = 0
        self._clock = clock
        self._deadline_s = clock.now_s() + period_s

    def wait(self) -> float:
        """Wait for the next deadline; returns the lateness at the start of the cycle in s."""
        self._clock.wait_until_s(self._deadline_s)
        late_s = self._clock.now_s() - self._deadline_s
        periods = late_s / self.period_s
        self.skipped = int(
            periods + (0.499 if periods >= 1.0 else 0.0)
        )  # 0.499: rounding errors skip nothing
        self.missed += self.skipped
        self.missed_in_row = self.missed_in_row + self.skipped if self.skipped else 0
        self._deadline_s += (self.skipped + 1) * self.period_s + self.trim_s
        return late_s

    def restart(self) -> None:
        """Restart one period from now, after a wait outside of a cycle that must not count as lateness."""
        self._deadline_s = self._clock.now_s() + self.period_s
