"""Friction at the motor: Coulomb, viscous, load-dependent, asymmetric, and Stribeck's fall near rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from calib.arrays import Array
from calib.gap.effects.columns import in_series, made, size_of_law
from calib.gap.effects.departures import by_angle, by_direction, by_load, by_speed
from calib.gap.effects.record import EffectRecord, InSeries
from calib.gap.finding import EffectName
from calib.gap.posterior.coefficients import values_of
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.scene import Response
from calib.gap.residuals.term import SeriesTerm, scaled
from calib.gap.signals.terms import Form, Law, Values
from control.model.effect_laws import Torque, direction
from control.model.effects import EFFECTS

STRIBECK_rad_s = (0.012, 0.022, 0.04, 0.07, 0.12, 0.22)
SLOWEST_STRIBECK_rad_s, FASTEST_STRIBECK_rad_s = (
    0.004,
    0.35,
)  # a fall over all speeds is Coulomb friction and something else
NOUGHT = (0.0,)


def torque_of(effect: str) -> Callable[[Values, float], Torque]:
    """The torque of an effect's record, by its linear unknowns and order."""
    law = EFFECTS[effect].torque
    if law is None:
        raise ValueError(f"{effect} has no torque")
    return lambda values, order: law({**values_of(effect, values), "order": order}, np)


def _exponential(values: Values, order: float) -> Torque:
    """Stribeck friction that falls as exp(-|v| / v_s): of bodies with another exponent than the Gaussian's."""
    torque_Nm, scale = values
    return lambda angle, speed, load: torque_Nm * np.exp(-np.abs(speed) / scale) * direction(speed, np)


def rubbed(around: OperatingPoint, law: Law) -> Response:
    """Per unit of a friction's values at a motor; behind a soft or loose gear nothing of it is linear, and it is small."""
    return around.scene.split(around.scene.columns.friction_slope(law)[:, None])


def friction(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    """A friction with one value; every gear has those that the file says nothing of."""
    series = in_series(record)
    law = Law(key, series.form, (1.0,))
    size = size_of_law(around, record, series.form, key)
    is_common = series.is_common and not any(
        one.form.shared and one.name.joint == key.joint for one in around.known
    )
    own = around.found.get(key)
    yield from made(
        around, record, key, scaled(rubbed(around, law), size), size, lambda c: law.at((float(c[0]) * size,)),
        is_positive=series.form.lower == NOUGHT or is_common,
        now=None if own is None else np.array(own.values[:1]) / size, is_common=is_common,
    )  # fmt: skip


def _stribeck(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    series = in_series(record)
    size = size_of_law(around, record, series.form, key)
    own = around.found.get(key)
    speeds = STRIBECK_rad_s if own is None else (own.values[1],)
    for form in series.forms if own is None else (own.form,):
        for speed in speeds:
            law = Law(key, form, (1.0, speed))
            here = rubbed(around, law)
            there = rubbed(around, law.at((1.0, 1.1 * speed)))
            slope = {cell: 2.0 * (there[cell] - here[cell]) * size for cell in here if cell in there}

            def law_of(c: Array, law: Law = law, speed: float = speed) -> Law:
                share = 0.2 * float(c[-1] / c[0]) if c[0] > 0.0 else 0.0
                return law.at((float(c[0]) * size, speed * float(np.clip(1.0 + share, 0.6, 1.6))))

            now = None
            if own is not None and abs(speed / own.values[1] - 1.0) < 1e-9:
                now = np.array([own.values[0] / size])
            yield from made(
                around,
                record,
                key,
                scaled(here, size),
                size,
                law_of,
                [slope],
                speed,
                is_positive=True,
                now=now,
            )


def _known_stribeck(series: InSeries, name: EffectName, given: Mapping[str, float]) -> Law:
    return Law(name, series.form, (given["torque_Nm"], given["speed_rad_s"]))


def _fall(name: str, torque: Callable[[Values, float], Torque]) -> Form:
    """A form of Stribeck friction: torque and speed."""
    return Form(
        name, "motor", 0.08, count=2, counted=1, is_torque=True, steps=(1e-2, 2e-3), lower=(0.0, SLOWEST_STRIBECK_rad_s),
        upper=(np.inf, FASTEST_STRIBECK_rad_s), torque=torque,
    )  # fmt: skip


COULOMB = Form(
    "coulomb_friction", "motor", 0.03, is_torque=True, torque=torque_of("coulomb_friction"), shared="coulomb"
)
VISCOUS = Form(
    "viscous_friction", "motor", 0.03, is_torque=True, torque=torque_of("viscous_friction"), shared="viscous"
)
LOAD = Form("load_friction", "motor", 0.02, lower=NOUGHT, torque=torque_of("load_friction"))
ASYMMETRIC = Form(
    "asymmetric_friction", "motor", 0.03, is_torque=True, torque=torque_of("asymmetric_friction")
)
STRIBECK = _fall("stribeck_friction", torque_of("stribeck_friction"))

RECORDS = (
    EffectRecord(
        "coulomb_friction", role="torque",
        # it departs with the angle: with speed it is viscous friction, with direction asymmetric
        series=InSeries(
            (COULOMB,), friction, "motor", usual=20.0, departs=(by_angle,), variable="angle", over="speed",
            blocks=("friction angle", "turned"), is_common=True,
        ),
    ),
    EffectRecord(
        "viscous_friction", role="torque",
        series=InSeries(
            (VISCOUS,), friction, "motor", usual=20.0, departs=(by_speed, by_angle, by_direction), variable="speed",
            over="speed", blocks=("speed",), is_common=True,
        ),
    ),
    EffectRecord(
        "load_friction", role="torque",
        series=InSeries((LOAD,), friction, "motor", departs=(by_load, by_angle), variable="load", blocks=("load",)),
    ),
    EffectRecord(
        "asymmetric_friction", role="torque",
        series=InSeries(
            (ASYMMETRIC,), friction, "motor", departs=(by_angle, by_speed), variable="angle", over="speed",
            blocks=("friction angle",),
        ),
    ),
    EffectRecord(
        "stribeck_friction", role="torque",
        series=InSeries(
            (STRIBECK, _fall("stribeck exponential", _exponential)), _stribeck, "motor", departs=(by_speed, by_angle),
            variable="speed", over="speed", blocks=("slow", "speed"), known=_known_stribeck,
        ),
    ),
)  # fmt: skip
