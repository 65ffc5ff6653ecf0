"""Columns of laws that the rows follow in no straight line: secants from nought to several starts, and how these differ."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.series.around import Around, made, size_of_law
from calib.gap.series.constants import SPEAKS_FOR
from calib.gap.series.departures import GEARS
from calib.gap.series.scene import Response
from calib.gap.series.term import SeriesTerm, scaled
from calib.gap.signals.angles import SEEN
from calib.gap.signals.terms import Term as Law

WARMING_s = (0.8, 2.0, 5.0, 12.0, 40.0, 300.0)
DELAYS_s = (0.0004, 0.0008, 0.0018, 0.003, 0.0046, 0.007, 0.01)
READ_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a period, after the voltage has changed
COMPLIANCES_rad_Nm = (1 / 3000.0, 1 / 1200.0, 1 / 600.0, 1 / 300.0, 1 / 150.0)
WIDTHS_rad = (0.001, 0.002, 0.005, 0.010, 0.018)
DAMPING_Nm_s_rad = 0.8
FINER = (1.0, 1.2)  # times what was found, the next time: the second says how the first bends


def drift(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    own = around.found.get(key)
    forms = ("thermal_drift", "thermal_drift" + SEEN) if own is None else (own.form,)
    times = WARMING_s if own is None else tuple(own.values[1] * k for k in FINER)
    base, at = around.without(key)
    for form in forms:
        laws = [Law(key, form, (0.0, time_s)) for time_s in times]
        size = size_of_law(around, laws[0])
        columns = [_step(around, law.at((1e-3, law.values[1])), base, at, size / 1e-3) for law in laws]
        for k, law in enumerate(laws[:-1]):
            time_s, ratio = times[k], times[k + 1] / times[k] - 1.0
            slope = {cell: columns[k + 1].get(cell, 0.0) - here for cell, here in columns[k].items()}

            def law_of(
                c: Array, law: Law = law, time_s: float = time_s, ratio: float = ratio, size: float = size
            ) -> Law:
                share = ratio * float(c[-1] / c[0]) if c[0] else 0.0
                return law.at((float(c[0]) * size, time_s * float(np.clip(1.0 + share, 0.6, 1.6))))

            now = None
            if own is not None and abs(time_s / own.values[1] - 1.0) < 1e-9:
                now = np.array([own.values[0] / size])
            yield from made(around, key, columns[k], size, law_of, [slope], time_s, now=now)


def _step(around: Around, law: Law, base: tuple[Law, ...], at: Array, factor: float) -> Response:
    return around.scene.split(((around.scene.columns.residual((*base, law)) - at) * factor)[:, None])


@dataclass(frozen=True, slots=True)
class Bent:
    """A law that the rows follow in no straight line: starts of its first value, and steps of the others that are free."""

    starts: tuple[float, ...]
    others: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()
    most: float = math.inf  # of the first value


DELAY = Bent(DELAYS_s)
COMPLIANCE = Bent(COMPLIANCES_rad_Nm, (DAMPING_Nm_s_rad, 0.0), (0.5, 0.5), (20.0, 1.0))
BACKLASH = Bent(WIDTHS_rad, (0.0,), (0.5,), (1.0,))


def delay(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    yield from _secants(around, key, DELAY)


def sampling(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    period_s = 1.0 / around.scene.recording.filters.rate_Hz
    yield from _secants(around, key, Bent(tuple(share * period_s for share in READ_SHARES), most=period_s))


def compliance(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    yield from _secants(around, key, COMPLIANCE)


def backlash(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    yield from _secants(around, key, BACKLASH)


def _stepped(values: tuple[float, ...], steps: Sequence[float]) -> list[tuple[float, ...]]:
    """Values, and the same with a step of each but the first."""
    one_more = [(*values[: k + 1], values[k + 1] + step, *values[k + 2 :]) for k, step in enumerate(steps)]
    return [values, *one_more]


def _secants(around: Around, key: EffectName, bent: Bent) -> Iterator[SeriesTerm]:
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
    law = Law(key, key.effect, asked[0][0])
    size = size_of_law(around, law)
    if key.effect in GEARS:
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
            around, key, parts[0], size, law_of, parts[1:], value, is_positive=True, now=now, reach=reach,
            towards=(value, first[near]),
        )  # fmt: skip
