"""One record an effect: what it is called, its usual size, and the terms that it makes of a scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.poses.effects.scene import Scene
from calib.gap.posterior.coefficients import only
from calib.gap.posterior.term import Term

NO_TORQUE_Nm = 1e-6  # rounding: below it a joint carries nothing


@dataclass(frozen=True, slots=True)
class EffectRecord:
    """What acts (joint, link or arm), the usual size, and the terms that it makes of a scene.

    Parameters and their file form are those of formats.md; each term carries how its coefficients become them.
    """

    effect: str
    size: float
    terms: Callable[[EffectRecord, Scene], Iterator[Term]]
    parameter: str = ""

    def term(self, joint: int | None, laws: int, columns: Array, departures: int, **more: object) -> Term:
        """A term of this effect on joints: columns (c, m, n) per unit of the coefficient."""
        made = Term(
            EffectName(self.effect, joint), "", laws, departures, self.size, slope_rad=self.size * columns,
            parameters=only(self.parameter),
        )  # fmt: skip
        return dataclasses.replace(made, **more)  # type: ignore[arg-type]  # keywords of the record itself


def harmonics(angle: Array, *orders: int) -> list[Array]:
    """Sine and cosine of each order."""
    return [f(order * angle) for order in orders for f in (np.sin, np.cos)]
