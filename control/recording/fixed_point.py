"""How finely each column of a recording is stored, and from what its next value is predicted.

A stored value is an integer: the value times `per_unit`, rounded; exact for what is counted, and for what has no entry here,
whose bits are taken. What goes into the file is the `order`-th difference of these integers over the rows, which is
zero or small for what moves smoothly. A column `beside` another one is told by what remains of it after the other.
Resolutions are far below the noise of what they store: a count is 3e-5 rad, the boards send mA, mV and us.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

NO_COLUMN: Final = -1
ORDER_MOST: Final = 3
FLOATS: Final = "fd"
WHOLE: Final = "bBhHiI"
LARGEST: Final = 1 << 59  # 18 years in ns; three differences stay within 64 bits


@dataclass(frozen=True, slots=True)
class Kind:
    """`per_unit` integers a unit (0: the value's bits), `order` of differences, and the column beside."""

    per_unit: int
    order: int
    beside: str = ""


COUNTED: Final = Kind(1, 1)
BITS: Final = Kind(0, 1)
KINDS: Final[Mapping[str, Kind]] = {
    # The host's clock counts ns. Without its lateness a cycle comes exactly one period after the last.
    "t_s": Kind(10**9, 2, "late_s"),
    "cycle": Kind(1, 2),
    "late_s": Kind(10**9, 1),
    "busy_s": Kind(10**6, 1),
    "age_s": Kind(10**5, 1),
    "payload_kg": Kind(10**6, 1),
    "x_m": Kind(10**7, 1),
    "y_m": Kind(10**7, 1),
    "z_m": Kind(10**7, 1),
    "q{}_rad": Kind(10**10, 1, "count{}"),
    "q{}_set_rad": Kind(10**10, 3),
    "joint{}_rad": Kind(10**10, 1, "q{}_rad"),
    "joint{}_set_rad": Kind(10**10, 2, "q{}_set_rad"),
    "speed{}_rad_s": Kind(10**6, 1),
    "speed{}_set_rad_s": Kind(10**7, 3),
    "count{}": Kind(1, 2),
    "counted{}_s": Kind(10**6, 2),
    "u{}_V": Kind(10**4, 1),
    "i{}_A": Kind(10**3, 1),
    "supply{}_V": Kind(10**3, 1),
    "temperature{}_C": Kind(10**2, 1),
    "gripper_m": Kind(10**7, 1),
    "gripper_goal_m": Kind(10**7, 1),
    "gripper_A": Kind(10**3, 1),
}


@dataclass(frozen=True, slots=True)
class StoredColumn:
    """A column as it is stored; `beside` is the index of another one, and `factor` its integers in ours."""

    code: str
    per_unit: int
    order: int
    beside: int = NO_COLUMN
    factor: float = 0.0

    @property
    def has_holes(self) -> bool:
        """Whether NaN has a code of its own: 0, and all other codes are one larger."""
        return self.code in FLOATS and self.per_unit > 0 and self.order == 1


def stored_columns(
    names: Sequence[str], codes: str, rad_per_count: Sequence[float] = ()
) -> tuple[StoredColumn, ...]:
    """How columns of these names and `struct` codes are stored; `rad_per_count` of each joint's encoder, if known."""
    return tuple(_stored(names, codes, name, rad_per_count) for name in names)


def _stored(names: Sequence[str], codes: str, name: str, rad_per_count: Sequence[float]) -> StoredColumn:
    code, joint = codes[names.index(name)], re.search(r"\d+", name)
    number = joint[0] if joint else ""
    form = name.replace(number, "{}", 1) if joint else name
    kind = COUNTED if code in WHOLE else KINDS.get(form, BITS)
    if form in KINDS and code in WHOLE:
        kind = KINDS[form]
    beside = kind.beside.format(number)
    if beside not in names:
        return StoredColumn(code, kind.per_unit, kind.order)
    factor = 1.0
    if form == "q{}_rad":
        factor = kind.per_unit * rad_per_count[int(number) - 1] if rad_per_count else 0.0
    return StoredColumn(code, kind.per_unit, kind.order, names.index(beside), factor)


def content_of(columns: Sequence[StoredColumn]) -> dict[str, Any]:
    """As the header of a recording holds it."""
    return {
        key: [getattr(column, key) for column in columns] for key in ("per_unit", "order", "beside", "factor")
    }


def columns_of(content: Mapping[str, Any], codes: str) -> tuple[StoredColumn, ...]:
    """From the header; ValueError, KeyError or TypeError if it does not describe these columns."""
    columns = tuple(
        StoredColumn(code, int(per_unit), int(order), int(beside), float(factor))
        for code, per_unit, order, beside, factor in zip(
            codes, content["per_unit"], content["order"], content["beside"], content["factor"], strict=True
        )
    )
    for column in columns:
        is_known = column.code in FLOATS + WHOLE and (column.per_unit > 0 or column.code in FLOATS)
        if not is_known or not 0 <= column.per_unit <= 10**15 or not 1 <= column.order <= ORDER_MOST:
            raise ValueError(f"a column stored as {column}")
        if not NO_COLUMN <= column.beside < len(columns) or not abs(column.factor) < 1e15:
            raise ValueError(f"a column stored as {column}")
    in_turn(columns)
    return columns


def in_turn(columns: Sequence[StoredColumn]) -> tuple[int, ...]:
    """Indices of the columns, each after the one that it stands beside; ValueError if there is no such order."""
    turn: list[int] = []
    left = list(range(len(columns)))
    while left:
        ready = [k for k in left if columns[k].beside == NO_COLUMN or columns[k].beside in turn]
        if not ready:
            raise ValueError("columns stand beside each other in a circle")
        turn += ready
        left = [k for k in left if k not in ready]
    return tuple(turn)
