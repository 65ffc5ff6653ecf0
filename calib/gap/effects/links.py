"""Links of another geometry, links that bend under weight, and the frame that is called base and is not the arm's.

What the first link's d and theta do (and in the modified convention its L and alpha) is the same as a move of that frame along
and about the first axis: no pose can tell it, and it counts as geometry. The rest is rigid in the world, and no joint's doing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import BASE_FRAME, Choice, base_frame_of
from calib.arm_problem.link_bending import Bending, LinkFrames, beams, bending, cross, link_frames
from calib.arm_problem.observations import rotation_of, rotation_vector, seen_less_far_m
from calib.arrays import Array
from calib.gap.effects.record import EffectRecord, InPoses, InSeries, PoseScene, in_poses, stated_kg, straight
from calib.gap.finding import GEOMETRY, LINK_KEYS, EffectName, Parameters
from calib.gap.posterior.term import Term, ToParameters, parameters_of, sized
from calib.gap.signals.terms import Form, Law
from control.dynamics.feedforward import own_payload_kg, with_link_inertia
from control.model.arm import Arm


def _flexure(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """A cantilever; its own weight in its centre of mass, or spread along it."""
    arm, size = with_link_inertia(scene.arm), in_poses(record).size
    if not any(link.mass_kg for link in arm.links):
        return
    frames = link_frames(ArmModel(arm), arm.dh, scene.joint_rad)
    hung, nothing = stated_kg(scene.points) + own_payload_kg(arm), np.zeros(len(scene.points))
    for link in beams(arm):
        bare = _both(bending(arm, frames, nothing, link))
        payload = _both(bending(arm, frames, hung, link)) - bare
        alone = dataclasses.replace(
            arm,
            links=tuple(
                dataclasses.replace(body, mass_kg=body.mass_kg if k == link else 0.0) for k, body in enumerate(arm.links, start=1)
            ),
        )
        own_weight = _both(bending(alone, frames, nothing, link)) if alone.links[link - 1].mass_kg else 0.0 * bare
        for variant, weight in enumerate((own_weight, _both(_spread(arm, frames, link))) if own_weight.any() else (own_weight,)):
            parts = [weight, bare - own_weight, payload]
            total = np.asarray(sum(parts))
            if np.ptp(total, axis=0).max() == 0.0:
                continue
            departs = [part for part in parts if np.ptp(part, axis=0).max() > 0.0]
            columns = size * np.array([total, *departs])
            yield Term(
                EffectName(record.effect, link),
                "",
                1,
                len(departs),
                size,
                slope_m=columns[..., :3],
                turn_rad=columns[..., 3:],
                variant=float(variant),
                is_positive=True,
                parameters=parameters_of(record.effect),
                variable="load",
                traits=record.traits,
            )


def _both(bent: Bending) -> Array:
    """Displacements and turns side by side, (m, 6)."""
    return np.hstack(bent)


def _spread(arm: Arm, frames: LinkFrames, link: int) -> Bending:
    """What happens per 1 / EI when a link's own weight is spread evenly along it (q l^4 / 8, q l^3 / 6)."""
    before = 0 if arm.dh_convention == "modified" else 1
    following = next((k for k, body in enumerate(arm.links, start=1) if k > link and body.joint == "revolute"), None)
    begin = frames.origin_m[:, link - before]
    end = frames.tip_m if following is None else frames.origin_m[:, following - before]
    length = np.linalg.norm(end - begin, axis=1, keepdims=True)
    along = (end - begin) / length
    mass = sum(
        body.mass_kg or 0.0 for k, body in enumerate(arm.links, start=1) if k >= link and (following is None or k < following)
    )
    force = np.broadcast_to(mass * np.asarray(arm.gravity_m_s2), begin.shape)
    across = force - np.sum(force * along, axis=1, keepdims=True) * along
    turn = cross(along, across) * length**2 / 6.0
    return Bending(across * length**3 / 8.0 + cross(turn, frames.tip_m - end), turn)


def _links(arm: Arm) -> tuple[int, ...]:
    """The beams of an arm whose masses are known."""
    return beams(arm) if all(link.mass_kg for link in arm.links if link.joint == "revolute") else ()


FORM = Form("link_flexure", "beam", 1 / 3000.0, steps=(1e-4,), lower=(1e-6,), upper=(1.0,))


FRAME = "base_frame"
SHIFT_m, TURN_rad = 0.002, 0.005
ROUNDING = 1e-12  # m or rad, of turns that are taken apart again
_AXES_OF = {2: (1,), 4: (0, 1)}  # base axes that the geometry cannot take over, by the number of columns


def _frame(record: EffectRecord, scene: PoseScene) -> Iterator[Term]:
    """One term, unless no tip was measured in the base frame, or nothing ties that frame to the arm: then it is placed anyway."""
    arm, points = scene.nominal, scene.points
    if not np.isfinite(points.tip_m).all() or Choice().for_points(arm, points).freed:
        return
    place = base_frame_of(arm).to_base(points.tip_m)
    columns, turns, sizes = [], [], []
    for axis in _AXES_OF[2] if arm.dh_convention == "modified" else _AXES_OF[4]:
        unit = np.eye(3)[axis]
        columns += [np.broadcast_to(-SHIFT_m * unit, place.shape), -TURN_rad * np.cross(unit, place)]
        turns += [np.zeros(place.shape), np.broadcast_to(-TURN_rad * unit, place.shape)]
        sizes += [SHIFT_m, TURN_rad]
    yield Term(
        EffectName(record.effect),
        "",
        len(sizes),
        0,
        1.0,
        slope_m=np.stack(columns),
        turn_rad=np.stack(turns),
        parameters=sized(np.array(sizes), _of_axes(arm)),
        traits=record.traits,
    )


def _of_axes(arm: Arm) -> ToParameters:
    """The total, of coefficients of some axes."""
    return lambda value, covariance: _total(arm, _moved(value), _moved(np.sqrt(np.diag(covariance))))


def _total(arm: Arm, moved: Array, sd: Array) -> Parameters:
    """The frame of the arm's file, moved by (6,), with standard deviations (6,)."""
    known, rotation = base_frame_of(arm), rotation_of(moved[3:])
    total = (*(rotation @ known.origin_m + moved[:3]), *rotation_vector(rotation @ known.rotation))
    return {name: (float(v), float(s)) for name, v, s in zip(BASE_FRAME, total, sd, strict=True) if abs(v) > ROUNDING or s > 0.0}


def _moved(value: Array) -> Array:
    """Translation and rotation vector (6,) of coefficients (2,) or (4,) that alternate."""
    axes, moved = np.array(_AXES_OF[len(value)]), np.zeros(6)
    moved[axes], moved[3 + axes] = value[0::2], value[1::2]
    return moved


def _in_series(arm: Arm, law: Law, covariance: Array) -> Parameters:
    return _total(arm, np.array(law.values), np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def beyond_linear_m(term: Term, coefficients: Array, position_m: Array) -> Array:
    """What a frame of these coefficients does to the tips (m, 3) beyond the term's columns.

    Half the square of a turn of 20 mrad is 0.1 mm at arm's length: as much as the noise.
    """
    moved = _moved(coefficients * np.tile((SHIFT_m, TURN_rad), len(coefficients) // 2))
    linear = 0.0 if term.slope_m is None else np.einsum("c,cmi->mi", coefficients, term.slope_m)
    return np.asarray(seen_less_far_m(position_m, moved) - linear)


def _geometry(arm: Arm, law: Law, covariance: Array) -> Parameters:
    """Of four deviations a link, those that are not nothing."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    named = {f"link{k // 4 + 1}_{LINK_KEYS[k % 4]}": (v, sd[k]) for k, v in enumerate(law.values)}
    return {name: value for name, value in named.items() if value[0] != 0.0}


RECORDS = (
    EffectRecord(
        "link_flexure",
        role="angle",
        poses=InPoses(1.0 / 400.0, _flexure, "markers at both ends of that link, with and without a known payload"),
        series=InSeries((FORM,), straight, "tip", places=_links, least=lambda arm, law: 0.0),
    ),
    EffectRecord(
        FRAME,
        poses=InPoses(1.0, _frame, "markers on the arm's base, or the board seated anew", is_total=False),
        series=InSeries((Form(FRAME, "frame", 3e-4, count=6),), straight, "tip", parameters=_in_series),
    ),
    EffectRecord(GEOMETRY, series=InSeries((Form(GEOMETRY, "geometry", 3e-4, count=0),), straight, "tip", parameters=_geometry)),
)
