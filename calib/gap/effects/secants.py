"""Columns of laws that the rows follow in no straight line: secants from nought to several starts, and how these differ."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.columns import in_series, made, size_of_law
from calib.gap.effects.record import EffectRecord
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import SPEAKS_FOR
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.term import SeriesTerm, scaled
from calib.gap.signals.terms import Law

FINER = (1.0, 1.2)  # times what was found, the next time: the second says how the first bends


@dataclass(frozen=True, slots=True)
class Bent:
    """A law that the rows follow in no straight line: starts of its first value, and steps of the others that are free."""

    starts: tuple[float, ...]
    others: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()
    most: float = math.inf  # of the first value


def _stepped(values: tuple[float, ...], steps: Sequence[float]) -> list[tuple[float, ...]]:
    """Values, and the same with a step of each but the first."""
    one_more = [(*values[: k + 1], values[k + 1] + step, *values[k + 2 :]) for k, step in enumerate(steps)]
    return [values, *one_more]


def secants(
    around: OperatingPoint, record: EffectRecord, key: EffectName, bent: Bent
) -> Iterator[SeriesTerm]:
    """The secant from nought to each start, how the next start's differs from it, and what the other values' steps do."""
    rows = around.scene.columns
    base, at = around.without(key)
    own = around.found.get(key)
    first = bent.starts if own is None else tuple(own.values[0] * k for k in FINER)
    others = bent.others if own is None else own.values[1:]
    steps = tuple(
        step if value + step <= upper else -step
        for value, step, upper in zip(others, bent.steps, bent.upper, strict=True)
    )
    asked = [_stepped((v, *others), steps) for v in first]
    law = Law(key, in_series(record).form, asked[0][0])
    size = size_of_law(around, record, law.form, key)
    if law.form.is_gear:
        rows.physics.following.foresee(base, [law.at(values) for some in asked for values in some])
    moved = [[rows.residual((*base, law.at(values))) for values in some] for some in asked]
    secants = [(some[0] - at) * (size / v) for some, v in zip(moved, first, strict=True)]
    for k, value in enumerate(first if own is None else first[:1]):
        near = k + 1 if k + 1 < len(first) else k - 1
        bends = secants[near] - secants[k]
        columns = [secants[k], bends * value / size, *(one - moved[k][0] for one in moved[k][1:])]
        parts = [around.scene.split(column[:, None]) for column in columns]
        parts[1:] = [one or scaled(parts[0], 0.0) for one in parts[1:]]

        def law_of(c: Array, value: float = value) -> Law:
            found = float(np.clip(c[0] * size, SPEAKS_FOR[0] * value, min(SPEAKS_FOR[1] * value, bent.most)))
            more = np.array(others) + np.array(steps) * c[len(c) - len(steps) :]
            return law.at((found, *np.clip(more, 0.0, bent.upper).tolist()))

        now = np.array([value / size]) if own is not None and math.isclose(own.values[0], value) else None
        reach = SPEAKS_FOR[0] * value / size, min(SPEAKS_FOR[1] * value, bent.most) / size
        yield from made(
            around, record, key, parts[0], size, law_of, parts[1:], value, is_positive=True, now=now, reach=reach,
            towards=(value, first[near]),
        )  # fmt: skip
