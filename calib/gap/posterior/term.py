"""A term of the model: an effect or a nameless block, in one of its variants, as columns that move joints, tip and currents."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.constants import (
    BLOCK_LEVELS,
    BLOCK_PRIOR,
    DEPARTURE_WEIGHTS,
    DEPARTURES,
    NAME_PRIOR,
    SIZE_LEVELS,
    SIZE_WEIGHTS,
)
from control.model.effects import EFFECTS


@dataclass(frozen=True, slots=True)
class Block:
    """A family of shapes without a name: what moves (1-based joint, 0 the tip), and with what it does so."""

    joint: int
    variable: str


Key = EffectName | Block
ToParameters = Callable[[Array, Array], Parameters]  # of coefficients (c,) and their covariance (c, c)
SMOOTH = 5  # degree of a smooth function of one variable


@dataclass(frozen=True, slots=True)
class Traits:
    """What an effect is beside others. `blocks`: how the variable begins of those blocks of its joint that are functions of its
    own ("{j}": its joint); `is_on_every_joint`: all joints have it at once, if one has. Of effects that share an `alternative`
    one joint is given one: beside each other, each hides what the other does.
    """

    blocks: str = ""
    is_on_every_joint: bool = False
    alternative: str = ""


NO_TRAITS = Traits()


@dataclass(frozen=True, slots=True)
class Term:
    """One variant of an effect or block: c columns, the first `laws` of them the law, `departures` after them, then nuisances.

    Of joints `slope_rad` (c, m, n), of the tip `slope_m` (c, m, 3) and of the last link `turn_rad` (c, m, 3: rotation vectors in
    the base frame) besides what the joints do, of holding torques `slope_Nm` (c, m, n); None where nothing moves. `size` is the
    usual coefficient of the law; departure and nuisance columns are scaled to it already. `variant`: what sets this one apart,
    `least` and `most` what a positive coefficient lies between, in usual sizes, `doubt_rad` (m,) the
    variance of the joint's angle per squared coefficient where the flank is uncertain. `between`: parameters of a variant between
    those that are tried in even steps of its logarithm, and the logarithm's standard deviation.
    """

    key: Key
    words: str = ""
    laws: int = 1
    departures: int = 0
    size: float = 1.0
    slope_rad: Array | None = None
    slope_m: Array | None = None
    turn_rad: Array | None = None
    slope_Nm: Array | None = None
    variant: float = 0.0
    is_positive: bool = False
    least: float = 0.0
    most: float = math.inf
    parameters: ToParameters | None = None
    between: Callable[[float, float], ToParameters] | None = None
    variable: str = ""
    doubt: Array | None = None
    traits: Traits = NO_TRAITS

    @property
    def count(self) -> int:
        """How many columns."""
        for slope in (self.slope_rad, self.slope_m, self.turn_rad, self.slope_Nm):
            if slope is not None:
                return len(slope)
        return 0

    def law_alone(self) -> Term:
        """The same without departures and nuisances."""
        slopes = (self.slope_rad, self.slope_m, self.turn_rad, self.slope_Nm)
        rad, m, turn, Nm = (None if slope is None else slope[: self.laws] for slope in slopes)
        return dataclasses.replace(self, departures=0, slope_rad=rad, slope_m=m, turn_rad=turn, slope_Nm=Nm)

    @property
    def is_name(self) -> bool:
        """Whether it is an effect of the list."""
        return isinstance(self.key, EffectName)

    @property
    def log_odds(self) -> float:
        """Of its key, before any data."""
        prior = NAME_PRIOR if self.is_name else BLOCK_PRIOR
        return float(np.log(prior / (1.0 - prior)))

    def scales(self) -> tuple[Array, Array]:
        """Prior standard deviations (h, c) in usual sizes, and log weights (h,), of every hyperparameter."""
        if not self.is_name:
            levels = np.array(BLOCK_LEVELS)
            return levels[:, None] * np.ones(self.count), np.full(len(levels), -np.log(len(levels)))
        rhos = DEPARTURES if self.departures else (0.0,)
        weights = DEPARTURE_WEIGHTS if self.departures else (1.0,)
        rest = self.count - self.laws - self.departures
        rows = [[level] * self.laws + [level * rho] * self.departures + [level] * rest for level in SIZE_LEVELS for rho in rhos]
        logs = [np.log(a * b) for a in SIZE_WEIGHTS for b in weights]
        return np.array(rows), np.array(logs)


def on_joint(course: Array, joint: int, n: int) -> Array:
    """Courses (c, m) or (m,) on one joint (0-based) of n: (c, m, n)."""
    courses = np.atleast_2d(course)
    on_joints = np.zeros((*courses.shape, n))
    on_joints[:, :, joint] = courses
    return on_joints


def like(law: Array, shapes: Sequence[Array]) -> list[Array]:
    """Shapes scaled to the root mean square of a law's column; those that are nothing left out."""
    size = float(np.sqrt(np.mean(law**2)))
    scaled = []
    for shape in shapes:
        shape_rms = float(np.sqrt(np.mean(shape**2)))
        if shape_rms > 1e-12 * max(size, 1e-300):
            scaled.append(shape * (size / shape_rms))
    return scaled


def smooth(values: Array, degree: int = SMOOTH) -> Array:
    """Legendre polynomials of degrees 1 to `degree` over the range of values (m,): (degree, m)."""
    low, high = float(values.min()), float(values.max())
    unit = (2.0 * values - low - high) / max(high - low, 1e-12)
    return np.asarray(np.polynomial.legendre.legvander(unit, degree)[:, 1:].T)


def values_of(effect: str, values: Sequence[float]) -> dict[str, float]:
    """An effect's parameters by its linear unknowns; of one that is not linear, the values are its parameters."""
    kind = EFFECTS[effect]
    if kind.linear is not None:
        return kind.linear.parameters(values)
    return dict(zip(kind.required or kind.optional, values, strict=False))


def parameters_of(effect: str) -> ToParameters:
    """The same with standard deviations."""
    linear = EFFECTS[effect].linear

    def made(value: Array, covariance: Array) -> Parameters:
        named = values_of(effect, value.tolist())
        count = len(value) if linear is None else len(linear.slopes(value.tolist())[0])
        slopes = np.eye(count) if linear is None else np.array(linear.slopes(value.tolist()))
        variance = np.einsum("pc,cd,pd->p", slopes, covariance[:count, :count], slopes)
        sd = np.sqrt(np.maximum(variance, 0.0)).tolist()
        return {name: (number, own) for (name, number), own in zip(named.items(), sd, strict=False)}

    return made


def inverse(parameter: str, beyond: float = 0.0) -> ToParameters:
    """1 / (coefficient + beyond)."""

    def made(value: Array, covariance: Array) -> Parameters:
        whole, sd = float(value[0]) + beyond, float(np.sqrt(covariance[0, 0]))
        return {parameter: (1.0 / whole, sd / whole**2)}

    return made


def sized(size: Array, made: ToParameters) -> ToParameters:
    """Of coefficients that are counted in sizes (c,)."""
    return lambda value, covariance: made(value * size, covariance * np.outer(size, size))
