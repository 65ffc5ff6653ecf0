"""What only the motors' holding currents tell: payload, masses and torque constants.

A held joint's motor carries gravity and some of the joint's friction, anywhere in its band. Friction is therefore no name here:
its size would be that of the band, not of the effect. Gravity is even in the direction of the last motion, friction odd: with
both directions the former can be told.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_frames import LinkFrames, link_frames
from calib.arrays import Array
from calib.gap.finding import EffectName
from calib.gap.poses.effects.record import EffectRecord, NO_TORQUE_Nm
from calib.gap.poses.effects.scene import Scene
from calib.gap.posterior.coefficients import inverse, only
from calib.gap.posterior.term import Term, like, on_joint
from control.model.arm import Arm


def _constants(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    """A motor that gives more or less torque per ampere: current * nominal constant = (gravity + friction) / scale.

    It departs from that law as it saturates.
    """
    gravity = scene.gravity_Nm
    if gravity is None or not _has_currents(scene):
        return
    for j, own in enumerate(gravity.T):
        if np.ptp(own) > NO_TORQUE_Nm:
            departures = like(own, [own * np.abs(own)])
            columns = on_joint(record.size * np.array([own, *departures]), j, gravity.shape[1])
            yield Term(
                EffectName(record.effect, j + 1), "", 1, len(departures), record.size, slope_Nm=columns,
                parameters=inverse("scale", beyond=1.0), variable="load",
            )  # fmt: skip


def _payload(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    """A mass at the tip that nobody stated."""
    if scene.gravity_Nm is not None and _has_currents(scene):
        arm = scene.nominal
        frames = link_frames(ArmModel(arm), arm.dh, scene.points.q_rad)
        yield _mass(record, None, _torque_Nm(arm, frames, frames.tip_m, len(arm.links)))


def _masses(record: EffectRecord, scene: Scene) -> Iterator[Term]:
    """Links that are heavier than nominal."""
    if scene.gravity_Nm is None or not _has_currents(scene):
        return
    arm = scene.nominal
    frames = link_frames(ArmModel(arm), arm.dh, scene.points.q_rad)
    for k, link in enumerate(arm.links, start=1):
        if link.mass_kg and link.com_m is not None:
            torque = _torque_Nm(arm, frames, frames.point_m(k, np.asarray(link.com_m)), k)
            if np.ptp(torque, axis=0).max() > NO_TORQUE_Nm:
                yield _mass(record, k, torque)


def _has_currents(scene: Scene) -> bool:
    return bool(np.isfinite(scene.points.current_A).any())


def _torque_Nm(arm: Arm, frames: LinkFrames, place_m: Array, link: int) -> Array:
    """What a kilogram at a place (m, 3) of a link (1-based) asks of every joint, (m, n)."""
    torque = np.zeros((len(place_m), arm.joint_count))
    turning = [k for k, one in enumerate(arm.links, start=1) if one.joint == "revolute"]
    before = 0 if arm.dh_convention == "modified" else 1
    for j, k in enumerate(turning):
        if k <= link:
            axis, origin = frames.axes[:, k - before, :, 2], frames.origin_m[:, k - before]
            moment = np.cross(place_m - origin, np.asarray(arm.gravity_m_s2))
            torque[:, j] = -np.sum(axis * moment, axis=1)
    return torque


def _mass(record: EffectRecord, link: int | None, torque_Nm: Array) -> Term:
    """torque_Nm (m, n) per kilogram."""
    columns = record.size * torque_Nm[None]
    name, made = EffectName(record.effect, link), only(record.parameter)
    return Term(name, "", 1, 0, record.size, slope_Nm=columns, parameters=made, variable="load")


RECORDS = (
    EffectRecord("payload", 0.2, _payload, "mass_kg"),
    EffectRecord("link_inertia", 0.2, _masses, "mass_kg"),
    EffectRecord("torque_constant", 0.1, _constants, "scale"),
)
LOADS = tuple(record.effect for record in RECORDS)
