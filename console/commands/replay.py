"""`armwright replay`: repeats a motion that a hand has guided, from a recording."""

import argparse
import sys
from pathlib import Path

from console.commands.connection import connected, with_present_tool
from console.commands.progress import shown
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.guiding import Replay, guided_motion, replayed

TO_START_SPEED = 0.3  # of the joints' limits, to where the motion begins


def run(given: argparse.Namespace) -> int:
    """Read, smooth and check the motion; then move to its beginning and run it."""
    arm = load_arm(given.arm)
    if given.plan_only:
        _planned(given, arm)
        return 0
    client = connected(given)
    planned = _planned(given, with_present_tool(arm, client))
    with shown(client, given, "replay: to the beginning"):
        client.move_joints(planned.path.knots[0].q_rad, TO_START_SPEED)
    with shown(client, given):
        client.run_path(planned.path.to_message())
    return 0


def _planned(given: argparse.Namespace, arm: Arm) -> Replay:
    guided = guided_motion(Path(given.file), arm, given.run)
    planned = replayed(guided, arm, given.speed)
    slowed = f", {planned.slowdown:.2f} times as long because of {planned.limit}" if planned.limit else ""
    angles = ", ".join(f"{q:.4f}" for q in planned.path.knots[0].q_rad)
    sys.stdout.write(
        f"run {guided.run}: guided for {guided.times_s[-1]:.2f} s; the motion takes {planned.path.duration_s:.2f} s{slowed};"
        f" begins at {angles} rad\n"
    )
    sys.stdout.flush()
    return planned
