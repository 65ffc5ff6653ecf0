"""The effects as data: one record each, with its forms, where it acts, how its search begins, and what else of it is free."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np

from calib.arm_problem.link_bending import beams
from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.posterior.term import Block, Key
from calib.gap.series.around import Around, made, size_of_law
from calib.gap.series.bends import backlash, compliance, delay, drift, sampling
from calib.gap.series.constants import MISSING_MOST
from calib.gap.series.departures import GEARS
from calib.gap.series.frictions import FRICTION, cogging, friction, stribeck
from calib.gap.series.scene import Response, Scene
from calib.gap.series.term import SeriesTerm, scaled
from calib.gap.signals.angles import BEHIND, SEEN
from calib.gap.signals.terms import Term as Law

SAMPLING = "sampling time"  # of the boards; no effect of the arm, and taken off
ENCODER = ("", BEHIND, SEEN)


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
        is_listed = names is None or effect in names or effect == SAMPLING
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
    return dataclasses.replace(one, key=Block(joint, effect), words=words, law=None)


Variants = Callable[[Around, EffectName], Iterator[SeriesTerm]]


def _listed(scene: Scene, moves: bool) -> Iterator[tuple[str, EffectName, Variants]]:
    arm, recording = scene.arm, scene.recording

    def one(effect: str, variants: Variants, joint: int | None = None) -> tuple[str, EffectName, Variants]:
        return effect, EffectName(effect, joint), variants

    for joint in range(1, arm.joint_count + 1):
        if moves:
            for effect in FRICTION:
                yield one(effect, friction, joint)
            yield one("stribeck_friction", stribeck, joint)
            yield one("cogging", cogging, joint)
            yield one("torque_constant", _plain, joint)
        yield one("joint_compliance", compliance, joint)
        yield one("backlash", backlash, joint)
        if recording.has_tip:
            for effect in ("encoder_eccentricity", "encoder_scale"):
                yield one(effect, _encoder, joint)
            yield one("thermal_drift", drift, joint)
    if moves:
        yield one("payload", _plain)
        for k, link in enumerate(arm.links):
            if link.mass_kg is not None and link.com_m is not None:
                yield one("link_inertia", _inertia, k + 1)
    if moves:
        yield one(SAMPLING, sampling)
    if recording.has_current and recording.has_voltage:  # of voltages alone, all that is slow looks late
        yield one("command_delay", delay)
        yield one("supply_sag", _sag)
    if recording.has_tip:
        if arm.joint_count >= 3:
            yield one("belt_coupling", _encoder)
        if all(link.mass_kg for link in arm.links if link.joint == "revolute"):
            for number in beams(arm):
                yield one("link_flexure", _plain, number)
        yield one("base_frame", _plain)
        yield one("link_geometry", _plain)


VALUES = {"base_frame": 6, "encoder_eccentricity": 2, "cogging": 2}


def _per_value(
    around: Around, law: Law, base: tuple[Law, ...], at: Array, steps: Sequence[float]
) -> Response:
    """How rows follow each value of a law around those that it has."""
    columns = []
    for place, step in enumerate(steps):
        values = list(law.values)
        values[place] += step
        columns.append((around.scene.columns.residual((*base, law.at(tuple(values)))) - at) / step)
    return around.scene.split(np.stack(columns, axis=1))


def _plain(around: Around, key: EffectName, form: str | None = None) -> Iterator[SeriesTerm]:
    """A law that the rows are linear in, or nearly so."""
    form = form or key.effect
    count = 4 * len(around.scene.arm.links) if form == "link_geometry" else VALUES.get(form.split()[0], 1)
    law = Law(key, form, (0.0,) * count)
    size = size_of_law(around, law)
    base, at = around.without(key)
    own = around.found.get(key)
    start = own.values if own is not None and own.form == form else law.values
    if count == 1 and start[0]:  # a secant from nought to what was found
        column = (around.scene.columns.residual((*base, law.at((start[0],)))) - at) / start[0]
        response: Response = around.scene.split(column[:, None])
    else:
        response = _per_value(around, law, base, at, [0.3 * size] * count)
    least = _least(around, law)
    yield from made(
        around, key, scaled(response, size), size,
        lambda c: law.at(tuple((c[:count] * size).tolist())), is_positive=math.isfinite(least),
        reach=(max(least, -1e6) / size, math.inf),
        now=np.array(start) / size if own is not None and own.form == form else None,
    )  # fmt: skip


def _least(around: Around, law: Law) -> float:
    """What a law's value cannot be below."""
    link = around.scene.arm.links[law.index] if law.index >= 0 else None
    match law.form:
        case "payload" | "link_flexure" | "supply_sag" | "supply_sag by sum":
            return 0.0
        case "mass_kg" if link is not None and link.mass_kg:
            return -MISSING_MOST * link.mass_kg
        case "inertia_kg_m2" if link is not None and link.inertia_kg_m2 is not None:
            return -MISSING_MOST * max(link.inertia_kg_m2)
        case _:
            return -math.inf


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
