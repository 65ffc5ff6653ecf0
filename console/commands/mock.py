"""`armwright mock`: a mock arm, or a mock cell, in real time, until Ctrl-C."""

import argparse
import sys
import tempfile
from pathlib import Path

from control.model.cell import load_cell, save_cell
from control.model.description import load_arm, save_arm
from hil_mocks.firmware.boards import choose
from hil_mocks.realtime import MockProcess, RealTimeCell, RealTimeRig
from procedures.mock import wired_to


def run(given: argparse.Namespace) -> int:
    """Start the mock, write files that are wired to it, print how to connect, and wait."""
    choose(given.firmware)
    with tempfile.TemporaryDirectory(prefix="armwright-") as folder:
        if given.cell is not None:
            return _cell(given, Path(folder))
        arm = load_arm(given.arm)
        with RealTimeRig(given.arm, given.scenario) as rig:
            file = Path(folder) / f"{arm.name}.toml"
            save_arm(wired_to(arm, rig), file)
            return _wait(rig, f"A mock of arm {arm.name!r} is", given.scenario, f"--arm {file}")


def _cell(given: argparse.Namespace, folder: Path) -> int:
    cell = load_cell(given.cell)
    with RealTimeCell(given.cell, given.scenario) as rig:
        wired = cell.with_arms([wired_to(placed.arm, rig.ports[placed.name]) for placed in cell.arms])
        what = f"Mocks of the arms of cell {cell.name!r} ({', '.join(cell.names)}) are"
        return _wait(rig, what, given.scenario, f"--cell {save_cell(wired, folder)}")


def _wait(rig: MockProcess, what: str, scenario: str, option: str) -> int:
    sys.stdout.write(
        f"{what} running with scenario {scenario!r}; Ctrl-C ends it. Connect with\n\n  armwright serve {option}\n"
    )
    sys.stdout.flush()
    try:
        status = rig.wait_for_end(None)
    except KeyboardInterrupt:
        return 0
    sys.stderr.write(f"armwright: the mock arm's process ended unexpectedly with status {status}\n")
    return 1
