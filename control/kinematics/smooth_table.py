"""A table over equally spaced nodes as a cubic spline: value, slope and bend (second derivative) without a step anywhere.

The slope is zero at both ends and beyond them, where the table keeps its end value; or the table goes round. Slopes m at the
nodes follow from a continuous second derivative (de Boor, A Practical Guide to Splines, ch. IV; h: step, y: values):

    m[i-1] + 4 m[i] + m[i+1] = 3 (y[i+1] - y[i-1]) / h

Plain floats: it is looked up in every cycle.
"""

from collections.abc import Sequence
from math import floor
from typing import Self

from control.model.maps import CorrectionMap

Cubic = tuple[float, float, float, float]  # coefficients of 1, t, t^2, t^3, with t from 0 to 1 between two nodes


class SmoothTable:
    """`values` from `lower` to `upper`; `is_periodic`: the node after the last is the first again, at `upper`."""

    __slots__ = ("_is_periodic", "_lower", "_pieces", "_step", "_upper", "_values")

    def __init__(self, values: Sequence[float], lower: float, upper: float, is_periodic: bool = False) -> None:
        self._values, self._is_periodic = tuple(values), is_periodic
        self._lower, self._upper = lower, upper
        self._pieces = pieces(values, is_periodic)
        self._step = (upper - lower) / len(self._pieces)

    @classmethod
    def of(cls, entry: CorrectionMap) -> Self:
        """What a map adds in both directions."""
        return cls(entry.values, entry.lower, entry.upper, entry.is_periodic)

    @classmethod
    def of_direction(cls, entry: CorrectionMap) -> Self | None:
        """What a map adds in positive motion, if it tells the directions apart."""
        return cls(entry.by_direction, entry.lower, entry.upper, entry.is_periodic) if entry.by_direction else None

    def __call__(self, x: float) -> float:
        """The value at x."""
        piece, t = self._place(x)
        a, b, c, d = self._pieces[piece]
        return a + t * (b + t * (c + t * d))

    def derivatives(self, x: float) -> tuple[float, float, float]:
        """Value, slope and bend at x."""
        if not self._is_periodic and not self._lower <= x <= self._upper:
            return self(x), 0.0, 0.0
        piece, t = self._place(x)
        a, b, c, d = self._pieces[piece]
        h = self._step
        return (a + t * (b + t * (c + t * d)), (b + t * (2.0 * c + t * 3.0 * d)) / h, (2.0 * c + 6.0 * t * d) / (h * h))

    @property
    def largest(self) -> float:
        """Of the values, without sign; between the nodes it is hardly more."""
        return max(abs(value) for value in self._values)

    def _place(self, x: float) -> tuple[int, float]:
        """Piece and place in it, 0 to 1."""
        count, at = len(self._pieces), (x - self._lower) / self._step
        if self._is_periodic:
            at -= count * floor(at / count)
        piece = int(min(max(at, 0.0), count - 1.0))
        return piece, min(max(at - piece, 0.0), 1.0)


def pieces(values: Sequence[float], is_periodic: bool = False) -> tuple[Cubic, ...]:
    """The cubic between each node and the next."""
    slopes = node_slopes(values, is_periodic)
    y, m = (*values, values[0]), (*slopes, slopes[0])
    count = len(values) if is_periodic else len(values) - 1
    return tuple(
        (y[i], m[i], 3.0 * (y[i + 1] - y[i]) - 2.0 * m[i] - m[i + 1], 2.0 * (y[i] - y[i + 1]) + m[i] + m[i + 1])
        for i in range(count)
    )


def node_slopes(values: Sequence[float], is_periodic: bool = False) -> list[float]:
    """Slope at every node times the step."""
    n = len(values)
    if not is_periodic:
        inner = _tridiagonal([3.0 * (values[i + 1] - values[i - 1]) for i in range(1, n - 1)], 4.0, 4.0)
        return [0.0, *inner, 0.0]
    # the corners of the cyclic matrix as a correction of rank one (Sherman and Morrison)
    right = [3.0 * (values[(i + 1) % n] - values[i - 1]) for i in range(n)]
    corner = [1.0, *[0.0] * (n - 2), 1.0]
    plain, turned = _tridiagonal(right, 3.0, 3.0), _tridiagonal(corner, 3.0, 3.0)
    share = (plain[0] + plain[-1]) / (1.0 + turned[0] + turned[-1])
    return [p - share * t for p, t in zip(plain, turned, strict=True)]


def _tridiagonal(right: Sequence[float], first: float, last: float) -> list[float]:
    """Solves a matrix of ones beside a diagonal of fours, whose first and last elements are given."""
    n = len(right)
    diagonal = [first, *[4.0] * (n - 2), last] if n > 1 else [first]
    solved = list(right)
    for i in range(1, n):
        share = 1.0 / diagonal[i - 1]
        diagonal[i] -= share
        solved[i] -= share * solved[i - 1]
    solved[-1] /= diagonal[-1]
    for i in range(n - 2, -1, -1):
        solved[i] = (solved[i] - solved[i + 1]) / diagonal[i]
    return solved
