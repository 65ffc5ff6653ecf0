"""Planned and measured tip along a run, from the recording: the camera's frames against the set-points."""

from pathlib import Path

import numpy as np

from calib.arrays import frozen
from calib.report_data import Track
from control.errors import ArmError
from control.loop.record import Recording
from control.model.arm import Arm
from control.model.kinematics import Kinematics
from control.safety.table import Mode

LONGEST_DELAY_S = 0.1  # of a camera that is worth using
MOVING = list(Mode).index(Mode.MOVING)


def track_of(recording: Path, arm: Arm, run: int, name: str) -> Track:
    """The tip along run number `run`: set-points through the arm's model, measured by the camera.

    A camera's frames arrive late by a constant delay. It is estimated as the one under which the measured path follows
    the planned one best, and taken out, so that the error is that of the arm.
    """
    time_s, q_set_rad, seen_m = _rows(recording, arm.joint_count, run)
    planned_m = Kinematics(arm).tips(q_set_rad)
    seen = ~np.isnan(seen_m).any(axis=1)
    if not seen.any():
        raise ArmError(f"{recording}: no camera frame in run {run}: was the camera on?")
    delay_s = _camera_delay_s(time_s, planned_m, time_s[seen], seen_m[seen])
    at_s = time_s[seen] - delay_s
    wanted_m = np.column_stack([np.interp(at_s, time_s, planned_m[:, axis]) for axis in range(3)])
    return Track(name, frozen(at_s - time_s[0]), frozen(wanted_m), frozen(seen_m[seen]))


def _rows(recording: Path, joint_count: int, run: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    opened = Recording.open(recording)
    at = {name: index for index, name in enumerate(opened.layout.names)}
    wanted = [
        at["t_s"],
        *(at[f"q{j}_set_rad"] for j in range(1, joint_count + 1)),
        at["x_m"],
        at["y_m"],
        at["z_m"],
    ]
    rows = [
        [row[i] for i in wanted]
        for row in opened.rows()
        if row[at["run"]] == run and row[at["mode"]] == MOVING
    ]
    if not rows:
        raise ArmError(f"{recording}: holds no run {run}")
    values = np.array(rows)
    return values[:, 0], values[:, 1 : 1 + joint_count], values[:, 1 + joint_count :]


def _camera_delay_s(
    time_s: np.ndarray, planned_m: np.ndarray, seen_s: np.ndarray, seen_m: np.ndarray
) -> float:
    """The delay that leaves the least scatter of measured minus planned; a constant offset is no delay."""
    delays_s = np.arange(0.0, LONGEST_DELAY_S, 0.001)
    scatter = []
    for delay_s in delays_s:
        planned = np.column_stack(
            [np.interp(seen_s - delay_s, time_s, planned_m[:, axis]) for axis in range(3)]
        )
        error = seen_m - planned
        scatter.append(float(np.sum((error - error.mean(axis=0)) ** 2)))
    return float(delays_s[int(np.argmin(scatter))])
