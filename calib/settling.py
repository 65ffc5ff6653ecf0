"""When an iteration ends whose model follows its own result: loads that follow the geometry, laws that bend, gears that jump."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arrays import Mask


class Settling:
    """The one rule of such iterations, of one value or of many side by side, each for itself.

    A contraction's steps get shorter, each by about the same factor. A step that is no shorter than the one before leads away, or
    to and fro between two flanks: it is not taken. What is left to go is about as long as the last step, so a value whose step
    is no longer than what counts has settled. No count of steps is needed: each is shorter than the last.
    """

    def __init__(self) -> None:
        self._last: npt.NDArray[np.float64] = np.array(np.inf)

    @property
    def goes_on(self) -> bool:
        """Whether a value has neither settled nor been led away."""
        return bool(np.any(self._last > 0.0))

    def takes(self, step: npt.ArrayLike, enough: float) -> Mask:
        """Which steps of a length (or lengths, of each value) are to be taken; `enough`, the length that no longer counts."""
        length = np.asarray(step, dtype=np.float64)
        taken = np.asarray(length < self._last)
        self._last = np.where(taken & (length > enough), length, 0.0)
        return taken
