"""`armwright demo`: the whole job on a mock arm, or the paper's experiment."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from console.commands.progress import Bar
from console.demo import job
from console.demo.bench import Bench, RealTimeBench, SteppedBench
from console.folders import free_folder
from console.scenario_file import seeded_scenario
from control.model.arm import Arm
from control.model.description import load_arm

Conduct = Callable[[Arm, Bench, Path, job.Advance], str]
"""Does a demo on the bench's arm; returns what is printed about it."""


def run(given: argparse.Namespace) -> int:
    """Run the demo and print what it found."""
    arm = load_arm(given.arm)
    conduct, out_name, scenario_name = _DEMOS[given.what]
    can_home = all(drive.home is not None for drive in arm.drives)
    drawn = seeded_scenario(given.scenario or scenario_name, given.seed, was_homed=not can_home)
    out = free_folder(Path(given.out or out_name))
    out.mkdir(parents=True)
    scenario = out / "scenario.toml"
    scenario.write_bytes(drawn)
    log = out / "log"
    bench: Bench = (
        RealTimeBench(given.arm, scenario, log) if given.realtime else SteppedBench(arm, scenario, log)
    )
    try:
        with Bar("demo") as bar:
            said = conduct(arm, bench, out, bar.advance)
    finally:
        bench.close()
    sys.stdout.write(said)
    return 0


def _job(arm: Arm, bench: Bench, out: Path, advance: job.Advance) -> str:
    """Home, move, record the table, calibrate, verify, report."""
    from calib.verify import comparison_text

    outcome = job.run(arm, bench, out, advance)
    found = comparison_text(outcome.verification)
    (out / "verification.txt").write_text(found + "\n", encoding="utf-8")
    return (
        f"\nTip error at {len(outcome.verification.point)} verification points that the calibration did not use:\n\n"
        f"{found}\n\n"
        f"  report          {outcome.report}\n"
        f"  calibrated arm  {outcome.calibrated_arm}\n"
        f"  points          {out / 'points.csv'}\n"
        f"  recordings      {out / 'log'}\n"
    )


def _paper(arm: Arm, bench: Bench, out: Path, advance: job.Advance) -> str:
    """The experiment of SpringerPlus 5:1771, and what goes past it."""
    from console.demo import paper
    from console.demo.paper_page import findings
    from console.demo.paper_result import table_text, widths_text

    outcome = paper.run(arm, bench, out, advance)
    table = table_text(outcome.replay)
    (out / "paper.txt").write_text(table + "\n", encoding="utf-8")
    sentences = "\n".join(findings(outcome.replay))
    return (
        f"\nMean tip error at points that the calibrations did not use, and how much smaller it became (95 %):\n\n{table}\n\n"
        f"{sentences}\nIdentified play: {widths_text(outcome.replay.models[-1])}.\n\n"
        f"  report    {outcome.report}\n"
        f"  figures   {outcome.figures}\n"
        f"  points    {out / 'points.csv'}\n"
    )


_DEMOS: dict[str, tuple[Conduct, str, str]] = {
    "job": (_job, "out/demo", "demo"),
    "paper": (_paper, "out/demo-paper", "paper"),
}
