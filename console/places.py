"""Named places: a TOML file with joint angles or a tip position for each name. Written by hand or by `armwright mark`.

[above_board]
q_rad = [0.0, -0.6, 0.2]

[corner]
tip_m = [0.5, 0.1, 0.1]
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from control.errors import ArmError
from control.files import changing, read_toml, write_whole

KEYS = {"q_rad", "tip_m"}


class PlacesError(ArmError):
    """An invalid places file, or a place that is not in it."""


@dataclass(frozen=True, slots=True)
class NamedPlace:
    """Joint angles, or a tip position in the base frame."""

    name: str
    q_rad: tuple[float, ...] | None
    tip_m: tuple[float, float, float] | None


def read_places(file: Path) -> dict[str, NamedPlace]:
    """The places of a file by name. PlacesError names file and place."""
    return {name: _place(file, name, table) for name, table in _tables(file).items()}


def find_place(file: Path, name: str, rest_rad: Sequence[float] | None = None) -> NamedPlace:
    """One place; `rest` is the arm's own, where the file has none. PlacesError lists the known places."""
    if name == "rest" and rest_rad is not None and not file.exists():
        return NamedPlace(name, tuple(rest_rad), None)
    places = ({} if rest_rad is None else {"rest": NamedPlace("rest", tuple(rest_rad), None)}) | read_places(file)
    if name not in places:
        raise PlacesError(f"{file}: no place {name!r}; expected one of {', '.join(places) or 'none'}")
    return places[name]


def save_place(file: Path, name: str, q_rad: Sequence[float]) -> bool:
    """Add a place of joint angles, or replace its pose; other places are unchanged, comments are lost.

    Returns whether the name existed.
    """
    import tomli_w

    if not name or not name.replace("_", "").replace("-", "").isalnum():
        raise PlacesError(f"place: expected a name of letters, digits, - and _, got {name!r}")
    with changing(file):
        tables = _tables(file)
        was_there = name in tables
        tables[name] = {"q_rad": [round(q, 6) for q in q_rad]}
        write_whole(file, tomli_w.dumps(tables))
    return was_there


def _tables(file: Path) -> dict[str, Any]:
    return read_toml(file, PlacesError, "; `armwright mark NAME` creates the file")


def _place(file: Path, name: str, table: object) -> NamedPlace:
    if not isinstance(table, dict) or len(table) != 1 or not set(table) <= KEYS:
        got = ", ".join(table) if isinstance(table, dict) else repr(table)
        raise PlacesError(f"{file}, [{name}]: expected q_rad or tip_m, got {got or 'nothing'}")
    ((key, values),) = table.items()
    numbers = values if isinstance(values, list) else []
    is_good = numbers and all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in numbers)
    if not is_good or (key == "tip_m" and len(numbers) != 3):
        raise PlacesError(f"{file}, [{name}]: expected {key} to be a list of finite numbers, got {values!r}")
    if key == "tip_m":
        return NamedPlace(name, None, (float(numbers[0]), float(numbers[1]), float(numbers[2])))
    return NamedPlace(name, tuple(float(v) for v in numbers), None)
