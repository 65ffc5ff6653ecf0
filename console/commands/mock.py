"""`armwright mock`: a mock arm in real time, until Ctrl-C."""

import argparse
import sys
import tempfile
from pathlib import Path

from control.model.description import load_arm, save_arm
from hil_mocks.realtime import RealTimeRig
from procedures.mock.arm import wired_to


def run(given: argparse.Namespace) -> int:
    """Start the mock, write an arm.toml that is wired to it, print how to connect, and wait."""
    arm = load_arm(given.arm)
    with (
        RealTimeRig(given.arm, given.scenario) as rig,
        tempfile.TemporaryDirectory(prefix="armwright-") as folder,
    ):
        file = Path(folder) / f"{arm.name}.toml"
        save_arm(wired_to(arm, rig), file)
        sys.stdout.write(
            f"A mock of arm {arm.name!r} is running with scenario {given.scenario!r}; Ctrl-C ends it. Connect"
            f" with\n\n  armwright serve --arm {file}\n"
        )
        sys.stdout.flush()
        try:
            status = rig.wait_for_end(None)
        except KeyboardInterrupt:
            return 0
    sys.stderr.write(f"armwright: the mock arm's process ended unexpectedly with status {status}\n")
    return 1
