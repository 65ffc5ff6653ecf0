"""The recording of a cell as one series: the joints of all arms on one clock."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from console.visualisation.columns import Report
from console.visualisation.reading import of_recording, read_series, rows_of
from console.visualisation.series import Series
from control.model.arm import Arm
from control.recording.cell_folder import arm_of, recorded_cell, recordings_in
from control.recording.joined import SAME_S
from control.recording.reading import RecordError

PER_JOINT = (
    "q_rad", "q_set_rad", "joint_rad", "joint_set_rad", "current_A", "voltage_V", "supply_V", "temperature_C",
)  # fmt: skip
ANGLES = ("q_rad", "q_set_rad", "joint_rad", "joint_set_rad")


def read_log(path: Path, arm: Arm | None = None, report: Report = lambda done: None) -> Series:
    """A file as `read_series` does, or the folder of a cell's run."""
    if not path.is_dir():
        return read_series(path, arm, report)
    if arm is not None:
        raise RecordError(f"--arm: not for {path}, a cell's folder, which has every arm's description")
    return series_of_cell(path)


def series_of_cell(folder: Path) -> Series:
    """The cycles that all arms have; angles are NaN while an arm is not homed, set-points where it has none.

    Runs and what the process says are those of the first arm. RecordError if the files are not of one run of a cell.
    """
    recordings = recordings_in(folder)
    rows = [rows_of(one) for one in recordings]
    common = reduce(np.intersect1d, [one["cycle"] for one in rows])
    at = [one[np.searchsorted(one["cycle"], common)] for one in rows]
    apart_s = np.ptp([one["t_s"] for one in at], axis=0)
    if not len(common) or apart_s.max() > SAME_S:
        names = ", ".join(arm_of(one) for one in recordings)
        raise RecordError(
            f"{folder}: {names} have no cycles in common: they are not of one run of `armwright serve`"
        )
    found = [_known(of_recording(one, own)) for one, own in zip(recordings, at, strict=True)]
    first = found[0]
    joined: dict[str, Any] = {name: np.hstack([getattr(one, name) for one in found]) for name in PER_JOINT}
    return replace(
        first,
        **joined,
        name=folder.name,
        mode=np.full(len(first), -1),
        tip_m=np.full((len(first), 3), np.nan),
        arm=None,
        cell=recorded_cell(recordings),
        notes=tuple(note for one in found for note in one.notes),
    )


def _known(series: Series) -> Series:
    """Without angles from before the arm was homed, and without set-points that it did not follow."""
    placed = np.where(series.is_placed[:, None], 1.0, np.nan)
    angles: dict[str, Any] = {name: placed * getattr(series, name) for name in ANGLES}
    followed = np.where(np.isfinite(series.following_error_rad), 1.0, np.nan)
    for name in ("q_set_rad", "joint_set_rad"):
        angles[name] = followed * angles[name]
    return replace(series, **angles)
