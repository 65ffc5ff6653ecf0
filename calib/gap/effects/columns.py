"""Columns of laws in time series: what the rows do per usual size of a law, how real parts depart from it, and nuisances."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from calib.arrays import Array
from calib.gap.effects.departures import departures
from calib.gap.effects.record import EffectRecord, InSeries
from calib.gap.finding import EffectName
from calib.gap.posterior.term import Block
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.scene import Response
from calib.gap.residuals.term import Curve, SeriesTerm, scaled, stacked
from calib.gap.signals.terms import Form, Law, typical
from control.model.effects import followed_joint, linear_values


def in_series(record: EffectRecord) -> InSeries:
    """What a record has of time series."""
    if record.series is None:
        raise ValueError(f"{record.effect} is not looked for in time series")
    return record.series


def size_of_law(around: OperatingPoint, record: EffectRecord, form: Form, key: EffectName) -> float:
    """The usual size of a law on its joint or link."""
    return in_series(record).usual * typical(around.scene.given_Nm, form, (key.joint or 0) - 1)


def made(
    around: OperatingPoint,
    record: EffectRecord,
    key: EffectName,
    laws: Response,
    size: float,
    law: Callable[[Array], Law],
    nuisances: Sequence[Response] = (),
    variant: float = 0.0,
    is_positive: bool = False,
    now: Array | None = None,
    more: Response | None = None,
    is_common: bool = False,
    reach: tuple[float, float] = (0.0, math.inf),
    towards: tuple[float, float] | None = None,
) -> Iterator[SeriesTerm]:
    """The term of a law's response per usual size; `more`: departures beside those of its variable.

    `towards`: the law's first value at which its response is a secant, and that at which the first nuisance has it.
    """
    if not laws:
        return
    series, joint = in_series(record), (followed_joint(key.effect, key.joint) or 1) - 1
    bent, alike = departures(around.scene, series.departs, joint, laws)
    departs = [own for own in (bent, more or {}) if own]
    parts = [laws, *departs, *nuisances]
    response = stacked(parts)
    count = next(iter(laws.values())).shape[1]
    width = next(iter(response.values())).shape[1]
    bends = sum(next(iter(own.values())).shape[1] for own in departs)
    curve = None if towards is None else Curve(count + bends, *towards, size)
    yield SeriesTerm(
        key, str(key), count, bends, size, variant=variant, is_positive=is_positive, variable=series.variable,
        traits=record.traits, response=response, width=width, law=law, now=now, is_common=is_common, least=reach[0],
        most=reach[1], alike=alike, curve=curve,
    )  # fmt: skip


def unlisted(one: SeriesTerm) -> SeriesTerm:
    """What is off the list is still in the world: the law as a block of its own."""
    key = one.key
    joint, effect = (key.joint or 0, key.effect) if isinstance(key, EffectName) else (key.joint, key.variable)
    words = f"{one.words} (left out of the list)"
    return dataclasses.replace(one, key=Block(joint, effect), words=words, law=None)


def known_law(record: EffectRecord, name: EffectName, given: Mapping[str, float]) -> Law | None:
    """The law of an `[[effect]]`; None for one that time series do not show."""
    series = record.series
    if series is None:
        return None
    if series.known is not None:
        return series.known(series, name, given)
    values = linear_values(name.effect, given)
    if not values:
        return None
    nought = (0.0,) * (series.form.count - len(values))
    return Law(name, series.form, (*values, *nought), given.get("order", 0.0))


def straight(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    """Every form of a law that the rows follow in a straight line, or nearly so; later, the form that was found."""
    own = around.found.get(key)
    for form in in_series(record).forms:
        if own is None or own.form is form:
            yield from _straight(around, record, key, form)


def _straight(
    around: OperatingPoint, record: EffectRecord, key: EffectName, form: Form
) -> Iterator[SeriesTerm]:
    count = form.count or 4 * len(around.scene.arm.links)
    law = Law(key, form, (0.0,) * count)
    size = size_of_law(around, record, form, key)
    base, at = around.without(key)
    own = around.found.get(key)
    start = law.values if own is None else own.values
    if count == 1 and start[0]:  # a secant from nought to what was found
        column = (around.scene.columns.residual((*base, law.at((start[0],)))) - at) / start[0]
        response: Response = around.scene.split(column[:, None])
    else:
        response = _per_value(around, law, base, at, [0.3 * size] * count)
    least = in_series(record).least(around.scene.arm, law)
    yield from made(
        around, record, key, scaled(response, size), size,
        lambda c: law.at(tuple((c[:count] * size).tolist())), is_positive=math.isfinite(least),
        reach=(max(least, -1e6) / size, math.inf), now=None if own is None else np.array(start) / size,
    )  # fmt: skip


def _per_value(
    around: OperatingPoint, law: Law, base: tuple[Law, ...], at: Array, steps: Sequence[float]
) -> Response:
    """How rows follow each value of a law around those that it has."""
    columns = []
    for place, step in enumerate(steps):
        values = list(law.values)
        values[place] += step
        columns.append((around.scene.columns.residual((*base, law.at(tuple(values)))) - at) / step)
    return around.scene.split(np.stack(columns, axis=1))
