"""The frame that the camera and the table call base, where it is not the arm's, and links of another geometry.

What the first link's d and theta do (and in the modified convention its L and alpha) is the same as a move of that frame along
and about the first axis: no pose can tell it, and it counts as geometry. The rest is rigid in the world, and no joint's doing.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arm_problem.assembly import BASE_FRAME, Choice, base_frame_of
from calib.arm_problem.frames import rotation_of, rotation_vector, seen_less_far_m
from calib.arrays import Array
from calib.gap.effects.columns import straight
from calib.gap.effects.pose_scene import PoseScene
from calib.gap.effects.record import EffectRecord, InPoses, InSeries
from calib.gap.finding import GEOMETRY, LINK_KEYS, EffectName, Parameters
from calib.gap.posterior.coefficients import ToParameters, sized
from calib.gap.posterior.term import Term
from calib.gap.signals.terms import Form, Law
from control.model.arm import Arm

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
        EffectName(record.effect), "", len(sizes), 0, 1.0, slope_m=np.stack(columns), turn_rad=np.stack(turns),
        parameters=sized(np.array(sizes), _of_axes(arm)), traits=record.traits,
    )  # fmt: skip


def _of_axes(arm: Arm) -> ToParameters:
    """The total, of coefficients of some axes."""
    return lambda value, covariance: _total(arm, _moved(value), _moved(np.sqrt(np.diag(covariance))))


def _total(arm: Arm, moved: Array, sd: Array) -> Parameters:
    """The frame of the arm's file, moved by (6,), with standard deviations (6,)."""
    known, rotation = base_frame_of(arm), rotation_of(moved[3:])
    total = (*(rotation @ known.origin_m + moved[:3]), *rotation_vector(rotation @ known.rotation))
    return {
        name: (float(v), float(s))
        for name, v, s in zip(BASE_FRAME, total, sd, strict=True)
        if abs(v) > ROUNDING or s > 0.0
    }


def _moved(value: Array) -> Array:
    """Translation and rotation vector (6,) of coefficients (2,) or (4,) that alternate."""
    axes, found = np.array(_AXES_OF[len(value)]), np.zeros(6)
    found[axes], found[3 + axes] = value[0::2], value[1::2]
    return found


def _in_series(arm: Arm, law: Law, covariance: Array) -> Parameters:
    return _total(arm, np.array(law.values), np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def beyond_linear_m(one: Term, coefficients: Array, position_m: Array) -> Array:
    """What a frame of these coefficients does to the tips (m, 3) beyond the term's columns.

    Half the square of a turn of 20 mrad is 0.1 mm at arm's length: as much as the noise.
    """
    moved = _moved(coefficients * np.tile((SHIFT_m, TURN_rad), len(coefficients) // 2))
    linear = 0.0 if one.slope_m is None else np.einsum("c,cmi->mi", coefficients, one.slope_m)
    return np.asarray(seen_less_far_m(position_m, moved) - linear)


def _geometry(arm: Arm, law: Law, covariance: Array) -> Parameters:
    """Of four deviations a link, those that are not nothing."""
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    named = {f"link{k // 4 + 1}_{LINK_KEYS[k % 4]}": (v, sd[k]) for k, v in enumerate(law.values)}
    return {name: value for name, value in named.items() if value[0] != 0.0}


RECORDS = (
    EffectRecord(
        FRAME,
        poses=InPoses(1.0, _frame, "markers on the arm's base, or the board seated anew", is_total=False),
        series=InSeries((Form(FRAME, "frame", 3e-4, count=6),), straight, "tip", parameters=_in_series),
    ),
    EffectRecord(
        GEOMETRY,
        series=InSeries(
            (Form(GEOMETRY, "geometry", 3e-4, count=0),), straight, "tip", parameters=_geometry
        ),
    ),
)  # fmt: skip
