"""`armwright doctor`: checks an arm before it is switched on. Nothing is energised and nothing moves."""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from console.commands.progress import answer
from control.errors import ArmError
from control.model.arm import Arm
from firmware_iface.clock import Clock
from procedures.bringup.bench import opened
from procedures.doctor.boards import open_boards, sample
from procedures.doctor.finding import Finding, Level, as_json, as_text, verdict, worst
from procedures.doctor.host import look_at_host, look_at_last_recording, look_at_links, look_at_ports
from procedures.doctor.judging import judge

LONGEST_S = 600.0


def run(given: argparse.Namespace) -> int:
    """Check everything and print the findings."""
    if not 0.1 <= given.seconds <= LONGEST_S:
        raise ArmError(f"--seconds: expected 0.1 to {LONGEST_S:g}, got {given.seconds:g}")
    if given.rate is not None and not 20.0 <= given.rate <= 1200.0:
        raise ArmError(f"--rate: expected 20 to 1200 Hz, got {given.rate:g}")
    with opened(given) as setting, _recordings(given) as log_folder:
        rate_Hz = given.rate or setting.arm.usual_rate_Hz
        findings = examine(setting.arm, setting.clock, 1.0 / rate_Hz, given.seconds, log_folder)
    name = setting.arm.name
    answer(given, as_json(name, findings), f"{as_text(findings)}\narm {name}: {verdict(findings)}")
    return 1 if worst(findings) is Level.BAD else 0


@contextmanager
def _recordings(given: argparse.Namespace) -> Iterator[Path]:
    """The folder that is meant. A mock arm has an empty one, for the recordings in `log` are of another arm."""
    if given.log is not None or not given.mock:
        yield Path(given.log or "log")
        return
    with tempfile.TemporaryDirectory(prefix="armwright-doctor-") as made:
        yield Path(made)


def examine(arm: Arm, clock: Clock, period_s: float, duration_s: float, log_folder: Path) -> list[Finding]:
    """Check this machine, then ports, boards, timing and signals; all of them, even if one fails."""
    findings = look_at_host(period_s, arm.limits.watchdog_s, arm.joint_count, log_folder)
    findings += look_at_last_recording(log_folder) + look_at_ports() + look_at_links(arm)
    boards = open_boards(arm, clock, period_s)
    try:
        found = list(judge(sample(boards, clock, period_s, duration_s), arm))
    finally:
        boards.close()
    findings += boards.findings
    return findings + sorted(found, key=lambda finding: finding.group == "signals")
