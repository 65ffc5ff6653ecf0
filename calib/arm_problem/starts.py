"""Starting values for unknown tools and boards: closed forms at the nominal geometry.

A tip in the same socket in many postures determines the tool (pivot calibration): base_p_flange + base_R_flange t
is the same point for all of them, which is linear in the tool t and the socket.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Observations
from calib.arrays import Array, frozen
from calib.boards.rigid import best_motion

WEAK = 1e-2  # share of the best determined direction of the tool below which the nominal value is kept


def started_tool(model: ArmModel, observed: Observations) -> Array:
    """The tool (3,) for which poses in one socket, or with a known reference, agree best; nominal if they do not
    determine it.
    """
    slopes = model.slopes(model.nominal_dh, observed.q_rad)
    groups = _groups([*zip(observed.frame.tolist(), map(tuple, observed.position_m.tolist()), strict=True)])
    known = np.array([frame.is_placed for frame in observed.frames])[observed.frame]
    rows, wanted = [], []
    for group in groups:
        turns, tips = slopes.by_tool[group], slopes.tips[group]
        if known[group[0]]:
            references = observed.frames[observed.frame[group[0]]].to_base(observed.position_m[group])
            rows.append(turns)
            wanted.append(references - tips)
        else:
            rows.append(turns - turns.mean(axis=0))
            wanted.append(tips.mean(axis=0) - tips)
    step, *_ = np.linalg.lstsq(
        np.concatenate(rows).reshape(-1, 3), np.concatenate(wanted).ravel(), rcond=WEAK
    )
    return np.asarray(model.nominal_tool_m + step)


def with_started_frames(model: ArmModel, observed: Observations, tool_m: Array) -> Observations:
    """The observations with unknown frames placed where the nominal arm predicts them."""
    tips = model.tips(model.nominal_dh, observed.q_rad, tool_m)
    frames = list(observed.frames)
    for k, frame in enumerate(frames):
        rows = observed.rows_of(k)
        if not frame.is_placed and len(rows):
            motion = best_motion(observed.position_m[rows], tips[rows])
            frames[k] = dataclasses.replace(
                frame, rotation=frozen(motion.rotation), origin_m=frozen(motion.shift_m), is_placed=True
            )
    return dataclasses.replace(observed, frames=tuple(frames))


def _groups(keys: Sequence[Hashable]) -> list[list[int]]:
    """Rows with the same key."""
    found: dict[Hashable, list[int]] = {}
    for row, key in enumerate(keys):
        found.setdefault(key, []).append(row)
    return list(found.values())
