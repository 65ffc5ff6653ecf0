"""How punctual the loop is: late starts, time spent, deadlines missed; over the last cycles, for people to read."""

from collections.abc import Callable

KEPT_CYCLES = 500  # a second at the usual rate


class Punctuality:
    """Statistics over the last cycles. `begin` and `end` cost a fraction of a microsecond each.

    `stopwatch_s` reads a clock; a stepped simulation hands in its own, so that its recordings are the same every time.
    """

    def __init__(self, period_s: float, stopwatch_s: Callable[[], float]) -> None:
        self.period_s = period_s
        self.missed = 0
        self._stopwatch_s = stopwatch_s
        self._late_s = [0.0] * KEPT_CYCLES
        self._busy_s = [0.0] * KEPT_CYCLES
        self._next = 0
        self._began_s = 0.0

    def begin(self, late_s: float, missed: int) -> None:
        """A cycle begins `late_s` after its deadline, `missed` deadlines after the last."""
        self._began_s = self._stopwatch_s()
        self.missed += missed
        self._late_s[self._next] = late_s

    def end(self) -> float:
        """The cycle's work is done; returns how long it took in s."""
        busy_s = self._stopwatch_s() - self._began_s
        self._busy_s[self._next] = busy_s
        self._next = (self._next + 1) % KEPT_CYCLES
        return busy_s

    def late_s(self, fraction: float) -> float:
        """Lateness that `fraction` of the last cycles kept within, e.g. 0.99."""
        return _quantile(self._late_s, fraction)

    def busy_s(self, fraction: float) -> float:
        """Time spent that `fraction` of the last cycles kept within."""
        return _quantile(self._busy_s, fraction)


def _quantile(values: list[float], fraction: float) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]
