"""Recordings of the control loop as arrays."""

from __future__ import annotations

from pathlib import Path

from console.visualisation.reading import read_series
from console.visualisation.series import Series
from control.model.arm import Arm
from control.model.description import load_arm


def read_recording(path: str | Path, arm: Arm | str | Path | None = None) -> Series:
    """Read a recording: `.armlog`, `log.csv`, `log.csv.gz` or MCAP, recognised by content.

    Args:
        path: the file.
        arm: the recorded arm (an Arm, file or name), if the file does not name it.

    Returns:
        Arrays over m samples, NaN where nothing was measured: `t_s` (m,) from 0 on; `q_rad`, `q_set_rad` of the encoders,
        `joint_rad`, `joint_set_rad` of the joints, `current_A`, `voltage_V` (m, n); `tip_m` (m, 3) by the camera in the
        base frame; `mode` (m,) indices into `modes`; `run` (m,) indices into `runs`. `notes` are problems of the file.

    Raises:
        ArmError: the file is missing, of another format, damaged, or has another number of joints than `arm`.
        CalibrationError: a log.csv with a wrong column or value; names file, line and column.
    """
    return read_series(Path(path), load_arm(arm) if isinstance(arm, str | Path) else arm)
