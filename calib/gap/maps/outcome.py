"""What a look for maps gave: what stands in gap.json, and what a report draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import MapCheck
from control.model.maps import CorrectionMap


@dataclass(frozen=True, slots=True)
class DrawnMap:
    """A map over its variable: at places `at` (k,) what all else leaves, `data`, and what the map says, `table` (k,), in SI."""

    map: CorrectionMap
    at: Array
    data: Array
    table: Array


@dataclass(frozen=True, slots=True)
class MapsFound:
    """The maps that help, how much, and what was said where none does."""

    drawn: tuple[DrawnMap, ...]
    checks: tuple[MapCheck, ...]
    sentences: tuple[str, ...] = ()

    @property
    def maps(self) -> tuple[CorrectionMap, ...]:
        """As arm.toml has them."""
        return tuple(one.map for one in self.drawn)

    def __add__(self, other: MapsFound) -> MapsFound:
        """Both."""
        return MapsFound(
            self.drawn + other.drawn, self.checks + other.checks, self.sentences + other.sentences
        )


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))
