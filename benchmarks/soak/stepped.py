"""Table sessions one after the other on the stepped mock arm: memory, file handles and counts must not drift.

python -m benchmarks.soak.stepped [--hours 24]

Each session records six points of the table and moves back to rest, with the whole runtime, its recording and all drivers. The
counts are compared with the plant's truth after each; memory and handles with what they were after the first ones.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from calib.session.conduct import Boards, Station, conduct
from calib.session.conversation import GO
from calib.session.folder import SessionFolder
from calib.session.moves import ArmGeometry, ClearPaths
from calib.session.plan import SessionPlan, board_targets, fingerprint
from calib.session.residual_watch import ResidualWatch
from procedures.drills.drill import Stage, stage
from procedures.ports import HandPort, MockHandSeat, RuntimePort

POINTS = ("1", "5", "9", "13", "17", "21")
WARM = 5  # sessions until caches are full
ROW = "{:>8} {:>9} {:>10} {:>12} {:>9} {:>12} {:>8}"


@dataclass(frozen=True, slots=True)
class Look:
    """State after a session."""

    simulated_s: float
    memory_bytes: int
    handles: int
    off_rad: float
    lost: int


def main(arguments: list[str] | None = None) -> int:
    """Run the sessions; 1 if something drifted."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--hours", type=float, default=24.0, help="of simulated time")
    args = options.parse_args(arguments)
    print(ROW.format("sessions", "hours", "memory MB", "handles", "off mrad", "lost frames", "x real"))
    with stage() as played:
        played.client.enable()
        looks, begun_s, begun = [], played.now_s, time.monotonic()
        while played.now_s - begun_s < 3600.0 * args.hours:
            _session(played)
            looks.append(_look(played, begun_s))
            played.way.clear()
            if len(looks) % 50 in (1, WARM):
                _say(looks, time.monotonic() - begun)
    _say(looks, time.monotonic() - begun)
    return verdict(looks[WARM:])


def _session(played: Stage) -> None:
    """One session in a folder of its own, then back to rest."""
    folder, arm = tempfile.mkdtemp(prefix="armwright-soak-"), played.arm
    plan = SessionPlan(arm.name, fingerprint(arm), arm.joint_count, board_targets(["normal"], POINTS))
    try:
        with SessionFolder(Path(folder) / "session", plan) as session:
            boards, geometry = Boards(arm, plan), ArmGeometry(arm)
            hand = MockHandSeat(HandPort(played.rig.hand, played.run), boards.reference_m)
            ways, watch = ClearPaths(arm, geometry), ResidualWatch(arm)
            talk = conduct(session, Station(RuntimePort(played.client), geometry, boards, watch, hand, ways=ways))
            next(talk)
            while session.state.left():
                talk.send(GO)
            talk.close()
    finally:
        shutil.rmtree(folder)
    if arm.rest is not None:
        played.client.move_joints(arm.rest.q_rad)


def _look(played: Stage, begun_s: float) -> Look:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    encoders, motors = played.connection.encoders, played.connection.motors
    lost = sum(board.lost for board in encoders) + sum(board.lost for board in motors)
    handles = len(os.listdir("/proc/self/fd"))  # noqa: PTH208  names only
    memory = pages * os.sysconf("SC_PAGE_SIZE")
    return Look(played.now_s - begun_s, memory, handles, played.wrong_rad(), lost)


def _say(looks: list[Look], taken_s: float) -> None:
    now = looks[-1]
    print(
        ROW.format(
            len(looks),
            f"{now.simulated_s / 3600.0:.2f}",
            f"{now.memory_bytes / 1e6:.1f}",
            now.handles,
            f"{1e3 * now.off_rad:.2f}",
            now.lost,
            f"{now.simulated_s / taken_s:.1f}",
        ),
        flush=True,
    )


def verdict(looks: list[Look]) -> int:
    """Say what drifted between the first and the last; 1 if something did."""
    if len(looks) < 2:
        print("too short for a verdict: the first sessions fill caches")
        return 0
    first, last = looks[0], looks[-1]
    grown = last.memory_bytes - first.memory_bytes
    bad = [
        *(["memory grew"] if grown > 0.1 * first.memory_bytes else []),
        *(["handles"] if last.handles != first.handles else []),
        *(["counts drifted"] if max(look.off_rad for look in looks) > 3e-3 else []),
        *(["frames were lost"] if last.lost else []),
    ]
    print(
        f"{len(looks) + WARM} sessions, {last.simulated_s / 3600.0:.2f} h: memory {grown / 1e6:+.1f} MB since the"
        f" {WARM + 1}th, {'; '.join(bad) or 'nothing drifted'}"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
