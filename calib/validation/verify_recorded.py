"""Compares two models of an arm on recorded poses: predictions from the encoders against measured tips.

The tip is measured by the camera, or given by the table if its pose is known. A board of unknown pose, with the tip seated in its
cavities repeatedly, still distinguishes models: for each model the board is placed where its predictions fit best, and the
residual is its inconsistency. Static effects of a model (backlash, scale, ...) are included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.arm_problem.assembly import BASE, CAMERA, Choice, base_frame_of
from calib.arm_problem.checks import require_of_arm
from calib.arm_problem.frames import Frame
from calib.arm_problem.joint_effects import known_corrections
from calib.arm_problem.link_bending import known_bending
from calib.arrays import Array, frozen
from calib.boards.rigid import best_motion
from calib.errors import CalibrationError
from calib.points.points import Points
from calib.validation.verify import Comparison, compare_repeated
from control.kinematics.kinematics import Kinematics
from control.model import table as tables
from control.model.arm import Arm

SAME_POSE_rad = 0.02  # rows of one name that differ more are different poses, not repeats
LEAST_POSES = 5  # of a setup whose board is fitted: with fewer poses any board fits


def compare_arms(nominal: Arm, calibrated: Arm, points: Points) -> Comparison:
    """Errors by two models; rows of the same name and pose are repeats, other poses of the same name separate points.

    Rows are omitted if their tip is neither measured nor in a cavity of a board with enough poses; CalibrationError
    if none is left, UnusablePointsError for points in other units or of another arm. Copies count once.
    """
    cautions = (*require_of_arm(calibrated, points), *_about_frames((nominal, calibrated), points))
    points = points.chosen(_first_of_copies(points))
    errors = [errors_of(arm, points) for arm in (nominal, calibrated)]
    rows = np.flatnonzero(np.isfinite(errors[0]).all(axis=1) & np.isfinite(errors[1]).all(axis=1))
    if not len(rows):
        raise CalibrationError(
            f"no measured tips: expected x_m, y_m, z_m, or a setup with {LEAST_POSES} poses in named cavities of the arm's"
            " [table]"
        )
    used = points.chosen(rows)
    tips = np.where(np.isfinite(used.tip_m), used.tip_m, predicted_tips(calibrated, used))
    found = compare_repeated(used.setup, _names(used), tips, errors[0][rows], errors[1][rows])
    return replace(found, cautions=cautions)


def _about_frames(arms: Sequence[Arm], points: Points) -> tuple[str, ...]:
    """Which models' frames were placed where they fit best, as a calibration does."""
    placed = list(dict.fromkeys(str(arm.path or arm.name) for arm in arms if _is_unplaced(arm, points)))
    if not placed or not np.isfinite(points.tip_m).any():
        return ()
    return (
        f"nothing in {' and '.join(placed)} says where the frame of the measured tips stands: it was put where the model fits"
        " them best, as `calibrate` does",
    )


def _is_unplaced(arm: Arm, points: Points) -> bool:
    """Whether a calibration of this arm would identify the frame of the tips; too few tips for that are taken for the base's."""
    if np.isfinite(points.tip_m).all(axis=1).sum() < LEAST_POSES and not points.in_camera_frame:
        return False
    return not {BASE, CAMERA}.isdisjoint(Choice().for_points(arm, points).freed)


def _first_of_copies(points: Points) -> list[int]:
    """Rows without those whose angles and tips an earlier row has to the last digit: copies tell nothing of scatter."""
    first: dict[bytes, int] = {}
    for row in range(len(points)):
        name = f"{points.setup[row]}:{points.point[row]}" if np.isnan(points.tip_m[row]).any() else ""
        first.setdefault(name.encode() + points.q_rad[row].tobytes() + points.tip_m[row].tobytes(), row)
    return list(first.values())


def predicted_tips(arm: Arm, points: Points) -> Array:
    """Tips (m, 3) in the base frame from the encoders, with the static effects of the arm's model."""
    tips = Kinematics(arm).tips(points.q_rad + known_corrections(arm, points))
    bent = known_bending(arm, points.q_rad, points.payload_kg)
    return tips if bent is None else np.asarray(tips + bent.shift)


def errors_of(arm: Arm, points: Points) -> Array:
    """Measured minus predicted tips, (m, 3) in the model's base frame; NaN without a reference."""
    tips = predicted_tips(arm, points)
    was = measuring_frame(arm, points).to_base(points.tip_m)
    for setup in dict.fromkeys(points.setup):
        rows = [k for k, name in enumerate(points.setup) if name == setup and np.isnan(was[k]).any()]
        if rows:
            was[rows] = _on_fitted_board(arm, [points.point[k] for k in rows], tips[rows])
    return np.asarray(was - tips)


def measuring_frame(arm: Arm, points: Points) -> Frame:
    """The frame of the measured tips in the arm's base frame; one of unknown place is put where this model fits best."""
    if not _is_unplaced(arm, points):
        return base_frame_of(arm)
    rows = np.isfinite(points.tip_m).all(axis=1)
    if rows.sum() < LEAST_POSES:
        raise CalibrationError(
            f"{int(rows.sum())} tips in a frame of unknown place, {LEAST_POSES} are needed to place it"
        )
    motion = best_motion(points.tip_m[rows], predicted_tips(arm, points)[rows])
    return Frame(CAMERA if points.in_camera_frame else BASE, frozen(motion.rotation), frozen(motion.shift_m))


def _on_fitted_board(arm: Arm, names: list[str], tips: Array) -> Array:
    """Cavities (m, 3) of a board fitted to these tips; NaN if there are too few, or no such cavity."""
    cavities = tables.board_cavities(arm.table) if arm.table is not None else {}
    known = [k for k, name in enumerate(names) if name in cavities]
    was = np.full(tips.shape, np.nan)
    if len(known) >= LEAST_POSES:
        on_board = np.array([cavities[names[k]] for k in known])
        was[known] = best_motion(on_board, tips[known]).of(on_board)
    return was


def _names(points: Points) -> list[str]:
    """The points' names, with a number if poses of one name differ."""
    poses: dict[tuple[str, str], list[Array]] = {}
    numbers = []
    for k, name in enumerate(zip(points.setup, points.point, strict=True)):
        known = poses.setdefault(name, [])
        near = (n for n, pose in enumerate(known) if np.abs(pose - points.q_rad[k]).max() <= SAME_POSE_rad)
        number = next(near, len(known))
        if number == len(known):
            known.append(points.q_rad[k])
        numbers.append(number)
    several = {name for name, known in poses.items() if len(known) > 1}
    return [
        f"{point}, pose {number + 1}" if (setup, point) in several else point
        for setup, point, number in zip(points.setup, points.point, numbers, strict=True)
    ]
