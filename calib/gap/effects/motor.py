"""What acts at the motor: frictions, cogging, late commands and a supply that gives way; and when a sample is read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from calib.arrays import Array
from calib.gap.effects.record import (
    Bent,
    EffectRecord,
    InSeries,
    Sought,
    by_angle,
    by_currents,
    by_direction,
    by_load,
    by_speed,
    filled,
    secants,
    shaped,
    straight,
)
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.term import Traits, parameters_of, values_of
from calib.gap.residuals.scene import OperatingPoint, Response, SeriesTerm, scaled
from calib.gap.signals.body import sorted_terms
from calib.gap.signals.terms import Form, Law, Values, motor_ahead
from control.model.arm import Arm
from control.model.effects import EFFECTS, Torque, direction

STRIBECK_rad_s = (0.012, 0.022, 0.04, 0.07, 0.12, 0.22)
# a fall over all speeds is Coulomb friction and something else
SLOWEST_STRIBECK_rad_s, FASTEST_STRIBECK_rad_s = 0.004, 0.35
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


def rubbed(point: OperatingPoint, law: Law) -> Response:
    """Per unit of a friction's values at a motor; behind a soft or loose gear nothing of it is linear, and it is small."""
    return point.scene.split(point.scene.columns.friction_slope(law)[:, None])


def friction(sought: Sought) -> Iterator[SeriesTerm]:
    """A friction with one value; every gear has those that the file says nothing of."""
    point, identified, form = sought.point, sought.identified, sought.series.form
    law, size = Law(sought.key, form, (1.0,)), sought.size(form)
    is_common = sought.series.is_common and not any(
        known.form.shared and known.name.joint == sought.key.joint for known in point.known
    )
    term = SeriesTerm(
        sought.key,
        size=size,
        law=lambda c: law.at((float(c[0]) * size,)),
        is_positive=form.lower == NOUGHT or is_common,
        now=None if identified is None else np.array(identified.values[:1]) / size,
        is_common=is_common,
    )
    yield from filled(sought, term, scaled(rubbed(point, law), size))


def _stribeck(sought: Sought) -> Iterator[SeriesTerm]:
    identified, size = sought.identified, sought.size(sought.series.form)
    for form in sought.forms:
        for speed in STRIBECK_rad_s if identified is None else (identified.values[1],):
            here, there = (rubbed(sought.point, Law(sought.key, form, (1.0, v_rad_s))) for v_rad_s in (speed, 1.1 * speed))
            slope = {cell: 2.0 * (there[cell] - here[cell]) * size for cell in here if cell in there}
            yield from shaped(sought, form, speed, 0.2, (scaled(here, size), slope))


def _known_stribeck(series: InSeries, name: EffectName, parameters: Mapping[str, float]) -> Law:
    return Law(name, series.form, (parameters["torque_Nm"], parameters["speed_rad_s"]))


def _fall(name: str, torque: Callable[[Values, float], Torque]) -> Form:
    """A form of Stribeck friction: torque and speed."""
    return Form(
        name,
        "motor",
        0.08,
        count=2,
        counted=1,
        is_torque=True,
        steps=(1e-2, 2e-3),
        lower=(0.0, SLOWEST_STRIBECK_rad_s),
        upper=(np.inf, FASTEST_STRIBECK_rad_s),
        torque=torque,
    )


COULOMB = Form("coulomb_friction", "motor", 0.03, is_torque=True, torque=torque_of("coulomb_friction"), shared="coulomb")
VISCOUS = Form("viscous_friction", "motor", 0.03, is_torque=True, torque=torque_of("viscous_friction"), shared="viscous")
LOAD = Form("load_friction", "motor", 0.02, lower=NOUGHT, torque=torque_of("load_friction"))
ASYMMETRIC = Form("asymmetric_friction", "motor", 0.03, is_torque=True, torque=torque_of("asymmetric_friction"))
STRIBECK = _fall("stribeck_friction", torque_of("stribeck_friction"))


ORDERS = tuple(float(order) for order in range(1, 97))  # waves a turn of the motor
WAVES_LEAST = 4.0  # a turn of the joint: fewer are gravity's, or a bent shaft's
ORDERS_WEIGHED = 6  # of a joint's cogging: the others stand out less


def _cogging(sought: Sought) -> Iterator[SeriesTerm]:
    """The orders that stand out of what is left, each beside its double; later, the one that was found."""
    point, identified, form = sought.point, sought.identified, sought.series.form
    key, size = sought.key, sought.size(form)
    waves: dict[float, Response] = {}

    def wave(order: float) -> Response:
        if order not in waves:
            law, columns = Law(key, form, (0.0, 0.0), order), point.scene.columns
            slopes = [columns.friction_slope(law.at(phase), point.model) for phase in ((1.0, 0.0), (0.0, 1.0))]
            waves[order] = scaled(point.scene.split(np.stack(slopes, axis=1)), size)
        return waves[order]

    for order in sorted(_standing_out(point, key)) if identified is None else (identified.order,):

        def law_of(c: Array, order: float = order) -> Law:
            return Law(key, form, (float(c[0]) * size, float(c[1]) * size), order)

        now = None if identified is None else np.array(identified.values) / size
        term = SeriesTerm(key, size=size, law=law_of, variant=order, now=now)
        yield from filled(sought, term, wave(order), more=wave(2.0 * order))


def _standing_out(point: OperatingPoint, key: EffectName) -> list[float]:
    """The orders whose waves take most off what is left of a joint's current, as the filter of its rows lets them through."""
    scene, j = point.scene, key.joint - 1 if key.joint else 0
    number = scene.number("current_A", j)
    if number is None:
        return []
    at, residual = scene.beside[number], point.residual[scene.cells[number].rows]
    ratio, filters = scene.rows.physics.gear_ratios[j], scene.recording.filters
    passed = np.abs(np.fft.rfft(filters.row, 2048)) / abs(float(filters.row.sum()))
    frequencies = np.fft.rfftfreq(2048, 1.0 / filters.rate_Hz)

    q = at.q + motor_ahead(sorted_terms(point.model).angles, at.q, at.t_s)

    def taken(order: float) -> float:
        angle = order * ratio * q[:, j]
        through = np.interp(np.abs(order * ratio * at.speed[:, j]) / (2.0 * np.pi), frequencies, passed)
        waves = np.array([np.sin(angle), np.cos(angle)]) * through
        pull = waves @ residual
        return float(pull @ np.linalg.lstsq(waves @ waves.T, pull, rcond=None)[0])

    orders = [order for order in ORDERS if order * ratio >= WAVES_LEAST]
    return sorted(orders, key=lambda order: -taken(order))[:ORDERS_WEIGHED]


def _parameters(arm: Arm, law: Law, covariance: Array) -> Parameters:
    wave = parameters_of("cogging")(np.array(law.values), covariance)
    return {**wave, "order": (law.order, 0.0)}


FORM = Form(
    "cogging", "motor", 0.05, count=2, is_torque=True, torque=torque_of("cogging"), is_of_motor=EFFECTS["cogging"].is_of_motor
)


SAMPLING = "sampling time"  # of the boards; no effect of the arm, and taken off
DELAYS_s = (0.0004, 0.0008, 0.0018, 0.003, 0.0046, 0.007, 0.01)
READ_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a period, after the voltage has changed
LATEST_s = 0.02  # of a sample after the voltage that it follows
LATE = Traits(alternative="late")  # a command is late, or what is read of it is


def _sampling(sought: Sought) -> Iterator[SeriesTerm]:
    period_s = 1.0 / sought.point.scene.recording.filters.rate_Hz
    return secants(sought, Bent(tuple(share * period_s for share in READ_SHARES), most=period_s))


def _by_duty(voltage: Array, current: Array, supply: Array) -> Array:
    """A bridge draws duty times motor current."""
    return np.asarray(np.sum(voltage / supply * current, axis=1, keepdims=True))


def _by_sum(voltage: Array, current: Array, supply: Array) -> Array:
    """All motors' currents, whatever their sign."""
    return np.asarray(np.sum(np.abs(current), axis=1, keepdims=True))


RECORDS = (
    EffectRecord(
        "coulomb_friction",
        role="torque",
        # it departs with the angle: with speed it is viscous friction, with direction asymmetric
        series=InSeries(
            (COULOMB,),
            friction,
            "motor",
            usual=20.0,
            departs=(by_angle,),
            variable="angle",
            over="speed",
            blocks=("friction angle", "turned"),
            is_common=True,
        ),
    ),
    EffectRecord(
        "viscous_friction",
        role="torque",
        series=InSeries(
            (VISCOUS,),
            friction,
            "motor",
            usual=20.0,
            departs=(by_speed, by_angle, by_direction),
            variable="speed",
            over="speed",
            blocks=("speed",),
            is_common=True,
        ),
    ),
    EffectRecord(
        "load_friction",
        role="torque",
        series=InSeries((LOAD,), friction, "motor", departs=(by_load, by_angle), variable="load", blocks=("load",)),
    ),
    EffectRecord(
        "asymmetric_friction",
        role="torque",
        series=InSeries(
            (ASYMMETRIC,),
            friction,
            "motor",
            departs=(by_angle, by_speed),
            variable="angle",
            over="speed",
            blocks=("friction angle",),
        ),
    ),
    EffectRecord(
        "stribeck_friction",
        role="torque",
        series=InSeries(
            (STRIBECK, _fall("stribeck exponential", _exponential)),
            _stribeck,
            "motor",
            departs=(by_speed, by_angle),
            variable="speed",
            over="speed",
            blocks=("slow", "speed"),
            known=_known_stribeck,
        ),
    ),
    EffectRecord(
        "cogging",
        role="torque",
        needs_drives=True,
        series=InSeries((FORM,), _cogging, "motor", departs=(by_angle,), variable="angle", over="motor", parameters=_parameters),
    ),
    EffectRecord(
        SAMPLING,
        traits=LATE,
        series=InSeries((Form(SAMPLING, "sampling", 5e-5, steps=(2e-5,), lower=(0.0,), upper=(LATEST_s,)),), _sampling, "motor"),
    ),
    EffectRecord(
        "command_delay",
        traits=LATE,
        needs_drives=True,
        series=InSeries(
            (Form("command_delay", "delay", 2e-4, steps=(2e-5,), lower=(0.0,), upper=(math.inf,)),),
            lambda sought: secants(sought, Bent(DELAYS_s)),
            "electrical",
            over="current",
        ),
    ),
    EffectRecord(
        "supply_sag",
        needs_drives=True,
        series=InSeries(
            (
                Form("supply_sag", "sag", 0.01, lower=(0.0,), drawn=_by_duty),
                Form("supply_sag by sum", "sag", 0.01, lower=(0.0,), drawn=_by_sum),
            ),
            straight,
            "electrical",
            departs=(by_currents,),
            variable="current",
            over="current",
            least=lambda arm, law: 0.0,
        ),
    ),
)
