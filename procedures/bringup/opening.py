"""Opens the arm of a command: on its own ports or as a mock arm, with the matching clock."""

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from control.errors import ArmError
from control.hardware.connect import with_links
from control.model.arm import Arm
from control.model.description import load_arm
from firmware_iface.clock import Clock, MonotonicClock
from procedures.bringup.bench import ReferenceBench
from procedures.bringup.operator import BringupOperator
from procedures.bringup.workbench import Workbench
from procedures.link_options import link_options

if TYPE_CHECKING:
    from hil_mocks.rig import SteppedRig


@dataclass(frozen=True, slots=True)
class Setting:
    """An arm with its ports, the clock, and the mock behind the ports (None with real boards)."""

    draft: Arm
    """The arm as in its file."""
    arm: Arm
    """The arm with the links of the command line or the mock."""
    clock: Clock
    rig: "SteppedRig | None" = None


@contextmanager
def open_bench(
    arm: Arm, clock: Clock, operator: BringupOperator, currents_A: Mapping[int, float]
) -> Iterator[Workbench]:
    """The boards of an arm, whose drives get at most `currents_A` by joint. ArmError where not all are of one sort."""
    bought = [drive.board for drive in arm.drives if drive.board]
    if bought and len(bought) < len(arm.drives):
        raise ArmError(
            f"arm {arm.name}: bring-up takes reference motor boards or [[board]]s, not both: bring up two drafts, each with the"
            " joints of one sort"
        )
    if bought:
        from procedures.bringup.bought_bench import BoughtBench

        with BoughtBench(arm, clock, operator, currents_A) as boards:
            yield boards
        return
    with ReferenceBench(arm, clock, operator) as bench:
        yield bench


@contextmanager
def opened(given: argparse.Namespace) -> Iterator[Setting]:
    """Open the arm of the command line. ArmError if options contradict each other."""
    draft = load_arm(given.arm)
    if not given.mock:
        for name in ("scenario", "mock_arm"):
            if getattr(given, name) is not None:
                raise ArmError(f"--{name.replace('_', '-')} needs --mock")
        yield Setting(draft, with_links(draft, link_options(given)), MonotonicClock())
        return
    if given.encoder or given.can_interface or given.can_channel:
        raise ArmError("--mock brings its own links: omit --encoder and --can-...")
    from hil_mocks.rig import SteppedRig
    from procedures.mock import wired_to

    built = load_arm(given.mock_arm) if given.mock_arm else draft
    with SteppedRig(built, given.scenario or "demo") as rig:
        yield Setting(draft, wired_to(draft, rig), rig.clock, rig)
