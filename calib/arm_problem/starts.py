"""Starting values for unknown tools and boards: closed forms at the nominal geometry.

A tip in the same socket in many postures determines the tool (pivot calibration): base_p_flange + base_R_flange t
is the same point for all of them, which is linear in the tool t and the socket.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.frames import Frame, cross_matrix
from calib.arm_problem.observations import Observations
from calib.arrays import Array, frozen
from calib.boards import best_motion

ROUNDS, SETTLED_m = 30, 1e-6  # of tool and frames together
WEAK = 1e-2  # share of the best determined direction of the tool below which the nominal value is kept


def started_tool(model: ArmModel, observed: Observations) -> Array:
    """The tool (3,) for which poses in one socket, or with a known reference, agree best; nominal if they do not
    determine it. Where every place in a frame of unknown pose was measured once, tool and frame are started together.
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
    unplaced = [group for group in groups if not known[group[0]]]
    if unplaced and all(len(group) == 1 for group in unplaced):
        step = _with_frames(slopes.tips, slopes.by_tool, observed)
    return np.asarray(model.nominal_tool_m + step)


def _with_frames(tips: Array, by_tool: Array, observed: Observations) -> Array:
    """The move of the tool (3,) for which tips (m, 3) fit their references, every unplaced frame where it then fits best.

    Gauss-Newton on the tool alone: what small motions of the frames do to the residuals is taken out of its columns.
    """
    step = np.zeros(3)
    for _ in range(ROUNDS):
        moved = tips + by_tool @ step
        left, columns = np.empty_like(tips), by_tool.copy()
        for k, frame in enumerate(observed.frames):
            rows = observed.rows_of(k)
            if not len(rows):
                continue
            place = frame if frame.is_placed else _placed(frame, observed.position_m[rows], moved[rows])
            references = place.to_base(observed.position_m[rows])
            left[rows] = references - moved[rows]
            if not frame.is_placed:
                arms = references - references.mean(axis=0)
                turns = np.array([-cross_matrix(arm) for arm in arms])
                motions = np.concatenate((np.broadcast_to(np.eye(3), turns.shape), turns), axis=2).reshape(
                    -1, 6
                )
                flat = columns[rows].reshape(-1, 3)
                columns[rows] = (flat - motions @ np.linalg.lstsq(motions, flat)[0]).reshape(-1, 3, 3)
        move, *_ = np.linalg.lstsq(columns.reshape(-1, 3), left.ravel(), rcond=WEAK)
        step = step + move
        if float(np.abs(move).max()) < SETTLED_m:
            break
    return step


def _placed(frame: Frame, positions_m: Array, tips_m: Array) -> Frame:
    """The frame where its positions fit these tips best."""
    motion = best_motion(positions_m, tips_m)
    return dataclasses.replace(
        frame, rotation=frozen(motion.rotation), origin_m=frozen(motion.shift_m), is_placed=True
    )


def with_started_frames(model: ArmModel, observed: Observations, tool_m: Array) -> Observations:
    """The observations with unknown frames placed where the nominal arm predicts them."""
    tips = model.tips(model.nominal_dh, observed.q_rad, tool_m)
    frames = list(observed.frames)
    for k, frame in enumerate(frames):
        rows = observed.rows_of(k)
        if not frame.is_placed and len(rows):
            frames[k] = _placed(frame, observed.position_m[rows], tips[rows])
    return dataclasses.replace(observed, frames=tuple(frames))


def _groups(keys: Sequence[Hashable]) -> list[list[int]]:
    """Rows with the same key."""
    found: dict[Hashable, list[int]] = {}
    for row, key in enumerate(keys):
        found.setdefault(key, []).append(row)
    return list(found.values())
