"""Measured correction maps of an arm.toml: what a joint does beyond every effect that has a name (docs/formats.md#maps).

A map is a table over one variable, as the compensation tables of machine tools and the anticogging maps of motor boards. It says
what was measured, never why: it is no effect, has no law, and is good only where it was measured.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import tau
from typing import Annotated, Final, Literal

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
