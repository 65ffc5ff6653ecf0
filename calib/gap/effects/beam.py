"""Links that bend under their own weight, the weight beyond them, and the payload."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.link_bending import Bending, beams, bending, link_frames
from calib.arrays import Array
from calib.gap.effects.columns import straight
from calib.gap.effects.pose_columns import in_poses
from calib.gap.effects.pose_scene import PoseScene, stated_kg
from calib.gap.effects.record import EffectRecord, InPoses, InSeries
from calib.gap.finding import EffectName
from calib.gap.posterior.coefficients import parameters_of
from calib.gap.posterior.term import Term
from calib.gap.signals.terms import Form
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.model.arm import Arm


def _flexure(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """A cantilever; its own weight in its centre of mass, or spread along it."""
    arm, size = with_link_inertia(scene.arm), in_poses(record).size
    if not any(link.mass_kg for link in arm.links):
        return
    q, hung = scene.joint_rad, stated_kg(scene.points) + own_payload_kg(arm)
    for link in beams(arm):
        bare = _both(bending(arm, arm.dh, q, np.zeros(len(q)), link))
        payload = _both(bending(arm, arm.dh, q, hung, link)) - bare
        alone = dataclasses.replace(
            arm, links=tuple(dataclasses.replace(one, mass_kg=one.mass_kg if k == link else 0.0)
                             for k, one in enumerate(arm.links, start=1)),
        )  # fmt: skip
        own = (
            _both(bending(alone, arm.dh, q, np.zeros(len(q)), link))
            if alone.links[link - 1].mass_kg
            else 0.0 * bare
        )
        for variant, weight in enumerate((own, _both(_spread(arm, q, link))) if own.any() else (own,)):
            parts = [weight, bare - own, payload]
            total = np.asarray(sum(parts))
            if np.ptp(total, axis=0).max() == 0.0:
                continue
            departs = [part for part in parts if np.ptp(part, axis=0).max() > 0.0]
            columns = size * np.array([total, *departs])
            yield Term(
                EffectName(record.effect, link), "", 1, len(departs), size, slope_m=columns[..., :3], turn_rad=columns[..., 3:],
                variant=float(variant), is_positive=True, parameters=parameters_of(record.effect), variable="load",
                traits=record.traits,
            )  # fmt: skip


def _both(bent: Bending) -> Array:
    """Displacements and turns side by side, (m, 6)."""
    return np.hstack(bent)


def _spread(arm: Arm, q_rad: Array, link: int) -> Bending:
    """What happens per 1 / EI when a link's own weight is spread evenly along it (q l^4 / 8, q l^3 / 6)."""
    frames = link_frames(ArmModel(arm), arm.dh, q_rad)
    before = 0 if arm.dh_convention == "modified" else 1
    following = next(
        (k for k, one in enumerate(arm.links, start=1) if k > link and one.joint == "revolute"), None
    )
    begin = frames.origin_m[:, link - before]
    end = frames.tip_m if following is None else frames.origin_m[:, following - before]
    length = np.linalg.norm(end - begin, axis=1, keepdims=True)
    along = (end - begin) / length
    mass = sum(
        one.mass_kg or 0.0
        for k, one in enumerate(arm.links, start=1)
        if k >= link and (following is None or k < following)
    )
    force = np.broadcast_to(mass * np.asarray(arm.gravity_m_s2), begin.shape)
    across = force - np.sum(force * along, axis=1, keepdims=True) * along
    turn = np.cross(along, across) * length**2 / 6.0
    return Bending(across * length**3 / 8.0 + np.cross(turn, frames.tip_m - end), turn)


def _links(arm: Arm) -> tuple[int, ...]:
    """The beams of an arm whose masses are known."""
    return beams(arm) if all(link.mass_kg for link in arm.links if link.joint == "revolute") else ()


FORM = Form("link_flexure", "beam", 1 / 3000.0, steps=(1e-4,), lower=(1e-6,), upper=(1.0,))
RECORDS = (
    EffectRecord(
        "link_flexure", role="angle",
        poses=InPoses(
            1.0 / 400.0, _flexure, "markers at both ends of that link, with and without a known payload"
        ),
        series=InSeries((FORM,), straight, "tip", places=_links, least=lambda arm, law: 0.0),
    ),
)  # fmt: skip
