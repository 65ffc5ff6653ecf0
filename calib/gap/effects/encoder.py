"""Errors of the encoders and of the belt, with the angle."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from calib.arrays import Array
from calib.gap.effects.columns import straight
from calib.gap.effects.departures import by_angle
from calib.gap.effects.pose_columns import harmonics, term_on_joint
from calib.gap.effects.pose_scene import PoseScene
from calib.gap.effects.record import EffectRecord, InPoses, InSeries
from calib.gap.posterior.term import Term, Traits, like
from calib.gap.signals.terms import AngleLaw, Form, Values
from control.model.arm import Arm
from control.model.effects import COUPLED, COUPLED_TO


def _scale(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    q = scene.points.q_rad
    for j in range(scene.points.joint_count):
        departs = like(q[:, j], harmonics(q[:, j], 1, 2))
        columns = np.array([q[:, j], *departs])
        yield term_on_joint(scene, record, j + 1, columns, departures=len(departs), variable=f"q{j + 1}")


def _eccentricity(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    q = scene.points.q_rad
    for j in range(scene.points.joint_count):
        columns = np.array(harmonics(q[:, j], 1, 2, 3))
        yield term_on_joint(scene, record, j + 1, columns, laws=2, departures=4, variable=f"q{j + 1}")


def _coupling(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    if scene.points.joint_count >= COUPLED:
        angle = scene.points.q_rad[:, COUPLED_TO - 1]
        departs = like(angle, harmonics(angle, 1, 2))
        columns = np.array([angle, *departs])
        yield term_on_joint(scene, record, None, columns, departures=len(departs), variable=f"q{COUPLED_TO}")


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
    return (None,) if arm.joint_count >= COUPLED else ()


RECORDS = (
    EffectRecord(
        "encoder_scale", role="angle", traits=Traits(blocks="q{j}"),
        poses=InPoses(0.005, _scale, "poses over the whole travel of that joint"),
        series=InSeries(
            forms_of("encoder_scale", 5e-4, _in_proportion), straight, "tip", departs=(by_angle,), variable="angle",
            blocks=("tip angle", "tip ripple"), over="angle",
        ),
    ),
    EffectRecord(
        "encoder_eccentricity", role="angle", traits=Traits(blocks="q{j}"),
        poses=InPoses(0.003, _eccentricity, "poses over more than 120 degrees of that joint"),
        series=InSeries(
            forms_of("encoder_eccentricity", 3e-4, _once_a_turn, 2), straight, "tip", departs=(by_angle,), variable="angle",
            blocks=("tip angle", "tip ripple"), over="angle",
        ),
    ),
    EffectRecord(
        "belt_coupling", role="angle", traits=Traits(blocks="other angles"),
        poses=InPoses(
            0.01, _coupling, f"poses in which joint {COUPLED_TO} moves while joint {COUPLED} stands"
        ),
        series=InSeries(
            forms_of("belt_coupling", 5e-4, _in_proportion), straight, "tip", departs=(by_angle,),
            variable=f"angle of joint {COUPLED_TO}", blocks=(f"tip angle of joint {COUPLED_TO}",), over="angle", places=_belts,
        ),
    ),
)  # fmt: skip
