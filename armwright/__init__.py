"""armwright for Python programs: the public names (docs/python.md).

Quantities are in SI units, angles in rad, tip positions in m in the arm's base frame; arrays are NumPy's float64. A name is
imported on first use, so that `import armwright` is fast.
"""

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from armwright.calibration import CalibrationResult, calibrate, make_points, read_points, read_recording, verify
    from armwright.connection import GripperState, RunningArm, Status, connect
    from armwright.gap import Gap, find_gap
    from armwright.kinematics import Kinematics
    from armwright.mock import MockArm, mock_arm
    from armwright.motion import Samples, Trajectory, plan_path
    from calib.errors import CalibrationError
    from calib.points.points import Points
    from calib.validation.verify import Comparison
    from console.visualisation.series import Series
    from control.errors import (
        ArmError,
        ArmFileError,
        BadTarget,
        JointLimitViolated,
        MissingModel,
        NearSingular,
        OutOfReach,
        PathError,
    )
    from control.hardware.measurement import Average
    from control.kinematics.inverse import Solution
    from control.model.arm import Arm
    from control.model.description import arm_names, load_arm, save_arm
    from control.model.fingerprint import AnotherArm
    from control.server.channel import RuntimeGone
    from control.server.client import ArmFaulted, MotionStopped, RequestRefused
    from firmware_iface.errors import ArmwrightError, LinkError
    from hil_mocks.errors import MockError

__all__ = [
    "AnotherArm",
    "Arm",
    "ArmError",
    "ArmFaulted",
    "ArmFileError",
    "ArmwrightError",
    "Average",
    "BadTarget",
    "CalibrationError",
    "CalibrationResult",
    "Comparison",
    "Gap",
    "GripperState",
    "JointLimitViolated",
    "Kinematics",
    "LinkError",
    "MissingModel",
    "MockArm",
    "MockError",
    "MotionStopped",
    "NearSingular",
    "OutOfReach",
    "PathError",
    "Points",
    "RequestRefused",
    "RunningArm",
    "RuntimeGone",
    "Samples",
    "Series",
    "Solution",
    "Status",
    "Trajectory",
    "arm_names",
    "calibrate",
    "connect",
    "find_gap",
    "load_arm",
    "make_points",
    "mock_arm",
    "plan_path",
    "read_points",
    "read_recording",
    "save_arm",
    "verify",
]

_NAMES = {
    "armwright.calibration": ("CalibrationResult", "calibrate", "make_points", "read_points", "read_recording", "verify"),
    "armwright.connection": ("GripperState", "RunningArm", "Status", "connect"),
    "armwright.gap": ("Gap", "find_gap"),
    "armwright.kinematics": ("Kinematics",),
    "armwright.mock": ("MockArm", "mock_arm"),
    "armwright.motion": ("Samples", "Trajectory", "plan_path"),
    "calib.errors": ("CalibrationError",),
    "calib.points.points": ("Points",),
    "calib.validation.verify": ("Comparison",),
    "console.visualisation.series": ("Series",),
    "control.errors": (
        "ArmError",
        "ArmFileError",
        "BadTarget",
        "JointLimitViolated",
        "MissingModel",
        "NearSingular",
        "OutOfReach",
        "PathError",
    ),
    "control.hardware.measurement": ("Average",),
    "control.server.client": ("ArmFaulted", "MotionStopped", "RequestRefused", "RuntimeGone"),
    "control.model.arm": ("Arm",),
    "control.model.description": ("arm_names", "load_arm", "save_arm"),
    "control.model.fingerprint": ("AnotherArm",),
    "control.kinematics.inverse": ("Solution",),
    "firmware_iface.errors": ("ArmwrightError", "LinkError"),
    "hil_mocks.errors": ("MockError",),
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("armwright")
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'armwright' has no attribute {name!r}")
    value: object = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


def _claim_packages() -> None:
    """Import our packages from beside this one, even if the working directory has a folder of the same name."""
    root = str(Path(__file__).resolve().parents[1])
    sys.path.insert(0, root)
    try:
        from firmware_iface.installation import claim
    finally:
        sys.path.remove(root)
    claim()


_claim_packages()
