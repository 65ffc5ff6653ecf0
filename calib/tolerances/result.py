"""What the study says: how accurate the arms are at each stage, and what each tolerance costs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.arrays import Array
from calib.studies.chunks import ChunkStore
from calib.studies.figures import Z95, Figure, proportion, quantile
from calib.tolerances.study import Design

PERCENTILES: Final = (0.05, 0.5, 0.95)


@dataclass(frozen=True, slots=True)
class Cost:
    """A factor: by which share the mean square error falls if it is exact, and the root mean square that is left [m].

    One of each for every stage. Shares add up to 1 where errors add up: beyond that they interact.
    """

    name: str
    share: tuple[Figure, ...]
    left_m: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Made:
    """The arms of a study, by stage.

    kept_m, mean_square_m2 (stages, arms): the distance that 95 % of an arm's poses keep, and the mean over its poses.
    distance_m (stages, first arms, poses): at each pose of the map.
    """

    design: Design
    kept_m: Array
    mean_square_m2: Array
    distance_m: Array
    costs: tuple[Cost, ...]

    @property
    def arms_count(self) -> int:
        """How many arms were drawn."""
        return int(self.kept_m.shape[1])

    def kept(self, stage: int, share: float) -> Figure:
        """The distance [m] that this share of the arms keep, each at 95 % of its poses."""
        return quantile(self.kept_m[stage], share)

    def rms_m(self, stage: int) -> float:
        """Root mean square over arms and poses."""
        return math.sqrt(float(self.mean_square_m2[stage].mean()))

    def within(self, stage: int, tolerance_m: float) -> Figure:
        """The share of the arms that keep a tolerance at 95 % of their poses (Wilson's interval)."""
        return proportion(int((self.kept_m[stage] <= tolerance_m).sum()), self.arms_count)

    def map_m(self, stage: int) -> Array:
        """At each pose the distance (m,) that 95 % of the arms keep."""
        return np.asarray(np.quantile(self.distance_m[stage], 0.95, axis=0))


def made_of(design: Design, store: ChunkStore) -> Made:
    """The result of a study whose tasks are all in the store."""
    parts = [store.read(number) for number in range(design.chunks)]
    mean_square = np.concatenate([part["mean_square_m2"] for part in parts], axis=1)
    distance = np.concatenate([part["distance_m"] for part in parts if "distance_m" in part], axis=1)
    kept = np.concatenate([part["kept_m"] for part in parts], axis=1)
    costs = [
        _cost(name, mean_square, store.read(design.chunks + k)["mean_square_m2"])
        for k, name in enumerate(design.factors)
    ]
    return Made(design, kept, mean_square, distance, tuple(costs))


def _cost(name: str, every: Array, exact: Array) -> Cost:
    """By mean squares (stages, arms) of arms and of the same arms with the factor exact."""
    count = exact.shape[1]
    whole = every[:, :count].mean(axis=1)
    gain = every[:, :count] - exact
    share, spread = gain.mean(axis=1) / whole, Z95 * gain.std(axis=1) / math.sqrt(count) / whole
    figures = tuple(Figure(float(s), float(s - d), float(s + d)) for s, d in zip(share, spread, strict=True))
    left_m = np.sqrt(every.mean(axis=1) * np.maximum(0.0, 1.0 - share))
    return Cost(name, figures, tuple(left_m.tolist()))


def costliest(made: Made, stage: int) -> list[Cost]:
    """The factors by what they cost at a stage, the costliest first."""
    return sorted(made.costs, key=lambda one: -one.share[stage].value)
