"""Columns of friction and cogging, which the rows follow in straight lines."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.residuals.sizes import typical
from calib.gap.series.around import Around, made, size_of_law
from calib.gap.series.constants import USUAL
from calib.gap.series.scene import Response
from calib.gap.series.term import SeriesTerm, scaled
from calib.gap.signals.terms import Term as Law

FRICTION = ("coulomb_friction", "viscous_friction", "load_friction", "asymmetric_friction")
COMMON = ("coulomb_friction", "viscous_friction")  # of every gear, where the file knows of neither
STRIBECK_rad_s = (0.012, 0.022, 0.04, 0.07, 0.12, 0.22)
ORDERS = tuple(float(order) for order in range(1, 97))  # waves a turn of the motor
WAVES_LEAST = 4.0  # a turn of the joint: fewer are gravity's, or a bent shaft's
ORDERS_WEIGHED = 6  # of a joint's cogging: the others stand out less


def friction(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    law = Law(key, key.effect, (1.0,))
    size = size_of_law(around, law)
    is_common = key.effect in COMMON and not any(
        one.form in COMMON and one.name.joint == key.joint for one in around.known
    )
    yield from made(
        around, key, scaled(_rubbed(around, law), size), size, lambda c: law.at((float(c[0]) * size,)),
        is_positive=key.effect == "load_friction" or is_common, now=_now(around, key, size), is_common=is_common,
    )  # fmt: skip


def _rubbed(around: Around, law: Law) -> Response:
    """Per unit of a friction's values at a motor; behind a soft or loose gear nothing of it is linear, and it is small."""
    return around.scene.split(around.scene.columns.friction_slope(law)[:, None])


def _now(around: Around, key: EffectName, size: float) -> Array | None:
    own = around.found.get(key)
    return None if own is None else np.array(own.values[:1]) / size


def stribeck(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
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

            def law_of(c: Array, law: Law = law, speed: float = speed, width: int = 0) -> Law:
                share = 0.2 * float(c[-1] / c[0]) if c[0] > 0.0 else 0.0
                return law.at((float(c[0]) * size, speed * float(np.clip(1.0 + share, 0.6, 1.6))))

            now = None
            if own is not None and abs(speed / own.values[1] - 1.0) < 1e-9:
                now = np.array([own.values[0] / size])
            yield from made(
                around, key, scaled(here, size), size, law_of, [slope], speed, is_positive=True, now=now
            )


def cogging(around: Around, key: EffectName) -> Iterator[SeriesTerm]:
    """The orders that stand out of what is left, each beside its double; later, the one that was found."""
    own = around.found.get(key)
    size = size_of_law(around, Law(key, "cogging", (0.0, 0.0), 1.0))
    waves: dict[float, Response] = {}

    def wave(order: float) -> Response:
        if order not in waves:
            waves[order] = scaled(_wave(around, Law(key, "cogging", (0.0, 0.0), order)), size)
        return waves[order]

    for order in sorted(_standing_out(around, key)) if own is None else (own.order,):
        one = Law(key, "cogging", (0.0, 0.0), order)

        def law_of(c: Array, one: Law = one) -> Law:
            return one.at((float(c[0]) * size, float(c[1]) * size))

        yield from made(
            around, key, wave(order), size, law_of, variant=order,
            now=None if own is None else np.array(own.values) / size, more=wave(2.0 * order),
        )  # fmt: skip


def _standing_out(around: Around, key: EffectName) -> list[float]:
    """The orders whose waves take most off what is left of a joint's current, as the filter of its rows lets them through."""
    scene, j = around.scene, key.joint - 1 if key.joint else 0
    number = scene.number("current_A", j)
    if number is None:
        return []
    at, left = scene.beside[number], around.residual[scene.cells[number].rows]
    ratio, filters = scene.rows.physics.gear_ratios[j], scene.recording.filters
    passed = np.abs(np.fft.rfft(filters.row, 2048)) / abs(float(filters.row.sum()))
    frequencies = np.fft.rfftfreq(2048, 1.0 / filters.rate_Hz)

    def taken(order: float) -> float:
        angle = order * ratio * at.q[:, j]
        through = np.interp(np.abs(order * ratio * at.speed[:, j]) / (2.0 * np.pi), frequencies, passed)
        waves = np.array([np.sin(angle), np.cos(angle)]) * through
        pull = waves @ left
        return float(pull @ np.linalg.lstsq(waves @ waves.T, pull, rcond=None)[0])

    orders = [order for order in ORDERS if order * ratio >= WAVES_LEAST]
    return sorted(orders, key=lambda order: -taken(order))[:ORDERS_WEIGHED]


def _wave(around: Around, law: Law) -> Response:
    """Sine and cosine of cogging."""
    slopes = [around.scene.columns.friction_slope(law.at(values)) for values in ((1.0, 0.0), (0.0, 1.0))]
    return around.scene.split(np.stack(slopes, axis=1))
