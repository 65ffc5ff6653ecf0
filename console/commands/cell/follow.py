"""`armwright follow`: one arm follows another, which a hand guides or a program moves."""

import argparse
import select
import sys

from console.commands.connection import connected_arms
from control.errors import ArmError
from control.model.cell import load_cell
from procedures.guiding import Following, mirror_signs, require_alike


def run(given: argparse.Namespace) -> int:
    """Follow until Enter or Ctrl-C, or until the follower is stopped."""
    cell = load_cell(given.cell)
    leader, follower = cell.placed(given.leader), cell.placed(given.follower)
    if leader is follower:
        raise ArmError(f"follow: expected two arms, got {leader.name!r} twice")
    require_alike(leader, follower)
    signs = mirror_signs(leader, follower) if given.mirrored else (1.0,) * follower.arm.joint_count
    with connected_arms(given, (leader.name, follower.name)) as clients:
        following = Following(clients[leader.name], clients[follower.name], follower, signs)
        sys.stderr.write(
            f"arm {follower.name!r} follows arm {leader.name!r}: guide it by hand (`armwright guide --weightless --arm"
            f" {leader.name}`) or move it; {'Enter or ' if sys.stdin.isatty() else ''}Ctrl-C ends it\n"
        )
        following.run(_Steps(following).go_on)
    return 0


class _Steps:
    """Says what limits the follower, once each, and looks for Enter."""

    def __init__(self, following: Following) -> None:
        self._following = following
        self._said = ""

    def go_on(self) -> bool:
        """Whether nobody has pressed Enter."""
        limited = self._following.limited
        if limited and limited != self._said:
            sys.stderr.write(f"armwright: {limited}\n")
        self._said = limited
        return not (sys.stdin.isatty() and select.select([sys.stdin], [], [], 0.0)[0])
