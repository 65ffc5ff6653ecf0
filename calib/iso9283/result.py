"""Results of an evaluation: fourteen criteria, each with its figures or missing input; and iso9283.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from calib.arrays import Array
from calib.results import Provenance, entries, write_json

FORMAT = "iso9283/1"


@dataclass(frozen=True, slots=True)
class Figure:
    """One value: the standard's symbol, SI unit (or %), place, and remarks.

    `is_headline`: represents its symbol in the table, such as the worst of the poses.
    """

    symbol: str
    value: float
    unit: str
    where: str
    count: int
    is_headline: bool = False
    remark: str = ""


@dataclass(frozen=True, slots=True)
class Criterion:
    """One of the fourteen: number as counted here, name, the standard's clause, figures, and what is missing."""

    number: int
    name: str
    clause: str
    figures: tuple[Figure, ...] = ()
    needs: tuple[str, ...] = ()

    @property
    def headlines(self) -> tuple[Figure, ...]:
        """The figures that represent this criterion."""
        return tuple(figure for figure in self.figures if figure.is_headline)


@dataclass(frozen=True, slots=True)
class PathTrace:
    """A commanded path (m, 3) and the attained points (n, m, 3), for a picture; m."""

    name: str
    commanded_m: Array
    attained_m: Array


@dataclass(frozen=True, slots=True)
class SettlingTrace:
    """Distances (k,) [m] from the attained pose over time_s (k,) of one approach, and the limit band."""

    name: str
    time_s: Array
    distance_m: Array
    band_m: float


@dataclass(frozen=True, slots=True)
class Evaluation:
    """All fourteen criteria, notes on their evaluation, and data for the pictures.

    clouds: attained positions (n, 3) minus the commanded one, by pose.
    """

    criteria: tuple[Criterion, ...]
    notes: tuple[str, ...]
    clouds: Mapping[str, Array] = field(default_factory=dict)
    paths: tuple[PathTrace, ...] = ()
    settling: tuple[SettlingTrace, ...] = ()
    loads: tuple[Array, Array] | None = None


CRITERIA = (
    (1, "Pose accuracy and pose repeatability", "7.2"),
    (2, "Multi-directional pose accuracy variation", "7.2"),
    (3, "Distance accuracy and distance repeatability", "7.3"),
    (4, "Position stabilization time", "7.4"),
    (5, "Position overshoot", "7.5"),
    (6, "Drift of pose characteristics", "7.6"),
    (7, "Exchangeability", "7.7"),
    (8, "Path accuracy and path repeatability", "8.2, 8.3"),
    (9, "Path accuracy on reorientation", "8.4"),
    (10, "Cornering deviations", "8.5"),
    (11, "Path velocity characteristics", "8.6"),
    (12, "Minimum posing time", "9"),
    (13, "Static compliance", "10"),
    (14, "Weaving deviations", "11"),
)


def criterion(number: int, figures: Sequence[Figure], needs: Sequence[str]) -> Criterion:
    """One criterion by number."""
    _, name, clause = CRITERIA[number - 1]
    return Criterion(number, name, clause, tuple(figures), tuple(dict.fromkeys(needs)))


def with_headlines(figures: Sequence[Figure], symbols: Sequence[str] | None = None) -> list[Figure]:
    """Make the largest figure of each symbol (of all, or of those named) the headline."""
    worst: dict[str, Figure] = {}
    for figure in figures:
        if figure.symbol not in worst or abs(figure.value) > abs(worst[figure.symbol].value):
            worst[figure.symbol] = figure
    return [
        replace(f, is_headline=worst[f.symbol] is f and (symbols is None or f.symbol in symbols))
        for f in figures
    ]


def write_document(path: Path, evaluation: Evaluation, arm: str, made: Provenance) -> None:
    """Write iso9283.json; SI units, radians."""
    criteria = [
        entries(one, "number", "name", "clause", "needs")
        | {
            "values": {f.symbol: entries(f, "value", "unit", "where") for f in one.headlines},
            "figures": [
                entries(f, "symbol", "value", "unit", "where", "count", *(("remark",) if f.remark else ()))
                for f in one.figures
            ],
        }
        for one in evaluation.criteria
    ]
    write_json(path, made.heading(FORMAT, arm=arm) | {"criteria": criteria, "notes": evaluation.notes})
