"""What a linearisation is made around."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib.arrays import Array
from calib.gap.posterior.term import Key
from calib.gap.residuals.scene import SeriesScene
from calib.gap.signals.terms import Law


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """The model of a linearisation: known laws, and laws found so far by key.

    `residual`: its rows; `smooth`: what it would have left if motions and currents had been measured without noise.
    """

    scene: SeriesScene
    known: tuple[Law, ...]
    found: dict[Key, Law]
    residual: Array
    smooth: Array

    @classmethod
    def of(cls, scene: SeriesScene, known: Sequence[Law], found: Mapping[Key, Law]) -> OperatingPoint:
        """With what it leaves."""
        model = (*known, *found.values())
        return cls(
            scene, tuple(known), dict(found), scene.rows.residual(model), scene.columns.residual(model)
        )

    @property
    def model(self) -> tuple[Law, ...]:
        """All of it."""
        return (*self.known, *self.found.values())

    def without(self, key: Key) -> tuple[tuple[Law, ...], Array]:
        """The model without a law, and its rows as columns are reckoned from them."""
        if key not in self.found:
            return self.model, self.smooth
        rest = (*self.known, *(law for own, law in self.found.items() if own != key))
        return rest, self.scene.columns.residual(rest)
