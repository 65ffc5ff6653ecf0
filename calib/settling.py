"""When an iteration ends whose model follows its own result: loads that follow the geometry, laws that bend, gears that jump."""

from __future__ import annotations

from collections import deque

import numpy as np
import numpy.typing as npt

from calib.arrays import Mask

STEPS_MOST = 300  # that are useful where one costs milliseconds: at nine tenths of the step before, nine powers of ten take 200
FITS_MOST = 40  # where each is a fit of its own
JUDGED_BY = 4  # steps, whose mean rate says how many are left: one alone may be slow by chance


class Settling:
    """The one rule of such iterations, of one value or of many side by side, each for itself.

    A contraction's steps get shorter, each by about the same factor r. A step that is no shorter than the one before leads away,
    or to and fro between two flanks: it is not taken. What is left to go is about as long as the last step, so a value whose step
    s is no longer than what counts, e, has settled. Until then log(s / e) / log(1 / r) steps are left: a value that would not
    settle within `most` of them is left where it is, and is `slow`.
    """

    def __init__(self, most: int = STEPS_MOST) -> None:
        self._most, self._count = most, 0
        self._last: npt.NDArray[np.float64] = np.array(np.inf)
        self._before: deque[npt.NDArray[np.float64]] = deque(maxlen=JUDGED_BY)
        self.slow: Mask = np.array(False)

    @property
    def goes_on(self) -> bool:
        """Whether a value has neither settled nor been led away, and may settle in a useful number of steps."""
        return bool(np.any(self._last > 0.0))

    def takes(self, step: npt.ArrayLike, enough: float) -> Mask:
        """Which steps of a length (or lengths, of each value) are to be taken; `enough`, the length that no longer counts."""
        length = np.asarray(step, dtype=np.float64)
        is_taken = np.asarray(length < self._last)
        goes_on = is_taken & (length > enough)
        self._count += 1
        if self._count >= self._most:
            self.slow = self.slow | goes_on
        elif len(self._before) == JUDGED_BY:
            self.slow = self.slow | (goes_on & (self._count + self._left(length, enough) > self._most))
        goes_on &= ~self.slow
        self._before.append(length)
        self._last = np.where(goes_on, length, 0.0)
        return is_taken

    def _left(self, length: npt.NDArray[np.float64], enough: float) -> npt.NDArray[np.float64]:
        """Steps from this length to `enough`, at the mean rate of the last ones."""
        with np.errstate(divide="ignore", invalid="ignore"):
            rate = np.log(self._before[0] / length) / len(self._before)
            return np.asarray(np.log(length / enough) / rate)
