"""`armwright go NAME`: to a named place."""

import argparse
from pathlib import Path

from console.commands.connection import connected
from console.places import find_place
from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """A joint move; returns when the arm is there."""
    place = find_place(Path(given.places), given.name)
    client = connected(given)
    target = place.q_rad
    if target is None:
        from control.kinematics.inverse import InverseKinematics

        inverse = InverseKinematics(load_arm(given.arm))
        target = inverse.nearest(place.tip_m or (), client.status()["joint_rad"])
    client.move_joints(target, given.speed, waits=getattr(given, "waits", True))
    return 0
