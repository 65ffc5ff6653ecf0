"""Import of URDF and MJCF: DH rows from the joints' axes, masses, limits, friction. docs/new_arm.md describes what is read.

safe_xml > urdf, mjcf > tree > serial > dh_rows, links
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from calib.arm_import.serial_arm import SerialArm, Tree, arm_links, friction_effects, serial_arm

__all__ = ["FORMS", "SerialArm", "arm_links", "friction_effects", "read_arm"]


def _urdf(path: Path) -> Tree:
    from calib.arm_import.urdf import read_urdf

    return read_urdf(path)


def _mjcf(path: Path) -> Tree:
    from calib.arm_import.mjcf import read_mjcf  # MuJoCo takes a third of a second to import

    return read_mjcf(path)


FORMS: Final[Mapping[str, Callable[[Path], Tree]]] = {"urdf": _urdf, "mjcf": _mjcf}


def read_arm(path: Path, form: str, base: str | None = None, tip: str | None = None) -> SerialArm:
    """The serial arm in a file, from link `base` (the root if None) to link `tip` (the only end if None)."""
    return serial_arm(FORMS[form](path), base, tip)
