"""`armwright jog`: one step of a joint or of the tip."""

import argparse
import sys
from typing import Any

from console.commands.connection import connected
from control.errors import ArmError


def run(given: argparse.Namespace) -> int:
    """Make the step; exit status 1 when something was in the way."""
    if (given.joint is None) == (given.axis is None):
        raise ArmError("jog: give either --joint or --axis")
    step: dict[str, Any] = {"axis": given.axis, "by_m": given.by}
    speed = "speed_m_s"
    if given.joint is not None:
        step, speed = {"joint": given.joint, "by_rad": given.by}, "speed_rad_s"
    if given.speed is not None:
        step[speed] = given.speed
    limited = connected(given).jog(**step)
    if limited:
        sys.stderr.write(f"armwright: {limited}\n")
    return 1 if limited and not limited.startswith("slower") else 0
