"""`armwright demo`: the whole job on a mock arm."""

import argparse
import sys
from pathlib import Path

from console.commands.progress import Bar
from console.demo import job
from console.demo.bench import Bench, RealTimeBench, SteppedBench
from console.folders import free_folder
from console.scenario_file import seeded_scenario
from control.model.description import load_arm


def run(given: argparse.Namespace) -> int:
    """Run the demo and print what it found."""
    from calib.verify import comparison_text

    arm = load_arm(given.arm)
    can_home = all(drive.home is not None for drive in arm.drives)
    drawn = seeded_scenario(given.scenario, given.seed, was_homed=not can_home)
    out = free_folder(Path(given.out))
    out.mkdir(parents=True)
    scenario = out / "scenario.toml"
    scenario.write_bytes(drawn)
    log = out / "log"
    bench: Bench = (
        RealTimeBench(given.arm, scenario, log) if given.realtime else SteppedBench(arm, scenario, log)
    )
    try:
        with Bar("demo") as bar:
            outcome = job.run(arm, bench, out, bar.advance)
    finally:
        bench.close()
    sys.stdout.write(
        f"\nTip error at {len(outcome.verification.point)} verification points that the calibration did not use:\n\n"
        f"{comparison_text(outcome.verification)}\n\n"
        f"  report          {outcome.report}\n"
        f"  calibrated arm  {outcome.calibrated_arm}\n"
        f"  points          {out / 'points.csv'}\n"
        f"  recordings      {out / 'log'}\n"
    )
    (out / "verification.txt").write_text(comparison_text(outcome.verification) + "\n", encoding="utf-8")
    return 0
