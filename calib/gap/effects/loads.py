"""What the motors carry and give: payload, masses and torque constants. Of poses only holding currents tell them.

A held joint's motor carries gravity and some of the joint's friction, anywhere in its band. Friction is therefore no name here:
its size would be that of the band, not of the effect. Gravity is even in the direction of the last motion, friction odd: with
both directions the former can be told.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import LinkFrames, link_frames
from calib.arrays import Array
from calib.gap.effects.record import (
    EffectRecord,
    InPoses,
    InSeries,
    NO_TORQUE_Nm,
    PoseScene,
    by_angle,
    by_current,
    in_poses,
    straight,
)
from calib.gap.finding import EffectName
from calib.gap.posterior.constants import MISSING_MOST
from calib.gap.posterior.term import Term, ToParameters, inverse, like, on_joint
from calib.gap.signals.terms import Form, Law
from control.model.arm import Arm


def _constants(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """A motor that gives more or less torque per ampere: current * nominal constant = (gravity + friction) / scale.

    It departs from that law as it saturates.
    """
    gravity, size = scene.gravity_Nm, in_poses(record).size
    if gravity is None or not _has_currents(scene):
        return
    for j, load_Nm in enumerate(gravity.T):
        if np.ptp(load_Nm) > NO_TORQUE_Nm:
            departures = like(load_Nm, [load_Nm * np.abs(load_Nm)])
            columns = on_joint(size * np.array([load_Nm, *departures]), j, gravity.shape[1])
            yield Term(
                EffectName(record.effect, j + 1),
                "",
                1,
                len(departures),
                size,
                slope_Nm=columns,
                parameters=inverse("scale", beyond=1.0),
                variable="load",
                traits=record.traits,
            )


def _payload(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """A mass at the tip that nobody stated."""
    if scene.gravity_Nm is not None and _has_currents(scene):
        arm = scene.nominal
        frames = link_frames(ArmModel(arm), arm.dh, scene.joint_rad)
        yield _mass(record, None, _torque_Nm(arm, frames, frames.tip_m, len(arm.links)))


def _masses(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """Links that are heavier than nominal."""
    if scene.gravity_Nm is None or not _has_currents(scene):
        return
    arm = scene.nominal
    frames = link_frames(ArmModel(arm), arm.dh, scene.joint_rad)
    for k, link in enumerate(arm.links, start=1):
        if link.mass_kg and link.com_m is not None:
            torque = _torque_Nm(arm, frames, frames.point_m(k, np.asarray(link.com_m)), k)
            if np.ptp(torque, axis=0).max() > NO_TORQUE_Nm:
                yield _mass(record, k, torque)


def _has_currents(scene: PoseScene) -> bool:
    return bool(np.isfinite(scene.points.current_A).any())


def _torque_Nm(arm: Arm, frames: LinkFrames, place_m: Array, link: int) -> Array:
    """What a kilogram at a place (m, 3) of a link (1-based) asks of every joint, (m, n)."""
    torque = np.zeros((len(place_m), arm.joint_count))
    turning = [k for k, link in enumerate(arm.links, start=1) if link.joint == "revolute"]
    before = 0 if arm.dh_convention == "modified" else 1
    for j, k in enumerate(turning):
        if k <= link:
            axis, origin = frames.axes[:, k - before, :, 2], frames.origin_m[:, k - before]
            moment = np.cross(place_m - origin, np.asarray(arm.gravity_m_s2))
            torque[:, j] = -np.sum(axis * moment, axis=1)
    return torque


def _mass(record: EffectRecord, link: int | None, torque_Nm: Array) -> Term:
    """torque_Nm (m, n) per kilogram."""
    size = in_poses(record).size
    return Term(
        EffectName(record.effect, link),
        "",
        1,
        0,
        size,
        slope_Nm=size * torque_Nm[None],
        parameters=_number("mass_kg"),
        variable="load",
        traits=record.traits,
    )


def _number(key: str) -> ToParameters:
    """A coefficient as it is."""
    return lambda value, covariance: {key: (float(value[0]), float(np.sqrt(max(covariance[0, 0], 0.0))))}


def _least(arm: Arm, law: Law) -> float:
    """Of a link, no more than a part can be missing."""
    link = arm.links[law.index]
    if law.form is MASS:
        return -MISSING_MOST * link.mass_kg if link.mass_kg else -math.inf
    return -math.inf if link.inertia_kg_m2 is None else -MISSING_MOST * max(link.inertia_kg_m2)


MASS, INERTIA = Form("mass_kg", "mass", 0.03), Form("inertia_kg_m2", "inertia", 0.003)
CONSTANT = Form("torque_constant", "torque constant", 0.01, lower=(-0.8,), upper=(4.0,))
BOTH_DIRECTIONS = "holding currents from both directions, with two known masses"

RECORDS = (
    EffectRecord(
        "payload",
        poses=InPoses(0.2, _payload, BOTH_DIRECTIONS, is_load=True),
        series=InSeries((Form("payload", "payload", 0.01),), straight, "motor", least=lambda arm, law: 0.0),
    ),
    EffectRecord(
        "link_inertia",
        poses=InPoses(0.2, _masses, BOTH_DIRECTIONS, is_load=True),
        series=InSeries(
            (MASS, INERTIA),
            straight,
            "motor",
            least=_least,
            places=lambda arm: [k for k, link in enumerate(arm.links, 1) if link.mass_kg is not None and link.com_m is not None],
            known=lambda series, name, given: next(
                Law(name, form, (given[form.name],)) for form in series.forms if form.name in given
            ),
            parameters=lambda arm, law, covariance: _number(law.form.name)(np.array(law.values), covariance),
        ),
    ),
    EffectRecord(
        "torque_constant",
        role="torque",
        needs_drives=True,
        poses=InPoses(0.1, _constants, BOTH_DIRECTIONS, is_load=True),
        series=InSeries(
            (CONSTANT,), straight, "motor", departs=(by_current, by_angle), variable="current", blocks=("sensor",), over="current"
        ),
    ),
)
