"""Streams the arm to a Rerun viewer: joints, set-points, currents, and the arm as lines. An extra: rerun-sdk is 521 MB."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from console.visualisation.series import Array
from console.visualisation.snapshots import Snapshot
from control.errors import ArmError
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

TIMELINE: Final = "arm"
MEASURED, COMMANDED, CAMERA = [0, 114, 178], [213, 94, 0], [0, 158, 115]


def stream(arm: Arm, snapshots: Iterator[Snapshot], file: Path | None) -> int:
    """Send all snapshots to a viewer that Rerun starts, or to an .rrd `file`; return their number.

    ArmError if rerun-sdk is not installed or the file exists.
    """
    rerun = _rerun()
    rerun.init(f"armwright {arm.name}", spawn=file is None)
    if file is not None:
        if file.exists():
            raise ArmError(f"{file} exists already and is never overwritten: choose another file")
        rerun.save(file)
    rerun.log("arm", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    kinematics, count = ForwardKinematics(arm), 0
    for snapshot in snapshots:
        rerun.set_time(TIMELINE, duration=snapshot.t_s)
        _log(rerun, kinematics, snapshot)
        count += 1
    return count


def _rerun() -> Any:
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        raise ArmError(
            "--rerun: rerun-sdk is not installed (521 MB, so it is an extra): in the clone, .venv/bin/pip install -e '.[rerun]'"
        ) from error


def _log(rerun: Any, kinematics: ForwardKinematics, snapshot: Snapshot) -> None:
    for number, (angle, wanted) in enumerate(zip(snapshot.q_rad, snapshot.q_set_rad, strict=True), start=1):
        rerun.log(f"joint{number}/q_rad", rerun.Scalars(angle))
        rerun.log(f"joint{number}/q_set_rad", rerun.Scalars(wanted))
        rerun.log(f"joint{number}/following_error_rad", rerun.Scalars(wanted - angle))
    for number, current in enumerate(snapshot.current_A, start=1):
        rerun.log(f"joint{number}/current_A", rerun.Scalars(current))
    for name, angles, colour in (
        ("measured", snapshot.joint_rad, MEASURED),
        ("commanded", snapshot.joint_set_rad, COMMANDED),
    ):
        points = _points_m(kinematics, angles)
        rerun.log(f"arm/{name}", rerun.LineStrips3D([points], colors=[colour], radii=[0.01]))
        rerun.log(f"arm/{name}_tip", rerun.Points3D([points[-1]], colors=[colour], radii=[0.012]))
    if snapshot.camera_m is not None:
        rerun.log("arm/camera", rerun.Points3D([snapshot.camera_m], colors=[CAMERA], radii=[0.008]))


def _points_m(kinematics: ForwardKinematics, q_rad: Sequence[float]) -> list[Array]:
    """Origins of the link frames and the tip."""
    return [*kinematics.link_transforms([q_rad])[0][:, :3, 3], kinematics.tips([q_rad])[0]]
