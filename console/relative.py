"""Way-points relative to the tip of another arm of the cell."""

import argparse
from dataclasses import replace

from control.errors import ArmError
from control.model.arm import Arm
from control.model.cell import load_cell
from control.motion.waypoints import Waypoints
from control.server.channel import SocketChannel
from control.server.client import ArmClient
from control.server.sockets import default_path

AT_REST = ("HOLDING", "OFF", "BRAKED", "HELD")


def beside(given: argparse.Namespace, arm: Arm, waypoints: Waypoints) -> Waypoints:
    """The way-points in the base frame of `arm`: as they are, offsets from the other arm's tip along the axes of the cell.

    ArmError unless the other arm is at rest, and homed.
    """
    cell = load_cell(given.cell)
    own, other = cell.placed(arm.name), cell.placed(given.relative_to)
    if own.name == other.name:
        raise ArmError(f"run: --relative-to: expected another arm than {own.name!r}")
    if waypoints.orientations is not None:
        raise ArmError("run: --relative-to: expected way-points without orientation (qw,qx,qy,qz)")
    client = ArmClient(SocketChannel(default_path(other.name)))
    try:
        client.require_arm(other.arm, cell)
        status = client.status()
    finally:
        client.close()
    if status["tip_set_m"] is None or status["mode"] not in AT_REST:
        homed = "homed" if status["is_homed"] else "not homed"
        raise ArmError(
            f"run: --relative-to {other.name}: expected the arm homed and at rest, since the path begins from where its tip is;"
            f" it is {status['mode']} and {homed}"
        )
    points = cell.beside_tip(own.name, other.name, status["tip_set_m"], waypoints.points)
    return replace(waypoints, points=points)
