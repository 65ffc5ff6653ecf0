"""`armwright move`: a joint move to angles, or to where the tip is at a position."""

import argparse

from console.commands.connection import connected
from control.errors import ArmError
from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """Move; returns when the arm is there."""
    if (given.joints is None) == (given.tip is None):
        raise ArmError("move: give either --joints or --tip")
    client = connected(given)
    if given.joints is not None:
        target = tuple(given.joints)
    else:
        from control.kinematics.inverse import InverseKinematics

        target = InverseKinematics(load_arm(given.arm)).nearest(
            tuple(given.tip), client.status()["joint_rad"]
        )
    client.move_joints(target, given.speed, waits=getattr(given, "waits", True))
    return 0
