"""Cogging: a torque that comes round with the motor's shaft, a number of times a turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arrays import Array
from calib.gap.effects.columns import in_series, made, size_of_law
from calib.gap.effects.departures import by_angle
from calib.gap.effects.friction import torque_of
from calib.gap.effects.record import EffectRecord, InSeries
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.coefficients import parameters_of
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.scene import Response
from calib.gap.residuals.term import SeriesTerm, scaled
from calib.gap.signals.angles import motor_ahead
from calib.gap.signals.parts import sorted_terms
from calib.gap.signals.terms import Form, Law
from control.model.arm import Arm
from control.model.effects import EFFECTS

ORDERS = tuple(float(order) for order in range(1, 97))  # waves a turn of the motor
WAVES_LEAST = 4.0  # a turn of the joint: fewer are gravity's, or a bent shaft's
ORDERS_WEIGHED = 6  # of a joint's cogging: the others stand out less


def _cogging(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    """The orders that stand out of what is left, each beside its double; later, the one that was found."""
    own, form = around.found.get(key), in_series(record).form
    size = size_of_law(around, record, form, key)
    waves: dict[float, Response] = {}

    def wave(order: float) -> Response:
        if order not in waves:
            waves[order] = scaled(_wave(around, Law(key, form, (0.0, 0.0), order)), size)
        return waves[order]

    for order in sorted(_standing_out(around, key)) if own is None else (own.order,):
        one = Law(key, form, (0.0, 0.0), order)

        def law_of(c: Array, one: Law = one) -> Law:
            return one.at((float(c[0]) * size, float(c[1]) * size))

        yield from made(
            around, record, key, wave(order), size, law_of, variant=order,
            now=None if own is None else np.array(own.values) / size, more=wave(2.0 * order),
        )  # fmt: skip


def _standing_out(around: OperatingPoint, key: EffectName) -> list[float]:
    """The orders whose waves take most off what is left of a joint's current, as the filter of its rows lets them through."""
    scene, j = around.scene, key.joint - 1 if key.joint else 0
    number = scene.number("current_A", j)
    if number is None:
        return []
    at, left = scene.beside[number], around.residual[scene.cells[number].rows]
    ratio, filters = scene.rows.physics.gear_ratios[j], scene.recording.filters
    passed = np.abs(np.fft.rfft(filters.row, 2048)) / abs(float(filters.row.sum()))
    frequencies = np.fft.rfftfreq(2048, 1.0 / filters.rate_Hz)

    q = at.q + motor_ahead(sorted_terms(around.model).angles, at.q, at.t_s)

    def taken(order: float) -> float:
        angle = order * ratio * q[:, j]
        through = np.interp(np.abs(order * ratio * at.speed[:, j]) / (2.0 * np.pi), frequencies, passed)
        waves = np.array([np.sin(angle), np.cos(angle)]) * through
        pull = waves @ left
        return float(pull @ np.linalg.lstsq(waves @ waves.T, pull, rcond=None)[0])

    orders = [order for order in ORDERS if order * ratio >= WAVES_LEAST]
    return sorted(orders, key=lambda order: -taken(order))[:ORDERS_WEIGHED]


def _wave(around: OperatingPoint, law: Law) -> Response:
    """Sine and cosine of cogging."""
    columns, model = around.scene.columns, around.model
    slopes = [columns.friction_slope(law.at(values), model) for values in ((1.0, 0.0), (0.0, 1.0))]
    return around.scene.split(np.stack(slopes, axis=1))


def _parameters(arm: Arm, law: Law, covariance: Array) -> Parameters:
    wave = parameters_of("cogging")(np.array(law.values), covariance)
    return {**wave, "order": (law.order, 0.0)}


FORM = Form(
    "cogging",
    "motor",
    0.05,
    count=2,
    is_torque=True,
    torque=torque_of("cogging"),
    is_of_motor=EFFECTS["cogging"].is_of_motor,
)
RECORDS = (
    EffectRecord(
        "cogging", role="torque", needs_drives=True,
        series=InSeries(
            (FORM,), _cogging, "motor", departs=(by_angle,), variable="angle", over="motor", parameters=_parameters
        ),
    ),
)  # fmt: skip
