"""The frame that the camera and the table call base, where it is not the arm's: base_frame as a candidate.

What the first link's d and theta do (and in the modified convention its L and alpha) is the same as a move of that frame along
and about the first axis: no pose can tell it, and it counts as geometry. The rest is rigid in the world, and no joint's doing.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calib.arm_problem.assembly import BASE_FRAME
from calib.arm_problem.frames import rotation_of
from calib.arrays import Array, frozen
from calib.gap.finding import EffectName
from calib.gap.poses.candidate import Candidate, Parameters
from calib.points.points import Points
from control.model.arm import Arm

FRAME = "base_frame"
SHIFT_m, TURN_rad = 0.002, 0.005
_AXES_OF = {2: (1,), 4: (0, 1)}  # base axes that the geometry cannot take over, by the number of columns


def of_the_frame(arm: Arm, points: Points) -> Iterator[Candidate]:
    """One candidate, unless no tip was measured in the base frame and the board's own place is unknown anyway."""
    if arm.table is not None and not arm.table.known_pose and not np.isfinite(points.tip_m).any():
        return
    if any(one.effect == FRAME for one in arm.effects) or not np.isfinite(points.tip_m).all():
        return
    axes = _axes(arm)
    columns, names, sizes = [], [], []
    for axis in axes:
        columns += [np.broadcast_to(-np.eye(3)[axis], points.tip_m.shape)]
        columns += [-np.cross(np.eye(3)[axis], points.tip_m)]
        names += [BASE_FRAME[axis], BASE_FRAME[3 + axis]]
        sizes += [SHIFT_m, TURN_rad]
    still = np.zeros((len(columns), *points.q_rad.shape))

    def parameters(value: Array, covariance: Array) -> Parameters:
        sd = np.sqrt(np.diag(covariance))
        return {name: (float(v), float(s)) for name, v, s in zip(names, value, sd, strict=True)}

    yield Candidate(
        EffectName(FRAME), frozen(still), frozen(sizes), parameters, slope_m=frozen(np.stack(columns))
    )


def _axes(arm: Arm) -> tuple[int, ...]:
    return _AXES_OF[2] if arm.dh_convention == "modified" else _AXES_OF[4]


def beyond_linear_m(one: Candidate, value: Array, position_m: Array) -> Array:
    """What the frame's move and turn `value` (c,) do to the tip, (m, 3), beyond the candidate's columns times it."""
    move, turn = np.zeros(3), np.zeros(3)
    axes = list(_AXES_OF[len(one.size)])
    move[axes], turn[axes] = value[0::2], value[1::2]
    moved = position_m - (position_m @ rotation_of(turn).T + move)
    linear = np.zeros_like(position_m) if one.slope_m is None else np.einsum("c,cmi->mi", value, one.slope_m)
    return np.asarray(moved - linear)
