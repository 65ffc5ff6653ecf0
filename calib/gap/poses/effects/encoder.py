"""Errors of the encoders and of the belt, with the angle or with time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arrays import Array
from calib.gap.finding import Parameters
from calib.gap.poses.effects.record import EffectRecord, harmonics
from calib.gap.poses.effects.scene import Scene
from calib.gap.posterior.coefficients import ToParameters, amplitude_and_phase
from calib.gap.posterior.term import Term, like, on_joint

TIME_CONSTANTS_s = np.geomspace(30.0, 30_000.0, 19)
DRIFT_TIMES_SPAN = 1.5  # of a session: a longer time constant bends its course too little to be one
OTHER_TIMES = 3.0  # between the time constants of a part that warms in two stages


def _scale(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    q, n = scene.points.q_rad, scene.points.joint_count
    for j in range(n):
        departs = like(q[:, j], harmonics(q[:, j], 1, 2))
        yield record.term(
            j + 1, 1, on_joint(np.array([q[:, j], *departs]), j, n), len(departs), variable=f"q{j + 1}"
        )


def _eccentricity(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    q, n = scene.points.q_rad, scene.points.joint_count
    for j in range(n):
        columns = np.array(harmonics(q[:, j], 1, 2, 3))
        yield record.term(
            j + 1, 2, on_joint(columns, j, n), 4, parameters=amplitude_and_phase, variable=f"q{j + 1}"
        )  # fmt: skip


def _coupling(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    q, n = scene.points.q_rad, scene.points.joint_count
    if n >= 3:
        departs = like(q[:, 1], harmonics(q[:, 1], 1, 2))
        yield record.term(None, 1, on_joint(np.array([q[:, 1], *departs]), 2, n), len(departs), variable="q2")


def _drift(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    time = scene.points.t_s
    if not np.isfinite(time).all() or np.ptp(time) == 0.0:
        return
    elapsed, n = time - time.min(), scene.points.joint_count
    for j in range(n):
        for constant in TIME_CONSTANTS_s[TIME_CONSTANTS_s <= DRIFT_TIMES_SPAN * elapsed.max()].tolist():
            law = 1.0 - np.exp(-elapsed / constant)
            others = [1.0 - np.exp(-elapsed / (constant * f)) for f in (OTHER_TIMES, 1.0 / OTHER_TIMES)]
            departs = like(law, [other - law * (other @ law) / (law @ law) for other in others])
            yield record.term(
                j + 1, 1, on_joint(np.array([law, *departs]), j, n), len(departs), variant=constant,
                parameters=_final(constant), variable="time",
            )  # fmt: skip


def _final(constant_s: float) -> ToParameters:
    def made(value: Array, covariance: Array) -> Parameters:
        final = float(value[0]), float(np.sqrt(covariance[0, 0]))
        return {"final_rad": final, "time_constant_s": (constant_s, float("nan"))}

    return made


RECORDS = (
    EffectRecord("encoder_scale", 0.005, _scale, "scale"),
    EffectRecord("encoder_eccentricity", 0.003, _eccentricity),
    EffectRecord("belt_coupling", 0.01, _coupling, "ratio"),
    EffectRecord("thermal_drift", 0.003, _drift),
)
