"""`armwright mark NAME`: keep where the arm stands as a named place."""

import argparse
import sys
from pathlib import Path

from console.commands.connection import connected
from console.places import keep_place
from control.errors import ArmError


def run(given: argparse.Namespace) -> int:
    """Add it to the places file, or put it in the stead of the one of this name."""
    status = connected(given).status()
    if not status["is_homed"]:
        raise ArmError("mark: the joint angles mean nothing yet: `armwright home`")
    was_there = keep_place(Path(given.places), given.name, status["joint_rad"])
    sys.stdout.write(
        f"{given.name} in {given.places}{', in the stead of another pose' if was_there else ''}\n"
    )
    return 0
