"""`armwright calibrate`: from recorded points to a calibrated arm with its uncertainty.
`armwright calibrate-distances`: an arm from lengths that draw wires, dial gauges or ball bars have measured.
`armwright calibrate-pair`: two arms whose tips touch, from the joint angles of both.
"""

import argparse
import sys
from pathlib import Path

from calib.arm_problem.assembly import Choice
from calib.calibration import (
    Calibrated,
    CalibrationPlan,
    LeaveOut,
    calibrate,
    points_in_base,
    write_calibrated_arm,
    write_calibration_json,
)
from calib.calibration_report import calibration_report, judgement_json, summary_text
from calib.closed_chain.calibrate import calibrate_pair, choose_contacts, pair_text, placed_by, write_pair
from calib.closed_chain.pair_problem import Contacts, PairPlan, PairProblem, names_of, read_contacts
from calib.distance_calibration import DistancePlan, calibrate_with_distances, distances_json, distances_text
from calib.distances import WireKnowledge
from calib.errors import CalibrationError
from calib.export import FORMS, export
from calib.history import geometry_of
from calib.identify.objective import objective_named
from calib.points.points import Points, points_for
from calib.points.writer import write_points
from calib.report.report import write_report
from calib.results import InputFile, input_file, made_today
from console.commands.calibration import options
from console.commands.progress import Bar, answer, warn
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.folders import require_new

ENDINGS = {"urdf": "urdf", "mjcf": "xml", "json": "json"}
BASE_POINTS = "points_base.csv"
RESULTS = ("arm.toml", "calibration.json", "report.html", BASE_POINTS)


def run_calibrate(args: argparse.Namespace) -> int:
    """Read, identify, validate, write. Nothing is written before all input has been read and checked."""
    arm, out, forms = load_arm(args.arm), Path(args.out), _forms(args.export or [])
    require_new(out, (*RESULTS, *(f"arm.{ENDINGS[form]}" for form in forms)))
    record = options.record_of(args, "calibrate", arm.name)
    plan = _plan(args)
    points, warnings = _read(args, arm)
    with Bar("calibrate") as bar:
        made = calibrate(arm, points, plan, bar.advance)
    warn((*warnings, *made.warnings))
    files = _write(args, made, out, forms)
    if record is not None:
        record.append(made_today(*_inputs(args, arm)).hashes, geometry_of(made.problem, made.found))
    answer(args, files["for programs"], summary_text(made), files)
    return 0


def _forms(texts: list[str]) -> list[str]:
    """The requested export formats; CalibrationError for an unknown one."""
    forms = options.names_in(texts)
    for form in forms:
        if form not in FORMS:
            raise CalibrationError(f'--export: expected one or more of {", ".join(FORMS)}, got "{form}"')
    return forms


def _read(args: argparse.Namespace, arm: Arm) -> tuple[Points, tuple[str, ...]]:
    """The points of all files, without those that the operator omits."""
    points, warnings = points_for(arm, [Path(name) for name in args.points], args.as_given)
    if "distance_of" in points.extra:
        raise CalibrationError(
            "the points have lengths (column distance_of): calibrate with `armwright calibrate-distances`, which uses measured"
            " tips, too"
        )
    left_out = _rows_of(points, args.without or [])
    if left_out:
        points = points.chosen([k for k in range(len(points)) if k not in left_out])
    return points, warnings


def _rows_of(points: Points, names: list[str]) -> set[int]:
    """Rows named as SETUP, SETUP:POINT or SETUP:POINT:REPEAT; CalibrationError if there are none."""
    named_rows: set[int] = set()
    for name in names:
        wanted = name.split(":")
        rows = {
            k
            for k, row in enumerate(zip(points.setup, points.point, map(str, points.repeat), strict=True))
            if list(row[: len(wanted)]) == wanted
        }
        if not rows or len(wanted) > 3:
            raise CalibrationError(
                f'--without "{name}": no such pose; expected SETUP, SETUP:POINT or SETUP:POINT:REPEAT, with a setup'
                f" of {', '.join(dict.fromkeys(points.setup))}"
            )
        named_rows |= rows
    return named_rows


def _plan(args: argparse.Namespace) -> CalibrationPlan:
    """The calibration plan of the options."""
    threshold_m = options.quantity(args.huber_threshold, "m", "--huber-threshold") if args.huber_threshold else None
    accuracy_m = options.quantity(args.accuracy, "m", "--accuracy") if args.accuracy else None
    if accuracy_m is not None and accuracy_m <= 0.0:
        raise CalibrationError(f"--accuracy: expected a length above 0, got {args.accuracy}")
    choice = Choice(
        bounds=options.bounds_of(args.bound or []),
        fixed=options.names_in(args.fix or []),
        freed=options.names_in(args.free or []),
        boards=options.board_frames(args.boards),
        effects=tuple(options.names_in(args.effect or [])),
        orientation_noise_rad=options.orientation_noise_rad(args.orientation_noise),
    )
    return CalibrationPlan(
        choice, objective_named(args.objective, threshold_m), accuracy_m, _leave_out(args.leave_out), args.starts, args.seed
    )


def _leave_out(text: str | None) -> LeaveOut:
    if text is None:
        return None
    if text == "setups":
        return "setup"
    if text.isdigit() and int(text) >= 2:
        return int(text)
    raise CalibrationError(f'--leave-out: expected "setups", or k from 2 on for every k-th point, got "{text}"')


def _write(args: argparse.Namespace, made: Calibrated, out: Path, forms: list[str]) -> dict[str, Path]:
    """Write the calibrated arm, calibration.json, report.html and the exports; return the files by kind."""
    provenance = made_today(*_inputs(args, made.nominal))
    files = {"calibrated arm": out / "arm.toml", "for programs": out / "calibration.json"}
    write_calibrated_arm(files["calibrated arm"], made.nominal, made.found, provenance, made.points)
    more = judgement_json(made)
    write_calibration_json(files["for programs"], made.nominal.name, made.found, provenance, more=more)
    in_base = points_in_base(made)
    if in_base is not None:
        files["points in the base frame"] = out / BASE_POINTS
        write_points(files["points in the base frame"], in_base)
    files["report"] = out / "report.html"
    write_report(files["report"], calibration_report(made, provenance))
    for form in forms:
        files[form] = out / f"arm.{ENDINGS[form]}"
        for sentence in export(made.arm, form, files[form]):
            sys.stderr.write(f"armwright: note: {sentence}\n")
    return files


def _inputs(args: argparse.Namespace, arm: Arm) -> tuple[InputFile, ...]:
    """Every file that the result depends on."""
    inputs = [input_file(Path(name), "points: joint angles and tip measurements") for name in args.points]
    if arm.path is not None:
        inputs.append(input_file(arm.path, "the nominal arm"))
    if args.boards is not None:
        inputs.append(input_file(Path(args.boards), "measured board poses"))
    return tuple(inputs)


DISTANCE_RESULTS = ("arm.toml", "calibration.json")


def run_calibrate_distances(args: argparse.Namespace) -> int:
    """Read, identify, write. Nothing is written before all input has been read and checked."""
    arm, out, file = load_arm(args.arm), Path(args.out), Path(args.points)
    require_new(out, DISTANCE_RESULTS)
    choice = Choice(
        bounds=options.bounds_of(args.bound or []),
        fixed=options.names_in(args.fix or []),
        freed=("tool",) if args.free_tool else (),
    )
    plan = DistancePlan(
        choice, WireKnowledge(args.free_zero, options.wires_at(args.wire_at or [])), objective_named(args.objective)
    )
    points, warnings = points_for(arm, [file])
    warn(warnings)
    with Bar("calibrate-distances") as bar:
        made = calibrate_with_distances(arm, points, file, plan, bar.advance)
    files = [out / name for name in DISTANCE_RESULTS]
    nominal = [] if arm.path is None else [input_file(arm.path, "the nominal arm")]
    provenance = made_today(input_file(file, "lengths"), *nominal)
    write_calibrated_arm(files[0], arm, made.found, provenance, points)
    write_calibration_json(files[1], arm.name, made.found, provenance, more=distances_json(made))
    answer(args, files[1], distances_text(made) + "\n" + "".join(f"written: {one}\n" for one in files))
    return 0


NOISE_m = 2e-4  # of a contact, to compare what contacts say with what is known of the arms


def run_calibrate_pair(args: argparse.Namespace) -> int:
    """Read both arms and the contacts, then identify, or choose contacts."""
    arms = (load_arm(args.arms[0]), load_arm(args.arms[1]))
    contacts, warnings = read_contacts(Path(args.contacts), arms)
    warn(warnings)
    plan = _pair_plan(args, arms)
    return (
        _chosen_contacts(args, arms, contacts, plan) if args.choose is not None else _calibrated_pair(args, arms, contacts, plan)
    )


def _pair_plan(args: argparse.Namespace, arms: tuple[Arm, Arm]) -> PairPlan:
    tools = options.names_in(args.free_tool or [])
    for name in tools:
        if name not in names_of(arms):
            raise CalibrationError(f'--free-tool: expected some of {", ".join(names_of(arms))}, got "{name}"')
    bounds = options.bounds_of(args.bound or [])
    if bounds.own:
        raise CalibrationError(f"--bound: expected lengths=... or angles=... of both arms, got {next(iter(bounds.own))}")
    return PairPlan(
        bounds=bounds, fixed=options.names_in(args.fix or []), free_tools=tools, objective=objective_named(args.objective)
    )


def _calibrated_pair(args: argparse.Namespace, arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan) -> int:
    out = Path(args.out)
    require_new(out, [*(f"{name}.toml" for name in names_of(arms)), "pair.json"])
    with Bar("calibrate-pair") as bar:
        identification = calibrate_pair(arms, contacts, plan, bar.advance)
    nominal = [
        input_file(arm.path, "a nominal arm", f"{name}: {arm.path.name}")
        for name, arm in zip(names_of(arms), arms, strict=True)
        if arm.path is not None
    ]
    made = made_today(input_file(Path(args.contacts), "contacts"), *nominal)
    out.mkdir(parents=True, exist_ok=True)
    files = write_pair(out, arms, identification, plan.objective.name, made)
    answer(args, files[-1], pair_text(arms, identification) + "\n" + "".join(f"written: {file}\n" for file in files))
    return 0


def _chosen_contacts(args: argparse.Namespace, arms: tuple[Arm, Arm], contacts: Contacts, plan: PairPlan) -> int:
    """Print the contacts that say most about both arms."""
    if args.choose < 1:
        raise CalibrationError(f"--choose: expected a number of contacts from 1 on, got {args.choose}")
    problem = PairProblem(arms, contacts, placed_by(arms, contacts).base, plan)
    rows = choose_contacts(problem, args.choose, options.length_m(args.noise, "--noise") or NOISE_m)
    sys.stdout.write("".join(f"{contacts.name[row]}\n" for row in rows))
    return 0
