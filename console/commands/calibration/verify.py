"""`armwright verify`: compares the calibrated arm with the nominal one at points that calibration did not use."""

import argparse
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from calib.arm_problem.assembly import with_own_base, without_base
from calib.distances import WireKnowledge
from calib.errors import CalibrationError
from calib.report.report import Verification
from calib.validation.verify import comparison_text
from console.commands.calibration.options import wires_at
from console.commands.connection import in_control_of
from console.commands.progress import Bar, answer, to_type
from control.errors import ArmError
from control.files import write_whole
from control.model import table as tables
from control.model.arm import Arm
from control.model.description import load_arm
from control.server.client import ArmClient
from procedures.folders import require_empty
from procedures.ports import camera_said
from procedures.survey import Model, ModelPair, Programme, active_model, nominal_of, places, wait_until_recorded, ways
from procedures.verify import SurveyPair, driven, on_recorded, write

REAL_SPEED = 0.5  # of a real arm's joint limits


@dataclass(frozen=True, slots=True)
class ArmAtHold:
    """A homed and holding arm: the model of its runtime, and the function that ends its use (returns the recording)."""

    client: ArmClient
    runtime_model: Model
    speed: float
    end: Callable[[], Path]


def run(args: argparse.Namespace) -> int:
    """Verify; exit status 1 if the calibrated arm is significantly worse, all points are its own, or the arm could not go on."""
    calibrated = load_arm(args.arm)
    pair = ModelPair(Model(nominal_of(calibrated, args.against)), Model(calibrated))
    out = Path(args.out)
    require_empty(out)
    if args.points is not None:
        pair = _framed(pair, args)
        wires = WireKnowledge(args.free_zero, wires_at(args.wire_at or []))
        recorded = on_recorded(pair, Path(args.points), wires, args.as_given)
        return _finish(args, recorded, out)
    if args.free_zero or args.wire_at:
        raise ArmError("--wire-at and --free-zero are for lengths: give them with --points")
    if args.free or args.fix:
        raise ArmError("--free and --fix say where recorded tips were measured: give them with --points")
    programme = _programme(args, calibrated)
    drive = SurveyPair.planned(pair, programme, out)
    with ExitStack() as stack:
        bench = _mock(args, pair, out, stack) if args.mock else _real(args, pair)
        out.mkdir(parents=True, exist_ok=True)
        try:
            with Bar("verify") as bar:
                drive.run(bench.runtime_model, bench.client, bench.speed, bar.advance)
            recording = bench.end()
            verification = driven(pair, drive, *drive.results(recording, out))
        except (ArmError, CalibrationError) as error:  # something has moved: not the exit status 2 of wrong input
            sys.stderr.write(f"armwright: {error}\n  the measurements are in {out}\n")
            return 1
    return _finish(args, verification, out)


def _framed(pair: ModelPair, args: argparse.Namespace) -> ModelPair:
    """Both models as if their files said of the tips' frame what the options say."""
    if args.free and args.fix:
        raise ArmError("the base frame cannot be both fixed and free: omit one of the two")
    said = without_base if args.free else with_own_base if args.fix else None
    return pair if said is None else ModelPair(*(Model(said(one.arm)) for one in (pair.nominal, pair.calibrated)))


def _programme(args: argparse.Namespace, arm: Arm) -> Programme:
    """Points and paths above the table."""
    table = tables.table_of(arm)
    setups = tuple(dict.fromkeys(args.setups))
    if args.repeats < 1:
        raise ArmError(f"--repeats: expected 1 or more, got {args.repeats}")
    wanted = ways(table, setups, args.height)
    return Programme(places(table, setups, args.height), wanted, args.repeats, args.path_speed)


def _real(args: argparse.Namespace, pair: ModelPair) -> ArmAtHold:
    """The bench of a running runtime. ArmError if it is not homed and holding; nothing moves."""
    client = in_control_of(args, pair.calibrated.arm, pair.nominal.arm)
    status = client.status()
    if status["mode"] != "HOLDING":
        raise ArmError(f"the arm is {status['mode']}: run `armwright enable` and `armwright home` first")
    runtime_model = active_model(status, pair)
    if not pair.calibrated.has_gears_of(runtime_model):
        raise ArmError(
            f"{pair.calibrated.arm.path} contains effects between encoders and joints that the runtime does not"
            f" correct: start `{to_type('serve', '--arm', pair.calibrated.arm.path)}`"
        )
    if status["camera_m"] is None:
        raise ArmError(f"no tip from the camera{camera_said(client)}: verification needs it (docs/camera.md)")
    recording = Path(status["recording"])
    if not recording.is_file():
        raise ArmError(f"{recording}: not found; run this command in the folder where `armwright serve` was started")

    def end() -> Path:
        wait_until_recorded(recording, float(client.status()["t_s"]), client.wait)
        return recording

    return ArmAtHold(client, runtime_model, REAL_SPEED, end)


def _mock(args: argparse.Namespace, pair: ModelPair, out: Path, stack: ExitStack) -> ArmAtHold:
    """A homed, stepped mock of the nominal arm with the scenario's hidden errors; its runtime uses the calibrated arm."""
    from procedures.mock import (
        SteppedBench,  # imports MuJoCo, which takes a second
        seeded_scenario,
    )

    nominal = pair.nominal.arm
    text = seeded_scenario(args.scenario, None, was_homed=not nominal.can_home)
    out.mkdir(parents=True)
    scenario = out / "scenario.toml"
    write_whole(scenario, text)
    bench = SteppedBench(nominal, scenario, out / "log")
    stack.callback(bench.close)
    client = bench.start(pair.calibrated.arm)
    client.enable()
    client.home()
    return ArmAtHold(client, pair.calibrated, bench.speed, bench.stop)


def _finish(args: argparse.Namespace, verification: Verification, out: Path) -> int:
    write(verification, out)
    warnings = (f"note: {line}" for line in verification.warnings)
    text = "\n".join((comparison_text(verification.comparison), "", *verification.verdict, *warnings))
    files = {"report": out / "report.html", "figures": out / "verify.json"}
    answer(args, files["figures"], text, files)
    return 1 if verification.is_worse or verification.verifies_nothing else 0
