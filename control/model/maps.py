"""Measured correction maps of an arm.toml: what a joint does beyond every effect that has a name (docs/formats.md#maps);
and the smooth table that follows one.

A map is a table over one variable, as the compensation tables of machine tools and the anticogging maps of motor boards. It says
what was measured, never why: it is no effect, has no law, and is good only where it was measured.

A smooth table is a cubic spline over equally spaced nodes: value, slope and bend (second derivative) without a step anywhere.
The slope is zero at both ends and beyond them, where the table keeps its end value; or the table goes round. Slopes m at the
nodes follow from a continuous second derivative (de Boor, A Practical Guide to Splines, ch. IV; h: step, y: values):

    m[i-1] + 4 m[i] + m[i+1] = 3 (y[i+1] - y[i-1]) / h

Plain floats: it is looked up in every cycle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import floor, tau
from typing import Annotated, Final, Literal, Self

from control.model.rules import ONE_OR_MORE

Corrects = Literal["angle_rad", "torque_Nm"]
Over = Literal["angle_rad", "motor_turn_rad", "load_Nm", "speed_rad_s"]
OVER_OF: Final[dict[Corrects, tuple[Over, ...]]] = {
    "angle_rad": ("angle_rad", "load_Nm"),
    "torque_Nm": ("angle_rad", "motor_turn_rad", "load_Nm", "speed_rad_s"),
}
NODES_LEAST: Final = 4
LARGEST_rad: Final = 0.1  # of an angle: a joint that is further off is not where any encoder says
STEEPEST: Final = 0.2  # of an angle over the angle: a joint whose encoder is off by more is not calibrated but broken


@dataclass(frozen=True, slots=True)
class CorrectionMap:
    """A smooth table of one joint: `values` at equally spaced nodes from `lower` to `upper` of the variable `over`.

    Beyond its ends it keeps its end value. Over a motor turn it goes round: its last node is one step before the first.
    """

    joint: Annotated[int, ONE_OR_MORE, "that is corrected"]
    corrects: Annotated[Corrects, "how far the joint is ahead of its encoder, or torque that the motor has to add"]
    over: Annotated[Over, "encoder angle, motor angle within a turn, torque of the links, or speed"]
    values: Annotated[tuple[float, ...], "at the nodes, 4 or more, joined by a cubic spline"]
    lower: Annotated[float, "place of the first node; none for a motor's turn"] = 0.0
    upper: Annotated[float, "place of the last node; none for a motor's turn"] = tau
    by_direction: Annotated[tuple[float, ...], "added in positive motion, subtracted in negative"] = ()

    @property
    def is_periodic(self) -> bool:
        """Whether the table goes round."""
        return self.over == "motor_turn_rad"

    def __str__(self) -> str:
        """As `joint 2's angle over its load`."""
        over = {"angle_rad": "its angle", "motor_turn_rad": "the motor's turn", "load_Nm": "its load", "speed_rad_s": "its speed"}
        return f"joint {self.joint}'s {self.corrects.split('_')[0]} over {over[self.over]}"


Fault = Callable[[tuple[str, ...], str, str], Exception]


def check_map(entry: CorrectionMap, joints: int, driven: frozenset[int], fault: Fault) -> None:
    """Raise `fault(path inside the map, expected, got)` for a map that cannot be followed. `driven`: joints with a drive."""
    if entry.joint > joints:
        raise fault(("joint",), f"a joint from 1 to {joints}", str(entry.joint))
    if entry.over not in OVER_OF[entry.corrects]:
        raise fault(("over",), " or ".join(f'"{over}"' for over in OVER_OF[entry.corrects]), f'"{entry.over}"')
    if len(entry.values) < NODES_LEAST:
        raise fault(("values",), f"at least {NODES_LEAST} values", f"{len(entry.values)} of them")
    if entry.by_direction and len(entry.by_direction) != len(entry.values):
        raise fault(("by_direction",), f"{len(entry.values)} values, as many as in values", f"{len(entry.by_direction)} of them")
    if entry.is_periodic:
        if (entry.lower, entry.upper) != (0.0, tau):
            raise fault(("lower",), "no lower and upper: the table is one turn of the motor", str(entry.lower))
        if entry.joint not in driven:
            raise fault(("over",), "a [[drive]] of the joint: its gear_ratio says how far the motor turns", "none")
    elif not entry.lower < entry.upper:
        raise fault(("upper",), "more than lower", f"{entry.upper} (lower is {entry.lower})")
    if entry.corrects == "angle_rad" and max(map(abs, (*entry.values, *entry.by_direction))) > LARGEST_rad:
        raise fault(("values",), f"angles of up to {LARGEST_rad} rad", "a larger one")
    if entry.corrects == "angle_rad" and entry.over == "angle_rad":
        step = (entry.upper - entry.lower) / (len(entry.values) - 1)
        steep = max(abs(b - a) / step for a, b in pairwise(entry.values))
        if steep > STEEPEST:
            raise fault(("values",), f"values that change by at most {STEEPEST} rad per rad", f"{steep:.3g}")


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
