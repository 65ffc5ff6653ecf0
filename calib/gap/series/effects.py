"""The effects as data: one record each, with its forms, where it acts, how its search begins, and what else of it is free."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.link_bending import beams
from calib.arrays import Array
from calib.gap.dynamic.sizes import typical
from calib.gap.finding import EffectName
from calib.gap.posterior.term import Block, Key
from calib.gap.series.constants import SPEAKS_FOR, USUAL, USUAL_OF
from calib.gap.series.departures import VARIABLE, departures
from calib.gap.series.scene import Response, Scene
from calib.gap.series.term import SeriesTerm, scaled, stacked
from calib.gap.signals.angles import BEHIND, SEEN
from calib.gap.signals.terms import Term as Law

FRICTION = ("coulomb_friction", "viscous_friction", "load_friction", "asymmetric_friction")
COMMON = ("coulomb_friction", "viscous_friction")  # of every gear, where the file knows of neither
STRIBECK_rad_s = (0.012, 0.022, 0.04, 0.07, 0.12, 0.22)
ORDERS = tuple(float(order) for order in range(1, 41))
ORDERS_WEIGHED = 6  # of a joint's cogging: the others stand out less
WARMING_s = (0.8, 2.0, 5.0, 12.0, 40.0, 300.0)
DELAYS_s = (0.0004, 0.0008, 0.0018, 0.003, 0.0046, 0.007, 0.01)
COMPLIANCES_rad_Nm = (1 / 3000.0, 1 / 1200.0, 1 / 600.0, 1 / 300.0, 1 / 150.0)
WIDTHS_rad = (0.001, 0.002, 0.005, 0.010, 0.018)
DAMPING_Nm_s_rad = 0.8
FINER = (1.0, 1.2)  # times what was found, the next time: the second says how the first bends
ENCODER = ("", BEHIND, SEEN)
GEARS = ("joint_compliance", "backlash")


@dataclass(frozen=True, slots=True)
class Around:
    """The model of a linearisation: known laws, laws found so far by key with their coefficients' residual rows."""

    scene: Scene
    known: tuple[Law, ...]
    found: dict[Key, Law]
    residual: Array

    @property
    def model(self) -> tuple[Law, ...]:
        """All of it."""
        return (*self.known, *self.found.values())

    def without(self, key: Key) -> tuple[tuple[Law, ...], Array]:
        """The model without a law, and its residual rows."""
        if key not in self.found:
            return self.model, self.residual
        rest = (*self.known, *(law for own, law in self.found.items() if own != key))
        return rest, self.scene.rows.residual(rest)


def terms_of(
    around: Around,
    names: Collection[str] | None = None,
    before: Sequence[SeriesTerm] = (),
    keys: Collection[Key] | None = None,
) -> Iterator[SeriesTerm]:
    """All variants of all effects that the channels could show; `names`: only these effects, by name; `keys`: only these.

    `before`: the terms of the first linearisation, which stay for what was not found and shares no joint with a gear that was.
    """
    scene = around.scene
    moves = scene.recording.has_current or scene.recording.has_voltage
    bent = {key.joint for key in around.found if isinstance(key, EffectName) and key.effect in GEARS}
    for effect, key, variants in _listed(scene, moves):
        if keys is not None and key not in keys:
            continue
        is_listed = names is None or effect in names
        own = key if is_listed else Block(key.joint or 0, effect)
        if before and key not in around.found and not (effect in GEARS and key.joint in bent):
            yield from (one for one in before if one.key == own)
        else:
            yield from (one if is_listed else _unlisted(one) for one in variants(around, key))


def _unlisted(one: SeriesTerm) -> SeriesTerm:
    """What is off the list is still in the world: the law as a block of its own."""
    key = one.key
    joint, effect = (key.joint or 0, key.effect) if isinstance(key, EffectName) else (key.joint, key.variable)
    words = f"{one.words} (left out of the list)"
    return dataclasses.replace(one, key=Block(joint, effect), words=words, law=None, is_positive=False)


Variants = Callable[[Around, EffectName], Iterator[SeriesTerm]]


def _listed(scene: Scene, moves: bool) -> Iterator[tuple[str, EffectName, Variants]]:
    arm, recording = scene.arm, scene.recording

    def one(effect: str, variants: Variants, joint: int | None = None) -> tuple[str, EffectName, Variants]:
        return effect, EffectName(effect, joint), variants

    for joint in range(1, arm.joint_count + 1):
        if moves:
            for effect in FRICTION:
                yield one(effect, _friction, joint)
            yield one("stribeck_friction", _stribeck, joint)
            yield one("cogging", _cogging, joint)
            yield one("torque_constant", _plain, joint)
        yield one("joint_compliance", _compliance, joint)
        yield one("backlash", _backlash, joint)
        if recording.has_tip:
            for effect in ("encoder_eccentricity", "encoder_scale"):
                yield one(effect, _encoder, joint)
            yield one("thermal_drift", _drift, joint)
    if moves:
        yield one("payload", _plain)
        for k, link in enumerate(arm.links):
            if link.mass_kg is not None and link.com_m is not None:
                yield one("link_inertia", _inertia, k + 1)
    if recording.has_voltage:
        yield one("command_delay", _delay)
    if recording.has_current and recording.has_voltage:
        yield one("supply_sag", _sag)
    if recording.has_tip:
        if arm.joint_count >= 3:
            yield one("belt_coupling", _encoder)
        if all(link.mass_kg for link in arm.links if link.joint == "revolute"):
            for number in beams(arm):
                yield one("link_flexure", _plain, number)
        yield one("base_frame", _plain)
        yield one("link_geometry", _plain)


def usual(effect: str) -> float:
    """The usual size of an effect, in smallest sizes worth a name."""
    return USUAL_OF.get(effect, USUAL)


VALUES = {"base_frame": 6, "encoder_eccentricity": 2, "cogging": 2}


def _size(around: Around, law: Law) -> float:
    return usual(law.form) * typical(around.scene.arm, law.form, law.index)


def _made(
    around: Around,
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
    least: float = 0.0,
) -> Iterator[SeriesTerm]:
    """The term of a law's response per usual size; `more`: departures beside those of its variable."""
    if not laws:
        return
    joint = 0 if key.joint is None else key.joint - 1
    if key.effect == "belt_coupling":
        joint = 1
    departs = [own for own in (departures(around.scene, key.effect, joint, laws), more or {}) if own]
    parts = [laws, *departs, *nuisances]
    response = stacked(parts)
    count = next(iter(laws.values())).shape[1]
    width = next(iter(response.values())).shape[1]
    bends = sum(next(iter(own.values())).shape[1] for own in departs)
    yield SeriesTerm(
        key, str(key), count, bends, size, variant=variant, is_positive=is_positive,
        variable=VARIABLE.get(key.effect, ""), response=response, width=width, law=law, now=now, is_common=is_common,
        least=least,
    )  # fmt: skip


def _per_value(
    around: Around, law: Law, base: tuple[Law, ...], at: Array, steps: Sequence[float]
) -> Response:
    """How rows follow each value of a law around those that it has."""
    columns = []
    for place, step in enumerate(steps):
        values = list(law.values)
        values[place] += step
        columns.append((around.scene.rows.residual((*base, law.at(tuple(values)))) - at) / step)
    return around.scene.split(np.stack(columns, axis=1))


def _plain(around: Around, key: EffectName, form: str | None = None) -> Iterator[SeriesTerm]:
    """A law that the rows are linear in, or nearly so."""
    form = form or key.effect
    count = 4 * len(around.scene.arm.links) if form == "link_geometry" else VALUES.get(form.split()[0], 1)
    law = Law(key, form, (0.0,) * count)
    size = _size(around, law)
    base, at = around.without(key)
    own = around.found.get(key)
    start = own.values if own is not None and own.form == form else law.values
    if count == 1 and start[0]:  # a secant from nought to what was found
        column = (around.scene.rows.residual((*base, law.at((start[0],)))) - at) / start[0]
        response: Response = around.scene.split(column[:, None])
    else:
        response = _per_value(around, law, base, at, [0.3 * size] * count)
    is_positive = form in ("link_flexure", "supply_sag", "supply_sag by sum")
    yield from _made(
        around, key, scaled(response, size), size,
        lambda c: law.at(tuple((c[:count] * size).tolist())), is_positive=is_positive,
        now=np.array(start) / size if own is not None and own.form == form else None,
    )  # fmt: skip


def _friction(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    law = Law(key, key.effect, (1.0,))
    size = _size(around, law)
    is_common = key.effect in COMMON and not any(
        one.form in COMMON and one.name.joint == key.joint for one in around.known
    )
    yield from _made(
        around, key, scaled(_rubbed(around, law), size), size, lambda c: law.at((float(c[0]) * size,)),
        is_positive=key.effect == "load_friction" or is_common, now=_now(around, key, size), is_common=is_common,
    )  # fmt: skip


def _rubbed(around: Around, law: Law) -> Response:
    """Per unit of a friction's values at a motor; behind a soft or loose gear nothing of it is linear, and it is small."""
    return around.scene.split(around.scene.rows.friction_slope(law)[:, None])


def _now(around: Around, key: EffectName, size: float) -> Array | None:
    own = around.found.get(key)
    return None if own is None else np.array(own.values[:1]) / size


def _stribeck(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    size = USUAL * typical(around.scene.arm, key.effect, key.joint - 1 if key.joint else 0)
    own = around.found.get(key)
    speeds = STRIBECK_rad_s if own is None else (own.values[1],)
    forms = ("stribeck_friction", "stribeck exponential") if own is None else (own.form,)
    for form in forms:
        for speed in speeds:
            law = Law(key, form, (1.0, speed))
            here = _rubbed(around, law)
            there = _rubbed(around, law.at((1.0, 1.1 * speed)))
            slope = {cell: 2.0 * (there[cell] - here[cell]) * size for cell in here if cell in there}

            def made(c: Array, law: Law = law, speed: float = speed, width: int = 0) -> Law:
                share = 0.2 * float(c[-1] / c[0]) if c[0] > 0.0 else 0.0
                return law.at((float(c[0]) * size, speed * float(np.clip(1.0 + share, 0.6, 1.6))))

            now = None
            if own is not None and abs(speed / own.values[1] - 1.0) < 1e-9:
                now = np.array([own.values[0] / size])
            yield from _made(
                around, key, scaled(here, size), size, made, [slope], speed, is_positive=True, now=now
            )


def _cogging(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    """The orders that stand out of what is left, each beside its double; later, the one that was found."""
    own = around.found.get(key)
    size = _size(around, Law(key, "cogging", (0.0, 0.0), 1.0))
    waves: dict[float, Response] = {}

    def wave(order: float) -> Response:
        if order not in waves:
            waves[order] = scaled(_wave(around, Law(key, "cogging", (0.0, 0.0), order)), size)
        return waves[order]

    orders: Sequence[float] = ORDERS
    if own is None:
        orders = sorted(ORDERS, key=lambda order: -_stands_out(around, wave(order)))[:ORDERS_WEIGHED]
    for order in sorted(orders) if own is None else (own.order,):
        one = Law(key, "cogging", (0.0, 0.0), order)

        def made(c: Array, one: Law = one) -> Law:
            return one.at((float(c[0]) * size, float(c[1]) * size))

        yield from _made(
            around, key, wave(order), size, made, variant=order,
            now=None if own is None else np.array(own.values) / size, more=wave(2.0 * order),
        )  # fmt: skip


def _stands_out(around: Around, response: Response) -> float:
    """How much columns take off the residual's sum of squares, in each cell alone."""
    total = 0.0
    for cell, own in response.items():
        pull = own.T @ around.residual[around.scene.cells[cell].rows]
        total += float(pull @ np.linalg.lstsq(own.T @ own, pull, rcond=None)[0])
    return total


def _wave(around: Around, law: Law) -> Response:
    """Sine and cosine of cogging."""
    slopes = [around.scene.rows.friction_slope(law.at(values)) for values in ((1.0, 0.0), (0.0, 1.0))]
    return around.scene.split(np.stack(slopes, axis=1))


def _encoder(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    own = around.found.get(key)
    for where in ENCODER:
        form = key.effect + where
        if own is None or own.form == form:
            yield from _plain(around, key, form)


def _inertia(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    own = around.found.get(key)
    for form in ("mass_kg", "inertia_kg_m2"):
        if own is None or own.form == form:
            yield from _plain(around, key, form)


def _sag(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    own = around.found.get(key)
    for form in ("supply_sag", "supply_sag by sum"):
        if own is None or own.form == form:
            yield from _plain(around, key, form)


def _drift(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    own = around.found.get(key)
    forms = ("thermal_drift", "thermal_drift" + SEEN) if own is None else (own.form,)
    times = WARMING_s if own is None else tuple(own.values[1] * k for k in FINER)
    base, at = around.without(key)
    for form in forms:
        laws = [Law(key, form, (0.0, time_s)) for time_s in times]
        size = _size(around, laws[0])
        columns = [_step(around, law.at((1e-3, law.values[1])), base, at, size / 1e-3) for law in laws]
        for k, law in enumerate(laws[:-1]):
            time_s, ratio = times[k], times[k + 1] / times[k] - 1.0
            slope = {cell: columns[k + 1].get(cell, 0.0) - here for cell, here in columns[k].items()}

            def made(
                c: Array, law: Law = law, time_s: float = time_s, ratio: float = ratio, size: float = size
            ) -> Law:
                share = ratio * float(c[-1] / c[0]) if c[0] else 0.0
                return law.at((float(c[0]) * size, time_s * float(np.clip(1.0 + share, 0.6, 1.6))))

            now = None
            if own is not None and abs(time_s / own.values[1] - 1.0) < 1e-9:
                now = np.array([own.values[0] / size])
            yield from _made(around, key, columns[k], size, made, [slope], time_s, now=now)


def _step(around: Around, law: Law, base: tuple[Law, ...], at: Array, factor: float) -> Response:
    return around.scene.split(((around.scene.rows.residual((*base, law)) - at) * factor)[:, None])


@dataclass(frozen=True, slots=True)
class Bent:
    """A law that the rows follow in no straight line: starts of its first value, and steps of the others that are free."""

    starts: tuple[float, ...]
    others: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()
    upper: tuple[float, ...] = ()


DELAY = Bent(DELAYS_s)
COMPLIANCE = Bent(COMPLIANCES_rad_Nm, (DAMPING_Nm_s_rad, 0.0), (0.5, 0.5), (20.0, 1.0))
BACKLASH = Bent(WIDTHS_rad, (0.0,), (0.5,), (1.0,))


def _delay(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    yield from _secants(around, key, DELAY)


def _compliance(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    yield from _secants(around, key, COMPLIANCE)


def _backlash(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    yield from _secants(around, key, BACKLASH)


def _secants(around: Around, key: EffectName, bent: Bent) -> Iterator[SeriesTerm]:
    """The secant from nought to each start, how the next start's differs from it, and what the other values' steps do."""
    rows = around.scene.rows
    base, at = around.without(key)
    own = around.found.get(key)
    first = bent.starts if own is None else tuple(own.values[0] * k for k in FINER)
    others = bent.others if own is None else own.values[1:]
    steps = tuple(
        step if value + step <= upper else -step
        for value, step, upper in zip(others, bent.steps, bent.upper, strict=True)
    )
    asked = [
        [
            (v, *others),
            *((v, *others[:k], others[k] + step, *others[k + 1 :]) for k, step in enumerate(steps)),
        ]
        for v in first
    ]
    law = Law(key, key.effect, asked[0][0])
    size = _size(around, law)
    if key.effect != "command_delay":
        rows.physics.following.foresee(base, [law.at(values) for some in asked for values in some])
    moved = [[rows.residual((*base, law.at(values))) for values in some] for some in asked]
    secants = [(some[0] - at) * (size / v) for some, v in zip(moved, first, strict=True)]
    for k, value in enumerate(first if own is None else first[:1]):
        near = k + 1 if k + 1 < len(first) else k - 1
        bends = secants[near] - secants[k]
        columns = [secants[k], bends * value / size, *(one - moved[k][0] for one in moved[k][1:])]
        parts = [around.scene.split(column[:, None]) for column in columns]
        parts[1:] = [one or scaled(parts[0], 0.0) for one in parts[1:]]

        def made(c: Array, value: float = value) -> Law:
            found = float(np.clip(c[0] * size, 0.4 * value, 2.5 * value))
            more = np.array(others) + np.array(steps) * c[len(c) - len(steps) :]
            return law.at((found, *np.clip(more, 0.0, bent.upper).tolist()))

        now = np.array([value / size]) if own is not None and math.isclose(own.values[0], value) else None
        least = SPEAKS_FOR * value / size
        yield from _made(
            around, key, parts[0], size, made, parts[1:], value, is_positive=True, now=now, least=least
        )
