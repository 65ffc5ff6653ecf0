"""`armwright demo`: the full workflow on a mock arm, the paper's experiment, the gap workflow, a webcam, or two arms."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from calib.errors import CalibrationError
from console.commands.progress import Bar
from control.files import write_whole
from control.model.arm import Arm
from control.model.cell import load_cell
from control.model.description import load_arm, save_arm
from control.progress import Advance
from procedures.demo import job
from procedures.folders import free_folder, require_writable
from procedures.mock import MockBench, RealTimeBench, SteppedBench, seeded_scenario
from procedures.on_boards import on_boards

GAP_SEED = 1  # seed of the hidden effect of `demo gap`
Conduct = Callable[[Arm, MockBench, Path, Advance], str]
"""Runs a demo on the bench's arm; returns the text to print."""


def run(given: argparse.Namespace) -> int:
    """Run the demo and print its results."""
    if given.what == "two-arms":
        return _two_arms(given)
    if given.cell is not None:
        raise CalibrationError("--cell is only for `armwright demo two-arms`")
    if given.what == "gap":
        return _gap(given)
    if given.what == "camera":
        return _camera(given)
    for name in ("effect", "joint"):
        if getattr(given, name) is not None:
            raise CalibrationError(f"--{name} is only for `armwright demo gap`")
    if given.boards is not None and given.what != "job":
        raise CalibrationError("--boards is only for the full workflow: `armwright demo job`")
    arm = load_arm(given.arm)
    if given.boards is not None:
        arm = on_boards(arm, given.boards)
    conduct, out_name, scenario_name = _DEMOS[given.what]
    drawn = seeded_scenario(given.scenario or scenario_name, given.seed, was_homed=not arm.can_home)
    out = free_folder(Path(given.out or out_name))
    require_writable(out)
    out.mkdir(parents=True)
    scenario = out / "scenario.toml"
    write_whole(scenario, drawn)
    log = out / "log"
    file = given.arm
    if given.boards is not None:
        file = out / "arm.toml"
        save_arm(arm, file)
        arm = load_arm(str(file))
    bench: MockBench = (
        RealTimeBench(file, scenario, log) if given.realtime else SteppedBench(arm, scenario, log)
    )
    try:
        with Bar("demo") as bar:
            summary = conduct(arm, bench, out, bar.advance)
    finally:
        bench.close()
    sys.stdout.write(summary)
    return 0


def _job(arm: Arm, bench: MockBench, out: Path, advance: Advance) -> str:
    """Home, move, record the table, calibrate, verify, report."""
    from calib.validation.verify import comparison_text

    outcome = job.run(arm, bench, out, advance)
    found = comparison_text(outcome.verification)
    write_whole(out / "verification.txt", found + "\n")
    return (
        f"\nTip error at {len(outcome.verification.point)} verification points that calibration did not"
        f" use:\n\n{found}\n\n  report          {outcome.report}\n  calibrated arm  {outcome.calibrated_arm}\n"
        f"  points          {out / 'points.csv'}\n  recordings      {out / 'log'}\n"
    )


def _paper(arm: Arm, bench: MockBench, out: Path, advance: Advance) -> str:
    """The experiment of SpringerPlus 5:1771, and two further steps."""
    from procedures.demo import paper
    from procedures.demo.paper_page import findings, table_text, widths_text

    outcome = paper.run(arm, bench, out, advance)
    table = table_text(outcome.replay)
    write_whole(out / "paper.txt", table + "\n")
    sentences = "\n".join(findings(outcome.replay))
    return (
        "\nMean tip error at points that calibration did not use, and its reduction (95"
        f" %):\n\n{table}\n\n{sentences}\nIdentified backlash: {widths_text(outcome.replay.models[-1])}.\n\n  report"
        f"    {outcome.report}\n  figures   {outcome.figures}\n  points    {out / 'points.csv'}\n"
    )


def _gap(given: argparse.Namespace) -> int:
    """Hide an effect, find it, add it to the model and correct it; exit status 1 if it was not found."""
    from procedures.demo import gap
    from procedures.demo.gap import beyond_known, drawn, findings, with_known_friction, write_page

    for name in ("scenario", "realtime", "boards"):
        if getattr(given, name):
            raise CalibrationError(f"--{name} is not for `armwright demo gap`, which hides its own effect")
    seed = given.seed if given.seed is not None else GAP_SEED
    hidden = drawn(seed, given.effect, given.joint)
    arm = with_known_friction(load_arm(given.arm))
    out = free_folder(Path(given.out or "out/demo-gap"))
    require_writable(out)
    out.mkdir(parents=True)
    save_arm(arm, out / "nominal.toml")
    arm = load_arm(str(out / "nominal.toml"))
    scenario = out / "scenario.toml"
    write_whole(scenario, beyond_known(hidden, arm).as_scenario("gap", seed))
    write_whole(scenario, seeded_scenario(str(scenario), seed, was_homed=not arm.can_home))
    bench = SteppedBench(arm, scenario, out / "log")
    try:
        with Bar("demo") as bar:
            circle = gap.run(arm, bench, hidden, out, bar.advance)
    finally:
        bench.close()
    report = write_page(circle, out)
    sys.stdout.write("\n" + "".join(f"{sentence}\n" for sentence in findings(circle)))
    sys.stdout.write(f"\n  report  {report}\n  model   {out / 'gap' / 'arm.toml'}\n")
    return 0 if circle.is_right else 1


def _camera(given: argparse.Namespace) -> int:
    """Measure a mock arm with a webcam, calibrate it, compare with the truth."""
    from calib.vision.targets import opencv
    from procedures.demo import webcam

    for name in ("realtime", "effect", "joint"):
        if getattr(given, name):
            raise CalibrationError(
                f"--{name} is not for `armwright demo camera`, which renders pictures of an arm at rest"
            )
    opencv()
    arm = load_arm(given.arm)
    if arm.name != "right":
        raise CalibrationError(
            f'demo camera: its camera stands before the reference arm; expected --arm right, got "{arm.name}"'
        )
    drawn = seeded_scenario(given.scenario or "demo", given.seed, was_homed=True)
    out = free_folder(Path(given.out or "out/demo-camera"))
    require_writable(out)
    out.mkdir(parents=True)
    write_whole(out / "scenario.toml", drawn)
    with Bar("demo") as bar:
        outcome = webcam.run(arm, out / "scenario.toml", out, bar.advance)
    sys.stdout.write(webcam.summary(outcome, out))
    return 0


def _two_arms(given: argparse.Namespace) -> int:
    """Calibrate a mock pair where its tips touch."""
    from procedures.demo import two_arms
    from procedures.demo.two_arms import findings, write_page

    for name in ("realtime", "effect", "joint", "boards"):
        if getattr(given, name):
            raise CalibrationError(
                f"--{name} is not for `armwright demo two-arms`, which runs a cell on the stepped clock"
            )
    if given.has_arm:
        raise CalibrationError("--arm is not for `armwright demo two-arms`: its arms are those of --cell")
    cell = load_cell(given.cell or "pair")
    drawn = seeded_scenario(given.scenario or "demo", given.seed, was_homed=False)
    out = free_folder(Path(given.out or "out/demo-two-arms"))
    require_writable(out)
    out.mkdir(parents=True)
    write_whole(out / "scenario.toml", drawn)
    with Bar("demo") as bar:
        outcome = two_arms.run(cell, out / "scenario.toml", out, bar.advance)
    report = write_page(outcome, out)
    sys.stdout.write("\n" + "".join(f"{sentence}\n" for sentence in findings(outcome)))
    sys.stdout.write(f"\n  {'report':<16}{report}\n")
    sys.stdout.write("".join(f"  {name:<16}{path}\n" for name, path in outcome.files.items()))
    return 0


_DEMOS: dict[str, tuple[Conduct, str, str]] = {
    "job": (_job, "out/demo", "demo"),
    "paper": (_paper, "out/demo-paper", "paper"),
}
