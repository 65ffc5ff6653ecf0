"""Paths of the tip: commanded, measured, and by the camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from console.visualisation.series import Array, Series
from console.visualisation.snapshots import Snapshot
from control.kinematics.kinematics import Kinematics

POINTS_MOST: Final = 4000
LONGEST_PATH: Final = 400


@dataclass(slots=True)
class Traces:
    """Points (k, 3) in the base frame [m], in the order of time; NaN is a gap."""

    commanded_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    measured_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    camera_m: Array = field(default_factory=lambda: np.empty((0, 3)))


def traces_of(series: Series, kinematics: Kinematics) -> Traces:
    """Traces of a whole recording, thinned; gaps where an angle is missing or invalid."""
    step = 1 + len(series) // POINTS_MOST
    placed = np.where(series.is_placed[:, None], 1.0, np.nan)
    camera = series.tip_m[np.isfinite(series.tip_m).all(axis=1) & series.is_placed]
    return Traces(
        commanded_m=tips_of(kinematics, (placed * series.joint_set_rad)[::step]),
        measured_m=tips_of(kinematics, (placed * series.joint_rad)[::step]),
        camera_m=camera[:: 1 + len(camera) // POINTS_MOST],
    )


def tips_of(kinematics: Kinematics, angles_rad: Array) -> Array:
    """Tips (m, 3) of angles (m, n); NaN where an angle is NaN."""
    found = np.full((len(angles_rad), 3), np.nan)
    rows = np.isfinite(angles_rad).all(axis=1)
    if rows.any():
        found[rows] = kinematics.tips(angles_rad[rows])
    return found


class TipPath:
    """The last tips of a live arm."""

    def __init__(self, kinematics: Kinematics, most: int = LONGEST_PATH) -> None:
        self._kinematics, self._most = kinematics, most
        self._traces = Traces()

    def add(self, snapshot: Snapshot) -> Traces:
        """Append one snapshot; returns the path."""
        measured, commanded = self._kinematics.tips([snapshot.joint_rad, snapshot.joint_set_rad])
        traces = self._traces
        traces.measured_m = np.vstack([traces.measured_m, measured])[-self._most :]
        traces.commanded_m = np.vstack([traces.commanded_m, commanded])[-self._most :]
        if snapshot.camera_m is not None:
            traces.camera_m = np.vstack([traces.camera_m, snapshot.camera_m])[-self._most :]
        return traces
