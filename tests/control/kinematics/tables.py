"""Arms that are nothing but a DH table."""

from collections.abc import Iterable, Sequence

from control.model.arm import Arm, Convention, Link, Vector3
from control.model.end_effector import Tool


def arm_of(
    dh: Iterable[Sequence[float]],
    convention: Convention = "standard",
    joints: Sequence[bool] | None = None,
    tool_m: Vector3 = (0.0, 0.0, 0.0),
) -> Arm:
    """An arm with these rows of d, theta, L, alpha; all of its joints turn, unless `joints` says otherwise."""
    rows = [[float(value) for value in row] for row in dh]
    turns = joints if joints is not None else [True] * len(rows)
    links = tuple(Link("revolute" if one else "fixed", *row) for one, row in zip(turns, rows, strict=True))
    return Arm("table", links, dh_convention=convention, tool=Tool(tool_m))
