"""Episodes of a recording: each motion at a steady rate, without gaps, as learning wants it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array, Series
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

MOTION_MODES: Final = ("MOVING", "JOGGING", "STOPPING", "PAUSED")  # set-points that somebody asked for


@dataclass(frozen=True, slots=True)
class Episode:
    """One motion, m samples of n joints, all finite.

    joint_rad, joint_set_rad, current_A (m, n); tip_m (m, 3) in the base frame by the model, of joint_rad. `source`: recording
    and run.
    """

    arm: Arm
    source: str
    joint_rad: Array
    joint_set_rad: Array
    current_A: Array
    tip_m: Array

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.joint_rad)


def episodes_of(series: Series, rate_Hz: int) -> Iterator[Episode]:
    """Every run with a motion, from its begin to its end; where values are missing, the last ones are held.

    ArmError if the arm is unknown, or the recording is slower than `rate_Hz`.
    """
    if series.arm is None:
        raise ArmError(f"{series.name}: its arm is unknown: give it with --arm")
    if len(series) > 1 and rate_Hz * series.period_s > 1.0 + 1e-6:
        raise ArmError(
            f"{series.name}: --fps: expected at most the recorded {1.0 / series.period_s:.6g} Hz, got {rate_Hz}"
        )
    kinematics = ForwardKinematics(series.arm)
    groups = (series.joint_rad, series.joint_set_rad, series.current_A)
    is_whole = np.logical_and.reduce([np.isfinite(group).all(axis=1) for group in groups])
    is_moving = _is_moving(series)
    for number in np.unique(series.run[is_moving & is_whole]):
        of_run = series.run == number
        first, last = np.flatnonzero(of_run & is_moving)[[0, -1]]
        span = (np.arange(len(series)) >= first) & (np.arange(len(series)) <= last)
        rows = _held(series.t_s, np.flatnonzero(of_run & is_whole & span), 1.0 / rate_Hz)
        joint_rad = series.joint_rad[rows]
        yield Episode(
            series.arm,
            f"{series.name}, run {series.runs[number]}",
            joint_rad,
            series.joint_set_rad[rows],
            series.current_A[rows],
            kinematics.tips(joint_rad),
        )


def _is_moving(series: Series) -> NDArray[np.bool_]:
    """Samples (m,) in a motion; where no modes were recorded, all."""
    moving = [number for number, name in enumerate(series.modes) if name in MOTION_MODES]
    return np.isin(series.mode, moving) | (series.mode < 0)


def _held(t_s: Array, rows: NDArray[np.int64], period_s: float) -> NDArray[np.int64]:
    """For times `period_s` apart, from that of the first row: the last of the rows until then."""
    times_s = t_s[rows]
    steps = int((times_s[-1] - times_s[0]) / period_s + 1e-6) + 1
    wanted_s = times_s[0] + period_s * np.arange(steps)
    # a cycle begins some microseconds early or late: half a cycle decides which one is meant
    slack_s = 0.5 * float(np.median(np.diff(times_s))) if len(rows) > 1 else 0.0
    found: NDArray[np.int64] = rows[np.searchsorted(times_s, wanted_s + slack_s, side="right") - 1]
    return found
