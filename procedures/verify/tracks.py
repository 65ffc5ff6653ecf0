"""Planned and measured tip along a run, from the recording: the camera's frames against the set-points."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from calib.arrays import frozen
from calib.validation.verify import Track
from control.errors import ArmError
from control.recording.frame_decoder import row_type
from control.recording.parts import parts_from
from control.recording.reading import Recording
from control.safety.table import Mode
from procedures.verify.driving import Run
from procedures.verify.models import Model

LONGEST_DELAY_S = 0.1  # for a usable camera
DELAY_STEP_S = 0.001
MOVING = list(Mode).index(Mode.MOVING)
PATIENCE_S = 5.0  # for the recording's writer process


def track_of(recording: Path, model: Model, ran: Run, name: str) -> Track:
    """The tip along a run: planned by the model, measured by the camera.

    Planned is the tip at the recorded set-points; if those are encoder angles that differ from the joints', the tip of the path
    at that time of the run. In the frame of table and camera. Camera frames arrive with a constant delay. It is
    estimated as the one for which the measured path best follows the planned one, and removed, so that the error is that of
    the arm.
    """
    rows = recorded(recording)
    rows = rows[(rows["run"] == ran.number) & (rows["mode"] == MOVING)]
    if not len(rows):
        raise ArmError(f"{recording}: contains no run {ran.number}")
    time_s = np.asarray(rows["t_s"])
    planned_m = planned_tips_m(rows, model, ran)
    seen_m = np.column_stack([rows[name] for name in ("x_m", "y_m", "z_m")])
    seen = ~np.isnan(seen_m).any(axis=1)
    if not seen.any():
        raise ArmError(f"{recording}: no camera frame in run {ran.number}: check that the camera was on")
    taken_s = time_s[seen] - _camera_delay_s(time_s, planned_m, time_s[seen], seen_m[seen])
    within = taken_s >= time_s[0]  # the first frames to arrive were taken before the run
    at_s = taken_s[within]
    planned_at_m = _at(at_s, time_s, planned_m)
    return Track(name, frozen(at_s - time_s[0]), frozen(planned_at_m), frozen(seen_m[seen][within]))


def planned_tips_m(rows: np.ndarray, model: Model, ran: Run) -> np.ndarray:
    """Planned tips (m, 3) at the rows' times. The first row of a run is one cycle into it."""
    if ran.path is None:
        joints = range(1, model.arm.joint_count + 1)
        return model.tips(np.column_stack([rows[f"q{joint}_set_rad"] for joint in joints]))
    time_s = np.asarray(rows["t_s"])
    period_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    spline = ran.path.spline
    at_s = (ran.pace * (time_s - time_s[0] + period_s)).tolist()
    return model.seen(np.array([spline.at(t)[0] for t in at_s]))


def recorded(recording: Path) -> np.ndarray:
    """The rows of a recording and of its later parts, which may still be growing, as a structured array."""
    return np.concatenate([_rows(part) for part in parts_from(recording)])


def _rows(part: Path) -> np.ndarray:
    opened = Recording.open(part)
    return np.frombuffer(opened.packed(), dtype=row_type(opened.layout.names, opened.layout.packing))


def wait_until_recorded(recording: Path, t_s: float, wait: Callable[[float], None]) -> None:
    """Return when the recording has reached the loop's time `t_s`; ArmError if it does not."""
    for _ in range(int(PATIENCE_S / 0.1)):
        newest = _rows(parts_from(recording)[-1])
        if len(newest) and newest["t_s"][-1] >= t_s:
            return
        wait(0.1)
    raise ArmError(f"{recording}: has stopped growing: check for a full disk")


def _at(time_s: np.ndarray, times_s: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Points (m, 3) between those of times_s."""
    return np.column_stack([np.interp(time_s, times_s, points_m[:, axis]) for axis in range(3)])


def _camera_delay_s(
    time_s: np.ndarray, planned_m: np.ndarray, seen_s: np.ndarray, seen_m: np.ndarray
) -> float:
    """The delay with the least scatter of measured minus planned; a constant offset is not a delay."""
    delays_s = np.arange(0.0, LONGEST_DELAY_S, DELAY_STEP_S)
    scatter = []
    for delay_s in delays_s:
        error = seen_m - _at(seen_s - delay_s, time_s, planned_m)
        scatter.append(float(np.sum((error - error.mean(axis=0)) ** 2)))
    return float(delays_s[int(np.argmin(scatter))])
