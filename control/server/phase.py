"""The loop's phase follows the reports of the first encoder board, and a cycle begins when its counts have come.

A board sends by its own clock, some 100 ppm off the host's, and what it sends is under way for a time that nobody tells and that
is not the same twice: the line, the adapter, the kernel. So a deadline lies where some of the reports have come and most have
not, and a cycle waits for the report that is meant for it, as long as BOUND. The report begins the cycle; where in their spread
the deadline lies hardly matters. It creeps there: earlier after a cycle that found its report, later after one that did not.
Balanced, LATER / (EARLIER + LATER) of them find it, a quantile that neither a long tail nor a lost report can drag along. On a
busy host, whose arrivals spread wider than BOUND, cycles that waited in vain bring it up to VAIN / (EARLIER + VAIN).

Which report is meant is told by the board's time stamps, one period after the other, so that lost, doubled and late ones do
not confuse. A board that has sent none for SILENT periods is not waited for.
"""

import math
from collections.abc import Callable

from firmware_iface.clock import Clock

BOUND = 0.1  # of a period: 0.2 ms at 500 Hz, what a cycle waits for its report at most
EARLIER = 6e-4  # of a period, the creeping a cycle; both are more than clocks differ by, 3e-4
LATER = 4e-4
VAIN = 18e-4  # later, after a cycle whose report did not come in time
SILENT = 2.5  # periods
SAME = 0.25  # of a period, between the time stamps of reports that count as the same: boards send two in a period, or one

AwaitCounts = Callable[[float, float], float]


class PhaseFollower:
    """`await_counts` of `control.hardware.interface.Hardware`, for cycles of `period_s`."""

    def __init__(self, await_counts: AwaitCounts, clock: Clock, period_s: float) -> None:
        self._await_counts, self._clock, self._period_s = await_counts, clock, period_s
        self._made_s = -math.inf  # of the report that was meant for the last cycle, by the board's clock
        self._newest_s = math.nan  # of the newest that came

    def wait(self, deadline_s: float, skipped: int) -> float:
        """Wait for the counts of the cycle that was due at `deadline_s`, after `skipped` others.

        Returns how much longer [s] the next period is to be.
        """
        period_s, until_s = self._period_s, deadline_s + BOUND * self._period_s
        is_in_time = self._clock.now_s() < until_s
        meant_s = self._made_s + (1 + skipped) * period_s
        enough_s = meant_s - SAME * period_s
        newest_s = self._await_counts(enough_s, -math.inf)
        was_there, is_silent = newest_s >= enough_s, not newest_s >= meant_s - SILENT * period_s
        if not was_there and not is_silent:
            newest_s = self._await_counts(enough_s, until_s)
        is_new, self._newest_s = newest_s != self._newest_s, newest_s
        has_come = newest_s >= enough_s
        self._made_s = newest_s if has_come or (is_silent and is_new) else meant_s
        if is_silent or not is_in_time:
            return 0.0
        return (-EARLIER if was_there else LATER if has_come else VAIN) * period_s
