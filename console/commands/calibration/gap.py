"""`armwright gap`: finds the effects that the model lacks, and writes the corrected model."""

import argparse
import contextlib
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from calib.errors import CalibrationError
from calib.gap.finding import gap_content
from calib.gap.report import GapOutcome
from calib.gap.words import in_words
from calib.gap.workflow import find_gap_in, read_recordings, require_effects, require_free, write_gap
from calib.history import quantities_of
from console.commands.calibration.options import record_of
from console.commands.connection import in_control_of
from console.commands.progress import Bar, answer, say, to_type, warn
from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.folders import require_writable

if TYPE_CHECKING:
    from calib.gap.plan.plan import RecordingPlan

REAL_SPEED = 0.5  # of a real arm's joint limits, between poses
MOCK_PAYLOAD_kg = 0.5
MOTION_SHARE = 0.8  # of the mass that the motors move: friction and the controller take the rest
MINUTES_MOST = 600.0


def run(args: argparse.Namespace) -> int:
    """Record if requested, analyse, write. Nothing is written before all input has been read and checked."""
    arm, without = load_arm(args.arm), tuple(args.without or ())
    require_effects(without)
    record_of(args, "gap", arm.name)
    if not args.plan_only:
        require_free(Path(args.out))
        require_writable(Path(args.out))
    if args.record:
        return _record(args, arm, without)
    for name in ("mock", "plan_only", "record_only", "quick", "minutes", "payload", "only", "scenario", "seed"):
        if getattr(args, name) is not None and getattr(args, name) is not False:
            raise CalibrationError(f"--{name.replace('_', '-')} needs --record")
    return _look(args, arm, args.points or [], args.log or [], without)


def _look(args: argparse.Namespace, arm: Arm, points: list[str], logs: list[str], without: tuple[str, ...]) -> int:
    record, out = record_of(args, "gap", arm.name), Path(args.out)
    recordings = read_recordings(arm, points, logs, args.current_unit, args.as_given)
    with Bar("gap") as bar:
        outcome = find_gap_in(arm, recordings, without, bar.advance, args.map)
    model = write_gap(outcome, arm, recordings, out)
    if record is not None and model.calibration is not None:
        record.append(model.calibration.inputs, quantities=quantities_of(outcome.finding))
    _say(args, outcome, out, bool(points))
    return 0


def _say(args: argparse.Namespace, outcome: GapOutcome, out: Path, has_points: bool) -> None:
    warn(outcome.warnings)
    files = {"report": out / "report.html", "model": out / "arm.toml"}
    answer(args, gap_content(outcome.finding), "\n".join(in_words(outcome.finding)), files)
    if has_points and not args.json:
        line = to_type("verify", "--arm", out / "arm.toml", "--against", args.arm, "--points", "OTHERS.csv")
        say(f"Next, ask other points whether to use it:\n  {line}")


def _record(args: argparse.Namespace, arm: Arm, without: tuple[str, ...]) -> int:
    """Plan, print the plan, record, and analyse the recordings."""
    from calib.gap.plan import foresight
    from calib.gap.plan.plan import PlanRequest, recording_plan

    _require_recording_options(args)
    payload_kg = _payload_kg(args, arm)
    request = PlanRequest(args.only != "motion", args.only != "static", payload_kg, bool(args.quick), args.minutes)
    plan = recording_plan(arm, request, 1.0 if args.mock else REAL_SPEED)
    if args.plan_only:
        sys.stdout.write("".join(f"{line}\n" for line in foresight.in_words(arm, plan, payload_kg)))
        return 0
    out = Path(args.out)
    said = (foresight.in_short(arm, plan), *(foresight.of_boards(arm) if plan.runs else ()))
    sys.stderr.write("".join(f"{sentence}\n" for sentence in said))
    try:
        recorded(args, arm, plan, out, "record")
    except (ArmError, CalibrationError) as error:
        if not (out / "points.csv").exists():
            raise
        sys.stderr.write(f"armwright: {error}\n")
        return 1  # the arm has moved: not the exit status 2 of wrong input
    points = [str(out / "points.csv")] if plan.visits else []
    logs = [str(out / "log.csv")] if plan.runs else []
    if args.record_only:
        sys.stdout.write("".join(f"recorded  {name}\n" for name in (*points, *logs)))
        return 0
    return _look(args, arm, points, logs, without)


def _payload_kg(args: argparse.Namespace, arm: Arm) -> float:
    """The mass to record with. CalibrationError for one that the motors do not move at the acceleration limits."""
    from procedures.arm_sheet import sheet

    held = sheet(arm).payload if args.mock or args.payload else None
    most_kg = math.inf if held is None else held.moving_kg
    if args.payload is None:
        return min(MOCK_PAYLOAD_kg, round(MOTION_SHARE * most_kg, 3)) if args.mock else 0.0
    if args.payload > most_kg:
        raise CalibrationError(
            f"--payload: {args.payload:g} kg, and the motors move {most_kg:.2f} kg (`armwright arm`): take less"
        )
    return float(args.payload)


def _require_recording_options(args: argparse.Namespace) -> None:
    """CalibrationError for options that contradict each other."""
    if args.points or args.log:
        raise CalibrationError("--record makes its own recordings: omit --points and --log")
    if args.minutes is not None and not 0.0 < args.minutes <= MINUTES_MOST:
        raise CalibrationError(f"--minutes: expected a number above 0 and up to {MINUTES_MOST:g}, got {args.minutes:g}")
    if args.payload is not None and not 0.0 <= args.payload <= 20.0:
        raise CalibrationError(f"--payload: expected a mass from 0 to 20 kg, got {args.payload:g}")
    if (args.scenario or args.seed is not None) and not args.mock:
        raise CalibrationError("--scenario and --seed need --mock")


def record_on_arm(args: argparse.Namespace, arm: Arm, plan: "RecordingPlan", out: Path) -> None:
    """Record on the connected arm, which must be homed and holding."""
    from procedures.gap_recording import record
    from procedures.tour import bench_of

    with contextlib.closing(in_control_of(args, arm)) as client:
        loads_kg = [step.payload_kg for step in plan.steps]
        bench = bench_of(client, loads_kg, bool(plan.visits), REAL_SPEED)
        try:
            with Bar("record") as bar:
                record(arm, bench, plan, out, bar.advance)
        except KeyboardInterrupt:
            client.stop()
            raise


def recorded(args: argparse.Namespace, arm: Arm, plan: "RecordingPlan", out: Path, what: str) -> None:
    """Record on the arm, or on a mock of it; where it ends early, the operator is told how it goes on."""
    from procedures.tour import telling_where

    with telling_where(out):
        if not args.mock:
            record_on_arm(args, arm, plan, out)
            return
        from procedures.gap_recording import note, record
        from procedures.mock import saved_mock

        note(out, plan, arm)
        with Bar(what) as bar:
            bar.advance("homing", 0.0)
            with saved_mock(arm, args.scenario or "demo", args.seed, out) as bench:
                record(arm, bench, plan, out, bar.advance)
