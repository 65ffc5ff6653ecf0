"""`armwright export-arm`: an arm, calibrated or not, as URDF, MJCF or JSON."""

import argparse
import sys
from pathlib import Path

from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """Write the file; say what it cannot hold."""
    from calib.export import export

    arm = load_arm(given.arm)
    path = Path(given.out)
    lost = export(arm, given.export, path)
    sys.stdout.write(f"{path}: arm {arm.name}, {arm.joint_count} joints, as {given.export}\n")
    for sentence in lost:
        sys.stdout.write(f"  {sentence}\n")
    return 0
