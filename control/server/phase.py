"""The loop's phase follows the reports of the first encoder board, so that a cycle begins just after counts have come.

A board sends by its own clock, some 100 ppm off the host's, so without this the age of the counts grows and falls as a saw-
tooth of one report period. Nobody tells when bytes arrive; what can be seen is that a cycle began too early: one report less
was there, and none was lost. (A gap in the board's sequence shows in the next cycle; a cycle that began late has one too many
first.) So the cycles creep earlier until one is too early, and step back. Each step makes the creeping slower by FALL; after
it the creeping gets faster, the more so the longer nothing was met, by GAIN (t + t^3 / 3) after t seconds. Both balance at a
step in 1.5 s, whatever the drift of the clocks and the jitter of the line.
"""

STEP_s = 6e-5  # back, after a cycle that began too early
GAIN_1_s = 2e-5  # rise of the speed of creeping [s/s] per second, just after a step
FALL = 4e-5  # of the speed, at each step
MOST = 5e-4  # of the speed: 1 us a cycle at 500 Hz; crystals differ by less than 3e-4


class PhaseFollower:
    """For `expected` reports a cycle of `period_s` (0: there is nothing to follow)."""

    def __init__(self, expected: int, period_s: float) -> None:
        self._expected, self._period_s = expected, period_s
        self._speed = 0.0  # of creeping earlier [s/s]; negative: later
        self._since_s = 0.0  # the last step
        self._reports = self._lost = 0  # so far
        self._before = self._last = expected  # reports in the last cycle but one, and in the last

    def trim_s(self, reports: int, lost: int, has_missed: bool) -> float:
        """How much longer [s] the next period is to be, after a cycle; frames of the board that came and were lost so far."""
        missing = lost - self._lost
        came = reports - self._reports + missing
        self._reports, self._lost = reports, lost
        expected, was_early = self._expected, self._last < self._expected >= self._before and missing == 0
        self._before, self._last = self._last, came
        if expected == 0:
            return 0.0
        if has_missed:
            self._before = self._last = expected
        elif was_early:
            self._speed, self._since_s = max(self._speed - FALL, -MOST), 0.0
            self._last = expected
            return STEP_s
        elif came == expected:
            self._since_s += self._period_s
            gain = GAIN_1_s * (1.0 + self._since_s * self._since_s)
            self._speed = min(self._speed + gain * self._period_s, MOST)
        return -self._speed * self._period_s
