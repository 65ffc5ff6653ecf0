"""The constraint E <= k a of SpringerPlus 5:1771, eq. (4): the mean distance over the k points is at most a.

The sum of distances E2 is the paper's E; minimising it, the constraint is a check. Another objective rho is minimised
subject to it by a multiplier: E2 at the minimum of rho + lambda E2 decreases with lambda, and the lambda
for which E2 = k a is searched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.identify.objective import Objective, SumOfDistances


@dataclass(frozen=True, slots=True)
class Accuracy:
    """The requested average accuracy a, the one reached, and the smallest possible one if it was searched.

    `multiplier` is the lambda, 0 where the constraint does not bind.
    """

    limit_m: float
    mean_m: float
    least_m: float | None = None
    multiplier: float = 0.0

    @property
    def is_met(self) -> bool:
        """Whether E <= k a, to rounding."""
        return self.mean_m <= self.limit_m * (1.0 + 1e-9)

    def in_words(self) -> str:
        """A sentence for the operator."""
        wanted, reached = f"{1e3 * self.limit_m:.4g} mm", f"{1e3 * self.mean_m:.4g} mm"
        if not self.is_met:
            return (
                f"The requested average accuracy of {wanted} cannot be met with these bounds. The result has the smallest"
                f" possible mean distance, {reached}. Request less, widen the bounds, or look for effects other than geometry."
            )
        how = ", at some cost to the objective" if self.multiplier else ""
        return f"The requested average accuracy of {wanted} is met{how}: the mean distance is {reached}."


@dataclass(frozen=True, slots=True)
class WithDistances:
    """`first` plus `multiplier` times the sum of distances; the dual has three columns for each of the two."""

    first: Objective
    multiplier: float
    name: str = "an objective and a share of the sum of distances"
    is_smooth: bool = False

    @property
    def _second(self) -> SumOfDistances:
        return SumOfDistances()

    def distances(self, residuals: Array) -> Array:
        """Those of the first, then the lengths."""
        return np.concatenate((self.first.distances(residuals), self._second.distances(residuals)))

    def value(self, distances_m: Array, smoothing_m: float) -> float:
        """The sum of both."""
        of_first, lengths = self._split(distances_m)
        return self.first.value(of_first, smoothing_m) + self.multiplier * self._second.value(
            lengths, smoothing_m
        )

    def weights(self, distances_m: Array, smoothing_m: float) -> tuple[Array, Array]:
        """Of lengths, (m,)."""
        across, along = self.first.weights(distances_m, smoothing_m)
        more_across, more_along = self._second.weights(distances_m, smoothing_m)
        return across + self.multiplier * more_across, along + self.multiplier * more_along

    def expansion(
        self, residuals: Array, smoothing_m: float, dual: Array | None
    ) -> tuple[Array, Array | None]:
        """The sums of both."""
        one, two = (None, None) if dual is None else (dual[:, :3], dual[:, 3:])
        pull, bend = self.first.expansion(residuals, smoothing_m, one)
        more_pull, more_bend = self._second.expansion(residuals, smoothing_m, two)
        return pull + self.multiplier * more_pull, _matrices(
            bend, len(residuals)
        ) + self.multiplier * _matrices(more_bend, len(residuals))

    def next_dual(
        self, residuals: Array, moved: Array, smoothing_m: float, dual: Array | None
    ) -> Array | None:
        """Both duals, side by side; zeros for an objective without kinks."""
        one, two = (None, None) if dual is None else (dual[:, :3], dual[:, 3:])
        first = self.first.next_dual(residuals, moved, smoothing_m, one)
        second = self._second.next_dual(residuals, moved, smoothing_m, two)
        return np.hstack([np.zeros_like(residuals) if part is None else part for part in (first, second)])

    def _split(self, distances_m: Array) -> tuple[Array, Array]:
        """Split into the parts of the first and the second."""
        a_pose = len(self.first.distances(np.zeros((1, 3))))
        lengths_count = len(distances_m) // (a_pose + 1)
        return distances_m[:-lengths_count], distances_m[-lengths_count:]


def _matrices(bend: Array | None, count: int) -> Array:
    """Any form of a second derivative as matrices, (3, 3, m)."""
    if bend is not None and bend.ndim == 3:
        return bend
    whole = np.zeros((3, 3, count))
    whole[[0, 1, 2], [0, 1, 2]] = 1.0 if bend is None else bend
    return whole
