"""What a model of the arm is made of here: terms, each an effect in one form with its values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

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
