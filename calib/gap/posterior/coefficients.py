"""From the coefficients of an effect's law to the parameters of docs/formats.md, each as (value, standard deviation)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.finding import Parameters
from control.model.effects import EFFECTS

ToParameters = Callable[[Array, Array], Parameters]  # of coefficients (c,) and their covariance (c, c)


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
