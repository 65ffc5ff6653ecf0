"""What a model of the arm is made of here: terms, each an effect in one form with its values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName

# Steps of finite differences, by form: what changes rows by a good part of their floor and is still linear.
STEP = {
    "stribeck_friction": (1e-2, 2e-3),
    "stribeck exponential": (1e-2, 2e-3),
    "command_delay": (2e-5,),
    "sampling time": (2e-5,),
    "joint_compliance": (1e-5, 2e-2, 5e-2),
    "backlash": (5e-5, 5e-2),
    "link_flexure": (1e-4,),
    "thermal_drift": (1e-4, 5e-2),
    "thermal_drift seen": (1e-4, 5e-2),
}
PLAIN_STEP = 1e-3
FASTEST_STRIBECK_rad_s = 0.35  # a fall over all speeds of an arm is Coulomb friction with something else
QUICKEST_WARMING_s = 0.6  # quicker, a drift has gone by before a run counts, and is a zero
LATEST_s = 0.02  # of a sample after the voltage that it follows


@dataclass(frozen=True, slots=True)
class Term:
    """An effect, or something that is in no list, in one of the forms that it may have.

    `form` is the effect's name, or a variant of it; `values` are internal and may differ from the file's
    parameters (sine and cosine instead of amplitude and phase, compliance instead of stiffness).
    """

    name: EffectName
    form: str
    values: tuple[float, ...]
    order: float = 0.0  # of cogging, which is searched and then kept

    @property
    def index(self) -> int:
        """0-based joint or link; -1 where it has none."""
        return -1 if self.name.joint is None else self.name.joint - 1

    def at(self, values: tuple[float, ...]) -> Term:
        """The same with other values."""
        return replace(self, values=values)

    def neighbours(self) -> Iterator[tuple[Term, float]]:
        """The term with one value after the other a little larger, and by how much: for slopes."""
        steps = STEP.get(self.form, (PLAIN_STEP,) * len(self.values))
        for place, step in enumerate(steps[: len(self.values)]):
            values = list(self.values)
            values[place] += step
            yield self.at(tuple(values)), step


def bounded(term: Term, values: Array) -> Array:
    """Values kept where the effect means something."""
    result = np.array(values)
    match term.form:
        case "stribeck_friction" | "stribeck exponential":
            result[0], result[1] = max(result[0], 0.0), min(max(result[1], 0.004), FASTEST_STRIBECK_rad_s)
        case "load_friction" | "supply_sag" | "supply_sag by sum" | "command_delay":
            result[0] = max(result[0], 0.0)
        case "sampling time":
            result[0] = min(max(result[0], 0.0), LATEST_s)
        case "joint_compliance":
            result[0] = min(max(result[0], 1e-6), 0.05)
            result[1] = min(max(result[1], 0.0), 20.0)
            result[2:] = np.clip(result[2:], 0.0, 1.0)
        case "backlash":
            result[0] = min(max(result[0], 0.0), 0.2)
            result[1:] = np.clip(result[1:], 0.0, 1.0)
        case "link_flexure":
            result[0] = min(max(result[0], 1e-6), 1.0)
        case "thermal_drift" | "thermal_drift seen":
            result[1] = min(max(result[1], QUICKEST_WARMING_s), 1e5)
        case "torque_constant":
            result[0] = min(max(result[0], -0.8), 4.0)
        case _:
            pass
    return result
