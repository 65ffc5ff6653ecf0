"""`armwright demo`: the full workflow on a mock arm, the paper's experiment, the gap workflow, a webcam, or two arms.
`armwright mock`: a mock arm, or a mock cell, in real time, until Ctrl-C.
`armwright drill`: one named fault on a mock arm, one in all its situations, or all of them, and what the arm did.
"""

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

from calib.errors import CalibrationError
from console.commands.progress import Bar, say, to_type
from control.errors import ArmError
from control.files import write_whole
from control.model.arm import Arm
from control.model.cell import load_cell, save_cell
from control.model.description import load_arm, save_arm
from control.plain_text import Advance, aligned
from hil_mocks.firmware import choose
from hil_mocks.rig import MockProcess, RealTimeCell, RealTimeRig
from procedures.demo import job
from procedures.drills.catalogue import drills, drills_named
from procedures.drills.drill import header, in_words, listing, row, verdict
from procedures.folders import free_folder, require_writable
from procedures.mock import MockBench, RealTimeBench, SteppedBench, seeded_scenario, wired_to
from procedures.on_boards import on_boards

GAP_SEED = 1  # seed of the hidden effect of `demo gap`
ONLY = {"cell": "two-arms", "effect": "gap", "joint": "gap", "boards": "job"}
NOT = {"realtime": ("gap", "camera", "two-arms"), "scenario": ("gap",), "has_arm": ("two-arms",)}


def run_demo(args: argparse.Namespace) -> int:
    """Run the demo and print its results."""
    for name, demo in ONLY.items():
        if getattr(args, name) is not None and args.what != demo:
            raise CalibrationError(f"--{name} is only for `armwright demo {demo}`")
    for name, demos in NOT.items():
        if getattr(args, name) and args.what in demos:
            raise CalibrationError(f"--{name.removeprefix('has_')} is not for `armwright demo {args.what}`, which has its own")
    return {"gap": _gap, "camera": _camera, "two-arms": _two_arms}.get(args.what, _on_the_table)(args)


def _folder(args: argparse.Namespace, usual: str, scenario: bytes) -> Path:
    """The folder for the results, with the mock's scenario in it."""
    out = free_folder(Path(args.out or usual))
    require_writable(out)
    out.mkdir(parents=True)
    write_whole(out / "scenario.toml", scenario)
    return out


def _say(sentences: Sequence[str], files: Mapping[str, object]) -> None:
    where = aligned([(what, str(file)) for what, file in files.items()], left=2, indent="  ")
    say("\n".join(("", *sentences, "", where)))


def _on_the_table(args: argparse.Namespace) -> int:
    """The full workflow, or the paper's experiment: home, move, record the table, calibrate, verify, report."""
    conduct, usual, scenario = (_paper, "out/demo-paper", "paper") if args.what == "paper" else (_job, "out/demo", "demo")
    arm, file = load_arm(args.arm), args.arm
    if args.boards is not None:
        arm = on_boards(arm, args.boards)
    drawn = seeded_scenario(args.scenario or scenario, args.seed, was_homed=not arm.can_home)
    out = _folder(args, usual, drawn)
    if args.boards is not None:
        file = out / "arm.toml"
        save_arm(arm, file)
        arm = load_arm(str(file))
    hidden, log = out / "scenario.toml", out / "log"
    bench: MockBench = RealTimeBench(file, hidden, log) if args.realtime else SteppedBench(arm, hidden, log)
    with closing(bench), Bar("demo") as bar:
        conduct(arm, bench, out, bar.advance)
    return 0


def _job(arm: Arm, bench: MockBench, out: Path, advance: Advance) -> None:
    from calib.validation.verify import comparison_text

    outcome = job.run(arm, bench, out, advance)
    comparison = comparison_text(outcome.verification)
    write_whole(out / "verification.txt", comparison + "\n")
    count = len(outcome.verification.point)
    files = {
        "report": outcome.report,
        "calibrated arm": outcome.calibrated_arm,
        "points": out / "points.csv",
        "recordings": out / "log",
    }
    _say((f"Tip error at {count} verification points that calibration did not use:", "", comparison), files)


def _paper(arm: Arm, bench: MockBench, out: Path, advance: Advance) -> None:
    """The experiment of SpringerPlus 5:1771, and two further steps."""
    from procedures.demo import paper
    from procedures.demo.paper_page import findings, table_text, widths_text

    outcome = paper.run(arm, bench, out, advance)
    table = table_text(outcome.replay)
    write_whole(out / "paper.txt", table + "\n")
    head = "Mean tip error at points that calibration did not use, and its reduction (95 %):"
    widths = f"Identified backlash: {widths_text(outcome.replay.models[-1])}."
    files = {"report": outcome.report, "figures": outcome.figures, "points": out / "points.csv"}
    _say((head, "", table, "", *findings(outcome.replay), widths), files)


def _gap(args: argparse.Namespace) -> int:
    """Hide an effect, find it, add it to the model and correct it; exit status 1 if it was not found."""
    from procedures.demo import gap

    seed = args.seed if args.seed is not None else GAP_SEED
    hidden = gap.drawn(seed, args.effect, args.joint)
    arm = gap.with_known_friction(load_arm(args.arm))
    out = _folder(args, "out/demo-gap", gap.beyond_known(hidden, arm).as_scenario("gap", seed).encode())
    scenario = out / "scenario.toml"
    write_whole(scenario, seeded_scenario(str(scenario), seed, was_homed=not arm.can_home))
    save_arm(arm, out / "nominal.toml")
    arm = load_arm(str(out / "nominal.toml"))
    with closing(SteppedBench(arm, scenario, out / "log")) as bench, Bar("demo") as bar:
        circle = gap.run(arm, bench, hidden, out, bar.advance)
    _say(gap.findings(circle), {"report": gap.write_page(circle, out), "model": out / "gap" / "arm.toml"})
    return 0 if circle.is_right else 1


def _camera(args: argparse.Namespace) -> int:
    """Measure a mock arm with a webcam, calibrate it, compare with the truth."""
    from calib.vision.targets import opencv
    from procedures.demo import webcam

    opencv()
    arm = load_arm(args.arm)
    if arm.name != "right":
        raise CalibrationError(f'demo camera: its camera stands before the reference arm; expected --arm right, got "{arm.name}"')
    drawn = seeded_scenario(args.scenario or "demo", args.seed, was_homed=True)
    out = _folder(args, "out/demo-camera", drawn)
    with Bar("demo") as bar:
        outcome = webcam.run(arm, out / "scenario.toml", out, bar.advance)
    files = {
        "pictures": f"{out / 'lens'}, {out / 'arm'}",
        "camera": out / "camera.json",
        "points": out / "points.csv",
        "calibrated arm": out / "arm_calibrated.toml",
    }
    _say(webcam.findings(outcome), files)
    return 0


def _two_arms(args: argparse.Namespace) -> int:
    """Calibrate a mock pair where its tips touch."""
    from procedures.demo import two_arms

    cell = load_cell(args.cell or "pair")
    drawn = seeded_scenario(args.scenario or "demo", args.seed, was_homed=False)
    out = _folder(args, "out/demo-two-arms", drawn)
    with Bar("demo") as bar:
        outcome = two_arms.run(cell, out / "scenario.toml", out, bar.advance)
    _say(two_arms.findings(outcome), {"report": two_arms.write_page(outcome, out), **outcome.files})
    return 0


def run_mock(args: argparse.Namespace) -> int:
    """Start the mock, write files that are wired to it, print how to connect, and wait."""
    choose(args.firmware)
    with tempfile.TemporaryDirectory(prefix="armwright-") as folder:
        if args.cell is not None:
            return _cell(args, Path(folder))
        arm = load_arm(args.arm)
        with RealTimeRig(args.arm, args.scenario) as rig:
            file = Path(folder) / f"{arm.name}.toml"
            save_arm(wired_to(arm, rig), file)
            return _wait(rig, f"A mock of arm {arm.name!r} is", args.scenario, "--arm", file)


def _cell(args: argparse.Namespace, folder: Path) -> int:
    cell = load_cell(args.cell)
    with RealTimeCell(args.cell, args.scenario) as rig:
        wired = cell.with_arms([wired_to(placed.arm, rig.ports[placed.name]) for placed in cell.arms])
        what = f"Mocks of the arms of cell {cell.name!r} ({', '.join(cell.names)}) are"
        return _wait(rig, what, args.scenario, "--cell", save_cell(wired, folder))


def _wait(rig: MockProcess, what: str, scenario: str, option: str, file: Path) -> int:
    line = to_type("serve", option, file)
    say(f"{what} running with scenario {scenario!r}; Ctrl-C ends it. Connect with\n\n  {line}")
    sys.stdout.flush()
    try:
        status = rig.wait_for_end(None)
    except KeyboardInterrupt:
        return 0
    sys.stderr.write(f"armwright: the mock arm's process ended unexpectedly with status {status}\n")
    return 1


def run_drill(args: argparse.Namespace) -> int:
    """Run the drills; exit status 1 if a promise was not kept."""
    if args.list:
        say(listing(drills().values()))
        return 0
    if not args.mock:
        raise ArmError("drills break things on purpose and run on a mock arm only: add --mock")
    choose(args.firmware)
    chosen = list(drills().values()) if args.name is None else drills_named(args.name)
    if len(chosen) == 1:
        outcome = chosen[0].run()
        say(in_words(outcome))
        return 1 if outcome.broken else 0
    outcomes = []
    sys.stdout.write(header() + "\n")
    for drill in chosen:
        outcomes.append(drill.run())
        sys.stdout.write(row(outcomes[-1]) + "\n")
        sys.stdout.flush()
    say(verdict(outcomes))
    return 1 if any(outcome.broken for outcome in outcomes) else 0
