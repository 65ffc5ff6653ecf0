"""Encoders or links that warm up: an angle that approaches a final error with time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np

from calib.arrays import Array
from calib.gap.effects.columns import in_series, made, size_of_law
from calib.gap.effects.pose_columns import term_on_joint
from calib.gap.effects.pose_scene import PoseScene
from calib.gap.effects.record import EffectRecord, InPoses, InSeries
from calib.gap.effects.secants import FINER
from calib.gap.finding import EffectName, Parameters
from calib.gap.posterior.coefficients import ToParameters
from calib.gap.posterior.term import Term, Traits, like
from calib.gap.residuals.operating_point import OperatingPoint
from calib.gap.residuals.scene import Response
from calib.gap.residuals.term import SeriesTerm
from calib.gap.signals.terms import Form, Law, Values
from control.model.arm import Arm
from control.model.effects import EFFECTS

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
            yield term_on_joint(
                scene, record, j + 1, np.array([law, *departs]), departures=len(departs), variant=constant,
                parameters=_final(constant), variable="time",
            )  # fmt: skip


def _final(constant_s: float) -> ToParameters:
    def made(value: Array, covariance: Array) -> Parameters:
        final = float(value[0]), float(np.sqrt(covariance[0, 0]))
        return {"final_rad": final, "time_constant_s": (constant_s, float("nan"))}

    return made


def _in_series(around: OperatingPoint, record: EffectRecord, key: EffectName) -> Iterator[SeriesTerm]:
    own = around.found.get(key)
    times = WARMING_s if own is None else tuple(own.values[1] * k for k in FINER)
    base, at = around.without(key)
    for form in in_series(record).forms if own is None else (own.form,):
        laws = [Law(key, form, (0.0, time_s)) for time_s in times]
        size = size_of_law(around, record, form, key)
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
            yield from made(around, record, key, columns[k], size, law_of, [slope], time_s, now=now)


def _step(around: OperatingPoint, law: Law, base: tuple[Law, ...], at: Array, factor: float) -> Response:
    return around.scene.split(((around.scene.columns.residual((*base, law)) - at) * factor)[:, None])


def _warmed(values: Values, q: Array, t_s: Array) -> tuple[Array, Array, Array]:
    """By time; warm-up begins where the clock of the log does."""
    first, constant = values
    gone = np.exp(-t_s / constant)
    return first * (1.0 - gone), first / constant * gone, -first / constant**2 * gone


def _form(name: str, where: Literal["behind", "seen"]) -> Form:
    return Form(
        name, "angle", 3e-4, count=2, counted=1, steps=(1e-4, 5e-2), lower=(-np.inf, QUICKEST_s), upper=(np.inf, 1e5),
        angle=_warmed, where=where, is_by_time=True,
    )  # fmt: skip


def _known(series: InSeries, name: EffectName, given: Mapping[str, float]) -> Law | None:
    if name.joint is None:
        return None
    return Law(name, series.form, (given["final_rad"], given["time_constant_s"]))


def _parameters(arm: Arm, law: Law, covariance: Array) -> Parameters:
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    return dict(zip(EFFECTS[law.name.effect].required, zip(law.values, sd, strict=False), strict=True))


RECORDS = (
    EffectRecord(
        "thermal_drift", role="angle", traits=Traits(blocks="time"),
        poses=InPoses(
            0.003, _in_poses, "the same reference pose every few minutes, the others in shuffled order"
        ),
        series=InSeries(
            (_form("thermal_drift", "behind"), _form("thermal_drift seen", "seen")), _in_series, "tip", blocks=("tip time",),
            over="time", known=_known, parameters=_parameters,
        ),
    ),
)  # fmt: skip
