"""Events of a recording as text: modes, runs, missed deadlines, drive faults."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

INFORMATION, WARNING, ERROR = 2, 3, 4  # Foxglove's levels
SAID_EVERY_s: Final = 1.0  # missed deadlines come in bursts: one message per second is enough


class CycleChanges:
    """Compares each cycle with the last and describes the changes."""

    def __init__(self, modes: Sequence[str]) -> None:
        self._modes = tuple(modes)
        self._mode, self._run, self._missed = -1, 0, 0
        self._faults: tuple[float, ...] = ()
        self._missed_at_s = -math.inf

    def look(
        self, t_s: float, mode: int, run: int, missed: int, faults: tuple[float, ...]
    ) -> Iterator[tuple[int, str]]:
        """Level and text of every new event in this cycle."""
        if mode != self._mode:
            name = mode_name(self._modes, mode)
            yield ERROR if name == "FAULT" else INFORMATION, f"mode {name}"
        if run != self._run:
            yield INFORMATION, f"run {run} begins"
        if missed > self._missed and t_s - self._missed_at_s >= SAID_EVERY_s:
            yield WARNING, f"{missed - self._missed} deadlines missed, {missed} so far"
            self._missed, self._missed_at_s = missed, t_s
        before = self._faults or (0.0,) * len(faults)
        for joint, (bits, known) in enumerate(zip(faults, before, strict=True), start=1):
            if bits and bits != known:
                yield ERROR, f"drive of joint {joint}: fault bits 0x{int(bits):02x}"
        self._mode, self._run, self._faults = mode, run, faults


def mode_name(modes: Sequence[str], number: float) -> str:
    """The name of a recorded mode; its number if unknown."""
    return modes[int(number)] if 0 <= number < len(modes) else f"mode {int(number)}"
