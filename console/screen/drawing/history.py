"""The last half minute of plotted values in bins of time; a bin holds the value furthest from zero."""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

BIN_s = 0.25
BINS = 120
SPAN_s = BIN_s * BINS
Message = dict[str, Any]
Bin = list[float] | None  # None: no data


class Series:
    """Values over time, one list per bin, the latest last."""

    def __init__(self) -> None:
        self.bins: deque[Bin] = deque(maxlen=BINS)

    def begin(self, bins_later: int) -> None:
        """Start a new bin, `bins_later` after the last."""
        self.bins.extend([None] * min(bins_later, BINS))

    def add(self, values: Sequence[float]) -> None:
        """Add values to the latest bin."""
        last = self.bins[-1]
        known = [value if math.isfinite(value) else 0.0 for value in values]
        self.bins[-1] = (
            known if last is None else [max(pair, key=abs) for pair in zip(known, last, strict=True)]
        )

    def newest(self) -> list[float]:
        """The latest bin that is not empty."""
        return next((values for values in reversed(self.bins) if values is not None), [])


class History:
    """Tracking error and current of each joint, speed of the tip, lateness of the loop."""

    def __init__(self) -> None:
        self.error_mrad, self.current_A = Series(), Series()
        self.tip_mm_s, self.late_us = Series(), Series()
        self._bin: int | None = None
        self._tip: tuple[float, Sequence[float]] | None = None

    def add(self, status: Message) -> None:
        """Add a status; if its clock went back, it is from another runtime."""
        number = int(status["t_s"] / BIN_s)
        later = BINS if self._bin is None or number < self._bin else number - self._bin
        self._bin = number
        rows = (
            (self.error_mrad, [1e3 * error for error in status["following_error_rad"]]),
            (self.current_A, status["current_A"]),
            (self.tip_mm_s, [1e3 * self._tip_speed_m_s(status)]),
            (self.late_us, [1e6 * status["late_p99_s"]]),
        )
        for series, values in rows:
            series.begin(later)
            series.add(values)

    def _tip_speed_m_s(self, status: Message) -> float:
        tip, now_s = status["tip_set_m"], status["t_s"]
        last, self._tip = self._tip, (now_s, tip) if tip is not None else None
        if tip is None or last is None or now_s <= last[0]:
            return 0.0
        return math.dist(tip, last[1]) / float(now_s - last[0])
