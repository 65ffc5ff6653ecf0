"""Errors of a joint's angle: of encoders and of the belt with the angle, of what warms up with time."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np

from calib.arrays import Array
from calib.gap.effects.record import (
    FINER,
    EffectRecord,
    InPoses,
    InSeries,
    PoseScene,
    Sought,
    by_angle,
    harmonics,
    shaped,
    straight,
)
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.term import Term, ToParameters, Traits, like
from calib.gap.residuals.scene import SeriesTerm
from calib.gap.signals.terms import AngleLaw, Form, Law, Values
from control.model.arm import Arm
from control.model.effects import COUPLED, COUPLED_TO, EFFECTS


def _scale(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    for j, q in enumerate(scene.points.q_rad.T):
        yield record.on_joint(scene, j + 1, q, like(q, harmonics(q, 1, 2)))


def _eccentricity(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    for j, q in enumerate(scene.points.q_rad.T):
        yield record.on_joint(scene, j + 1, np.array(harmonics(q, 1)), harmonics(q, 2, 3))


def _coupling(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    if scene.points.joint_count >= COUPLED and scene.arm.is_behind_encoder(record.effect, None):
        angle = scene.points.q_rad[:, COUPLED_TO - 1]
        yield record.on_joint(scene, None, angle, like(angle, harmonics(angle, 1, 2)))


def _in_proportion(values: Values, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    return values[0] * q, np.full_like(q, values[0]), np.zeros_like(q)


def _once_a_turn(values: Values, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    sine, cosine = np.sin(q), np.cos(q)
    error = values[0] * sine + values[1] * cosine
    return error, values[0] * cosine - values[1] * sine, -error


def forms_of(name: str, smallest: float, angle: AngleLaw, count: int = 1) -> tuple[Form, ...]:
    """An error of an angle at the motor's encoder, between motor and link, and as the camera alone sees it."""

    def form(tail: str, where: Literal["encoder", "behind", "seen"]) -> Form:
        return Form(name + tail, "angle", smallest, count=count, angle=angle, where=where)

    return form("", "encoder"), form(" behind", "behind"), form(" seen", "seen")


def _belts(arm: Arm) -> tuple[None, ...]:
    return (None,) if arm.joint_count >= COUPLED and arm.is_behind_encoder("belt_coupling", None) else ()


TIME_CONSTANTS_s = np.geomspace(30.0, 30_000.0, 19)  # of poses
TIMES_SPAN = 1.5  # of a session: a longer time constant bends its course too little to be one
OTHER_TIMES = 3.0  # between the time constants of a part that warms in two stages
WARMING_s = (0.8, 2.0, 5.0, 12.0, 40.0, 300.0)  # time constants of time series
QUICKEST_s = 0.6  # quicker, a drift has gone by before a run counts, and is a zero


def _in_poses(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    elapsed = scene.points.elapsed_s
    if not np.isfinite(elapsed).all() or np.ptp(elapsed) == 0.0:
        return
    for j in range(scene.points.joint_count):
        for constant in TIME_CONSTANTS_s[TIME_CONSTANTS_s <= TIMES_SPAN * elapsed.max()].tolist():
            law = 1.0 - np.exp(-elapsed / constant)
            others = [1.0 - np.exp(-elapsed / (constant * f)) for f in (OTHER_TIMES, 1.0 / OTHER_TIMES)]
            departs = like(law, [other - law * (other @ law) / (law @ law) for other in others])
            term = record.on_joint(scene, j + 1, law, departs)
            parameters = _final(constant, float("nan"))
            yield dataclasses.replace(term, variant=constant, parameters=parameters, between=_final)


def _final(constant_s: float, sd: float) -> ToParameters:
    """`sd`: of the constant's logarithm."""

    def made(value: Array, covariance: Array) -> Parameters:
        final = float(value[0]), float(np.sqrt(covariance[0, 0]))
        return {"final_rad": final, "time_constant_s": (constant_s, sd * constant_s)}

    return made


def _in_series(sought: Sought) -> Iterator[SeriesTerm]:
    """Over a milliradian at each time constant; how that changes with it is what the next one has more."""
    identified, scene = sought.identified, sought.point.scene
    times = WARMING_s if identified is None else tuple(identified.values[1] * k for k in FINER)
    base, at = sought.point.without(sought.key)
    for form in sought.forms:
        size, columns = sought.size(form), []
        for time_s in times:
            moved = scene.columns.residual((*base, Law(sought.key, form, (1e-3, time_s)))) - at
            columns.append(scene.split((moved * (size / 1e-3))[:, None]))
        for (time_s, here), (later_s, there) in itertools.pairwise(zip(times, columns, strict=True)):
            slope = {cell: there.get(cell, 0.0) - own_rows for cell, own_rows in here.items()}
            yield from shaped(sought, form, time_s, later_s / time_s - 1.0, (here, slope))


def _warmed(values: Values, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    """By time; warm-up begins where the clock of the log does."""
    first, constant = values
    gone = np.exp(-t_s / constant)
    return first * (1.0 - gone), first / constant * gone, -first / constant**2 * gone


def _form(name: str, where: Literal["behind", "seen"]) -> Form:
    return Form(
        name,
        "angle",
        3e-4,
        count=2,
        counted=1,
        steps=(1e-4, 5e-2),
        lower=(-np.inf, QUICKEST_s),
        upper=(np.inf, 1e5),
        angle=_warmed,
        where=where,
        is_by_time=True,
    )


def _known(series: InSeries, name: EffectName, parameters: Mapping[str, float]) -> Law | None:
    if name.joint is None:
        return None
    return Law(name, series.form, (parameters["final_rad"], parameters["time_constant_s"]))


def _parameters(arm: Arm, law: Law, covariance: Array) -> Parameters:
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    return dict(zip(EFFECTS[law.name.effect].required, zip(law.values, sd, strict=False), strict=True))


RECORDS = (
    EffectRecord(
        "encoder_scale",
        role="angle",
        traits=Traits(blocks="q{j}"),
        poses=InPoses(0.005, _scale, "poses over the whole travel of that joint", variable="q{j}"),
        series=InSeries(
            forms_of("encoder_scale", 5e-4, _in_proportion),
            straight,
            "tip",
            departs=(by_angle,),
            variable="angle",
            blocks=("tip angle", "tip ripple"),
            over="angle",
        ),
    ),
    EffectRecord(
        "encoder_eccentricity",
        role="angle",
        traits=Traits(blocks="q{j}"),
        poses=InPoses(0.003, _eccentricity, "poses over more than 120 degrees of that joint", variable="q{j}"),
        series=InSeries(
            forms_of("encoder_eccentricity", 3e-4, _once_a_turn, 2),
            straight,
            "tip",
            departs=(by_angle,),
            variable="angle",
            blocks=("tip angle", "tip ripple"),
            over="angle",
        ),
    ),
    EffectRecord(
        "belt_coupling",
        role="angle",
        traits=Traits(blocks="other angles"),
        poses=InPoses(
            0.01, _coupling, f"poses in which joint {COUPLED_TO} moves while joint {COUPLED} stands", variable=f"q{COUPLED_TO}"
        ),
        series=InSeries(
            forms_of("belt_coupling", 5e-4, _in_proportion),
            straight,
            "tip",
            departs=(by_angle,),
            variable=f"angle of joint {COUPLED_TO}",
            blocks=(f"tip angle of joint {COUPLED_TO}",),
            over="angle",
            places=_belts,
        ),
    ),
    EffectRecord(
        "thermal_drift",
        role="angle",
        traits=Traits(blocks="time"),
        poses=InPoses(
            0.003, _in_poses, "the same reference pose every few minutes, the others in shuffled order", variable="time"
        ),
        series=InSeries(
            (_form("thermal_drift", "behind"), _form("thermal_drift seen", "seen")),
            _in_series,
            "tip",
            blocks=("tip time",),
            over="time",
            known=_known,
            parameters=_parameters,
        ),
    ),
)
