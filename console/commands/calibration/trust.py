"""`armwright trust`: the tip's predicted error over the workspace, and whether a path keeps a tolerance."""

import argparse
import hashlib
from importlib.metadata import version
from pathlib import Path

from calib.arm_problem.assembly import Choice
from calib.errors import CalibrationError
from calib.points.points import Points, base_points_for, points_for
from calib.results import InputFile, input_file, made_today, write_json
from calib.studies import ChunkStore, executor, run_study
from calib.tolerances.making import TolerancesFile, as_designed, own_tolerances, parse_tolerances, tolerances_text
from calib.tolerances.result import FORMAT as TOLERANCES
from calib.tolerances.result import as_text as tolerances_words
from calib.tolerances.result import made_json, made_of, tolerances_report, warnings_about
from calib.tolerances.result import write_map as write_tolerances_map
from calib.tolerances.study import StudyDesign, design_of, require_near, study_task
from calib.trust.prediction import planned, reliability_of
from calib.trust.report import FORMAT, PoseFigures, as_text, pose_figures, trust_json, trust_report, write_map
from calib.trust.trust import MapRequest, Trust, trust_in
from console.commands.calibration.options import board_frames, length_m
from console.commands.progress import Bar, answer, warn
from control.files import write_whole
from control.model.arm import Arm
from control.model.description import arm_text, load_arm
from control.motion.waypoints import read_waypoints
from procedures.folders import require_new

RESULTS = ("trust.json", "map.npz", "report.html")


def run(args: argparse.Namespace) -> int:
    """Read, predict, write. Nothing is written before all input has been read and checked."""
    if args.design is not None:
        return study_design(args)
    _require_points(args)
    arm, out = load_arm(args.arm), Path(args.out)
    require_new(out, RESULTS)
    request = _request(args)
    points, warnings = base_points_for(arm, [Path(name) for name in args.points], "trust", args.as_given)
    paths = [planned(arm, read_waypoints(file), request.payloads_kg[0]) for file in args.task or []]
    programmes = [(name, points_for(arm, [Path(name)], args.as_given)[0]) for name in args.visits or []]
    with Bar("trust") as bar:
        trust = trust_in(arm, points, request, bar.advance)
    warn((*warnings, *trust.warnings))
    tasks = tuple(reliability_of(trust.predictor, path, request.tolerance_m or 0.0) for path in paths)
    poses = tuple(_pose_figures(trust, Path(name), recorded) for name, recorded in programmes)
    visited = tuple(one for found in poses for one in found)
    made = made_today(*(input_file(Path(name), "points") for name in args.points))
    files = {"report": out / "report.html", "for programs": out / "trust.json", "map": out / "map.npz"}
    write_whole(files["report"], trust_report(trust, tasks, visited, made))
    write_map(files["map"], trust)
    content = trust_json(trust, tasks, visited)
    write_json(files["for programs"], made.heading(FORMAT, arm=arm.name) | content)
    answer(args, content, as_text(trust, tasks, visited), files)
    return 0


def _require_points(args: argparse.Namespace) -> None:
    if not args.points:
        raise CalibrationError(
            "--points: give points.csv of the real arm; or --design, an arm.toml with [tolerances], for an arm that is not built"
        )
    for name in OPTIONS:
        if getattr(args, name) is not None:
            raise CalibrationError(f"--{name}: belongs to --design, the arm.toml of an arm that is not built")


def _request(args: argparse.Namespace) -> MapRequest:
    wanted_m = length_m(args.tolerance, "--tolerance")
    if args.task and wanted_m is None:
        raise CalibrationError("--task: give the --tolerance that the path shall keep, such as 0.5mm")
    payloads_kg = tuple(args.payload or (0.0,))
    if min(payloads_kg) < 0.0:
        raise CalibrationError(f"--payload: expected a mass not below 0, got {min(payloads_kg):g} kg")
    return MapRequest(payloads_kg, wanted_m, choice=Choice(boards=board_frames(args.boards)))


def _pose_figures(trust: Trust, file: Path, recorded: Points) -> tuple[PoseFigures, ...]:
    """Of a recorded programme; CalibrationError if it has no plain poses."""
    figures = pose_figures(trust.predictor, trust.arm, recorded, file)
    if not figures:
        raise CalibrationError(
            f"--visits {file}: no visits of poses (setup pose, P1 to P5): record them with `armwright iso9283`"
        )
    return figures


OPTIONS = ("tolerances", "arms", "seed", "workers", "cluster")
NOT_OURS = ("task", "visits", "boards")
DESIGN_RESULTS = ("tolerances.json", "map.npz", "report.html")
CHUNKS = "unfinished"  # results of tasks, in --out until the study ends
ARMS = 2000
ARMS_LEAST, ARMS_MOST = (20, 10_000_000)  # below: no percentiles; above: the result of each arm no longer fits in memory


def study_design(args: argparse.Namespace) -> int:
    """Read, draw arms, write. A study that was stopped goes on where it was."""
    _require_ours(args)
    arm, out = load_arm(args.design), Path(args.out)
    require_new(out, DESIGN_RESULTS)
    wanted_m, inputs = length_m(args.tolerance, "--tolerance"), {Path(args.design).name: _hash(arm_text(arm))}
    if args.tolerances is None:
        tolerances, arm = own_tolerances(arm), as_designed(arm)
    else:
        text = tolerances_text(args.tolerances)
        tolerances = parse_tolerances(text, args.tolerances, arm)
        inputs[Path(args.tolerances).name] = _hash(text)
    design = _design(args, arm, tolerances)
    require_near(design, args.tolerances or args.design)
    warnings = warnings_about(design)
    with executor(design.tasks, args.workers, args.cluster) as runs, Bar("arms") as bar:
        store = ChunkStore(out / CHUNKS, _about(design, inputs))
        run_study(study_task, design, design.tasks, runs, store, bar.advance)
    made = made_of(design, store)
    warn(warnings)
    provenance = made_today(*(InputFile(name, digest, "") for name, digest in inputs.items()))
    files = {"report": out / "report.html", "for programs": out / "tolerances.json", "map": out / "map.npz"}
    write_whole(files["report"], tolerances_report(made, wanted_m, warnings, provenance))
    write_tolerances_map(files["map"], made)
    content = made_json(made, wanted_m)
    write_json(files["for programs"], provenance.heading(TOLERANCES, arm=arm.name) | content)
    store.remove()
    answer(args, content, tolerances_words(made, wanted_m), files)
    return 0


def _require_ours(args: argparse.Namespace) -> None:
    for name in NOT_OURS:
        if getattr(args, name):
            raise CalibrationError(f"--{name}: needs --points of the real arm, and no --design")
    if args.payload is not None and len(args.payload) > 1:
        raise CalibrationError("--payload: with --design, expected one mass")
    if args.arms is not None and not ARMS_LEAST <= args.arms <= ARMS_MOST:
        raise CalibrationError(f"--arms: expected {ARMS_LEAST} to {ARMS_MOST}, got {args.arms}")
    if args.seed is not None and args.seed < 0:
        raise CalibrationError(f"--seed: expected 0 or more, got {args.seed}")


def _design(args: argparse.Namespace, arm: Arm, tolerances: TolerancesFile) -> StudyDesign:
    (payload_kg,) = args.payload or (0.0,)
    if payload_kg < 0.0:
        raise CalibrationError(f"--payload: expected a mass not below 0, got {payload_kg:g} kg")
    recorded_q = points_for(arm, [Path(name) for name in args.points])[0].q_rad if args.points else None
    return design_of(arm, tolerances, args.arms or ARMS, payload_kg, recorded_q, args.seed or 0)


def _about(design: StudyDesign, inputs: dict[str, str]) -> dict[str, object]:
    """Everything that the results of the tasks depend on."""
    poses = [_hash(repr((at.q_rad.tolist(), at.payload_kg.tolist()))) for at in (design.calibration, design.map)]
    return {
        "program_version": version("armwright"),
        "inputs": inputs,
        "poses": poses,
        "arms": design.arms_count,
        "seed": design.seed,
    }


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
