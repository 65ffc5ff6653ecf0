"""Terms of a model of time series: an effect in one of its forms, with its values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from control.model.effect_laws import Torque

PLAIN_STEP = 1e-3  # of finite differences of what rows follow in a straight line
MEANT_FOR_Nm = 30.0  # largest torque of the drives that the sizes of torques are meant for

# Where a form acts: on the torque at the motor, in the gear, between encoder and joint, on what the camera sees, on what the
# links carry, or in the electrical equations.
Acts = Literal[
    "motor", "spring", "play", "angle", "beam", "geometry", "frame", "payload", "mass", "inertia", "torque constant", "delay",
    "sampling", "sag",
]  # fmt: skip
# An angle's error: misread by the encoder at the motor, arising between motor and link, or seen by the camera alone.
Where = Literal["encoder", "behind", "seen"]
Values = tuple[float, ...]
# Of values, the angle (m,) that it follows and times (m,): the error, its first and second derivative, by the angle or by time.
AngleLaw = Callable[[Values, Array, Array], tuple[Array, Array, Array]]
Drawn = Callable[
    [Array, Array, Array], Array
]  # of voltages and currents (m, n) and supplies (n,): the supply's current (m, 1)


@dataclass(frozen=True, slots=True, eq=False)
class Form:
    """One form of an effect in time series, with internal values, which may differ from the file's parameters."""

    name: str
    acts: Acts
    smallest: float  # size worth a name: about what a careful builder would still correct
    count: int = 1  # of values; 0: four a link
    counted: int | None = None  # of the values, those that make the size; None: all
    is_torque: bool = False  # the size is a share of the drive's torque
    # of finite differences: what changes rows by a good part of their floor and is still linear; () where rows follow in a
    # straight line anyway
    steps: tuple[float, ...] = ()
    lower: tuple[float, ...] = (-math.inf,)  # where the values mean something
    upper: tuple[float, ...] = (math.inf,)
    torque: Callable[[Values, float], Torque] | None = None  # of values and cogging's order
    is_of_motor: bool = False  # the torque follows the motor's angle
    shared: Literal["", "coulomb", "viscous"] = (
        ""  # a friction part of which may act behind a soft or loose gear
    )
    angle: AngleLaw | None = None
    where: Where = "encoder"
    is_by_time: bool = False  # the angle's error follows time
    drawn: Drawn | None = None

    @property
    def is_straight(self) -> bool:
        """Whether the rows follow its values in a straight line."""
        return not self.steps

    @property
    def is_gear(self) -> bool:
        """Whether it is a gear that is soft or loose: joint and motor are then at two angles."""
        return self.acts in ("spring", "play")

    def __str__(self) -> str:
        """Its name."""
        return self.name


@dataclass(frozen=True, slots=True)
class Law:
    """An effect, or something that is in no list, in one of the forms that it may have."""

    name: EffectName
    form: Form
    values: Values
    order: float = 0.0  # of cogging, which is searched and then kept

    @property
    def index(self) -> int:
        """0-based joint or link; -1 where it has none."""
        return -1 if self.name.joint is None else self.name.joint - 1

    def at(self, values: Values) -> Law:
        """The same with other values."""
        return replace(self, values=values)

    def neighbours(self) -> Iterator[tuple[Law, float]]:
        """The term with one value after the other a little larger, and by how much: for slopes."""
        steps = self.form.steps or (PLAIN_STEP,) * len(self.values)
        for place, step in enumerate(steps[: len(self.values)]):
            values = list(self.values)
            values[place] += step
            yield self.at(tuple(values)), step

    def bounded(self) -> Law:
        """With values where the effect means something."""
        count = len(self.values)
        lower, upper = (np.resize(own, count) for own in (self.form.lower, self.form.upper))
        return self.at(tuple(np.clip(self.values, lower, upper).tolist()))

    def is_worth_a_name(self, given_Nm: Array) -> bool:
        """Whether it is at least of the smallest size; `given_Nm` as of `smallest`."""
        return math.hypot(*self.values[: self.form.counted]) >= smallest(given_Nm, self.form, self.index)


def smallest(given_Nm: Array, form: Form, joint: int) -> float:
    """The size worth a name for a joint (0-based), of which given_Nm (n,) says what its motor gives; small drives have small
    frictions.
    """
    return form.smallest * min(1.0, _of_drive(given_Nm, form, joint))


def typical(given_Nm: Array, form: Form, joint: int) -> float:
    """What `smallest` is a share of: the frictions of a large drive are larger, although as little is worth a name."""
    return form.smallest * _of_drive(given_Nm, form, joint)


def _of_drive(given_Nm: Array, form: Form, joint: int) -> float:
    """A joint's torque over that of the drives that the sizes of torques are meant for; 1 for what is no torque."""
    return float(given_Nm[joint]) / MEANT_FOR_Nm if form.is_torque and joint >= 0 else 1.0
