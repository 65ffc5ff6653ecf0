"""Timing statistics of the last cycles: lateness, time spent, deadlines missed."""

from collections.abc import Callable

Strain = Callable[[], tuple[int, int]]
KEPT_CYCLES = 500  # a second at the usual rate


class Punctuality:
    """Statistics over the last cycles. `begin` and `end` cost a fraction of a microsecond each.

    `stopwatch_s` reads a clock; a stepped simulation passes its own, so that its recordings are reproducible. `strain` returns
    the page faults and involuntary switches of this thread so far; without it they count as none.
    """

    def __init__(
        self, period_s: float, stopwatch_s: Callable[[], float], strain: Strain | None = None
    ) -> None:
        self.period_s = period_s
        self.missed = 0
        self._stopwatch_s = stopwatch_s
        self._late_s = [0.0] * KEPT_CYCLES
        self._busy_s = [0.0] * KEPT_CYCLES
        self._next = 0
        self._began_s = 0.0
        self._strain = strain
        self._strained = strain() if strain is not None else (0, 0)

    def begin(self, late_s: float, missed: int) -> None:
        """Note a cycle that begins `late_s` after its deadline, with `missed` deadlines since the last."""
        self._began_s = self._stopwatch_s()
        self.missed += missed
        self._late_s[self._next] = late_s

    def end(self) -> float:
        """Note the end of the cycle's work; return its duration in s."""
        busy_s = self._stopwatch_s() - self._began_s
        self._busy_s[self._next] = busy_s
        self._next = (self._next + 1) % KEPT_CYCLES
        return busy_s

    def strain(self) -> tuple[int, int]:
        """Page faults and involuntary switches since the last call: once a cycle, what made it late or long."""
        if self._strain is None:
            return 0, 0
        faults, switches = self._strained
        self._strained = now = self._strain()
        return now[0] - faults, now[1] - switches

    def late_s(self, fraction: float) -> float:
        """Quantile of the lateness over the last cycles, e.g. `fraction` 0.99."""
        return _quantile(self._late_s, fraction)

    def busy_s(self, fraction: float) -> float:
        """Quantile of the time spent over the last cycles."""
        return _quantile(self._busy_s, fraction)


def _quantile(values: list[float], fraction: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]
