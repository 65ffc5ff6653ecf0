"""The ways in which a real part departs from its law: functions of its own variable, by which the law is multiplied."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.record import EffectRecord, InSeries, Shape
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import SPEAKS_FOR
from calib.gap.posterior.term import Block
from calib.gap.residuals.scene import OperatingPoint, Response, RowConditions, SeriesScene
from calib.gap.residuals.term import Curve, SeriesTerm, departed, scaled, size_of, stacked
from calib.gap.signals.terms import Form, Law, typical
from control.model.effects import followed_joint, linear_values


def _unit(values: Array) -> Array:
    """Over the root mean square."""
    size = float(np.sqrt(np.mean(values**2)))
    return values / size if size > 0.0 else values


def by_angle(at: RowConditions, j: int) -> Array:
    """Two harmonics of the joint's turn, and what is slower over its travel."""
    q = at.q[:, j]
    return np.array([np.sin(q), np.cos(q), np.sin(2 * q), np.cos(2 * q)])


def by_speed(at: RowConditions, j: int) -> Array:
    """Its absolute value and its square."""
    v = _unit(at.speed[:, j])
    return np.array([np.abs(v), v**2])


def by_direction(at: RowConditions, j: int) -> Array:
    """One way and the other."""
    return at.direction[:, j][None]


def by_load(at: RowConditions, j: int) -> Array:
    """Of what the gear transmits: its absolute value, its root and its square."""
    load = np.abs(_unit(at.load_Nm[:, j]))
    return np.array([load, np.sqrt(load), load**2])


def by_current(at: RowConditions, j: int) -> Array:
    """Of the motor: its absolute value and its square."""
    i = _unit(at.current_A[:, j])
    return np.array([np.abs(i), i**2])


def by_currents(at: RowConditions, j: int) -> Array:
    """Of all motors together."""
    return _unit(np.sum(np.abs(at.current_A), axis=1))[None]


def departures(
    scene: SeriesScene, shapes: Sequence[Shape], joint: int, law: Response
) -> tuple[dict[int, Array], Array]:
    """Columns of a law's departures on a joint (0-based), each as large as the law; every channel for itself.

    With them what departures change that looks like the law itself, a part of each for every shape of a variable (`departed`), of
    the channel that shows the law best. A motor that saturates gives less torque, and its back-EMF is as before. What currents
    show of a gear is mostly how its angle changes, with the noise of that: where the tip shows the angle, it alone says how the
    gear departs.
    """
    if not shapes or not law:
        return {}, np.zeros((0, 1, 1))
    parts, alike, largest = [], np.zeros((0, 1, 1)), 0.0
    channels = list(dict.fromkeys(scene.cells[cell].channel for cell in law))
    for channel in channels:
        own = {cell: columns for cell, columns in law.items() if scene.cells[cell].channel == channel}
        wanted = {cell: [one(scene.beside[cell], joint) for one in shapes] for cell in own}
        bent, taken = departed(own, {cell: np.concatenate(some) for cell, some in wanted.items()})
        if bent:
            parts.append(bent)
        if (size := float(np.linalg.norm(size_of(own)))) > largest:
            counts = [len(some) for some in next(iter(wanted.values()))]
            alike, largest = taken / np.sqrt(np.repeat(counts, counts))[:, None, None], size
    return (stacked(parts) if parts else {}), alike


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
