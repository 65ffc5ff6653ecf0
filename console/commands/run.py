"""`armwright run FILE`: way-points through a Cartesian spline; everything is checked before anything moves."""

import argparse
import sys

from console.commands.connection import connected
from control.model.description import load_arm
from control.motion.plan import PlannedPath, plan_path
from control.motion.waypoints import read_waypoints


def run(given: argparse.Namespace) -> int:
    """Plan, say what will be done, and do it unless only the plan was wanted."""
    arm = load_arm(given.arm)
    waypoints = read_waypoints(given.file)
    if given.plan_only:
        sys.stdout.write(described(plan_path(arm, waypoints, given.speed)))
        return 0
    client = connected(given)
    path = plan_path(arm, waypoints, given.speed, q_near_rad=client.status()["joint_rad"])
    sys.stdout.write(described(path))
    sys.stdout.flush()
    client.move_joints(path.q_start_rad, 0.5)
    client.run_path(path.to_message(), waits=getattr(given, "waits", True))
    return 0


def described(path: PlannedPath) -> str:
    """The plan in words."""
    angles = ", ".join(f"{q:.4f}" for q in path.q_start_rad)
    lines = [
        f"{len(path.q_waypoints_rad)} way-points in {path.duration_s:.2f} s, {path.branch}; begins at {angles} rad",
        *map(str, path.slowdowns),
    ]
    return "\n".join(lines) + "\n"
