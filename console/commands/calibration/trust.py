"""`armwright trust`: the tip's predicted error over the workspace, and whether a path keeps a tolerance."""

import argparse
import sys
from pathlib import Path

from calib.arm_problem.assembly import Choice
from calib.errors import CalibrationError
from calib.points.arm_points import base_points_for, points_for
from calib.points.points import Points
from calib.results import input_file, json_text, made_today, write_json
from calib.trust.iso9283 import PoseFigures, pose_figures
from calib.trust.prediction import planned, reliability_of
from calib.trust.report import FORMAT, as_text, trust_json, trust_report, write_map
from calib.trust.trust import MapRequest, Trust, trust_in
from console.commands.calibration import trust_design
from console.commands.calibration.options import board_frames
from console.commands.progress import Bar, warn
from console.quantities import length_m
from control.files import write_whole
from control.model.description import load_arm
from control.motion.waypoints import read_waypoints
from procedures.folders import require_new

RESULTS = ("trust.json", "map.npz", "report.html")


def run(given: argparse.Namespace) -> int:
    """Read, predict, write. Nothing is written before all input has been read and checked."""
    if given.design is not None:
        return trust_design.study_design(given)
    _require_points(given)
    arm, out = load_arm(given.arm), Path(given.out)
    require_new(out, RESULTS)
    request = _request(given)
    points, warnings = base_points_for(arm, [Path(name) for name in given.points], "trust", given.as_given)
    paths = [planned(arm, read_waypoints(file), request.payloads_kg[0]) for file in given.task or []]
    programmes = [(name, points_for(arm, [Path(name)], given.as_given)[0]) for name in given.visits or []]
    with Bar("trust") as bar:
        trust = trust_in(arm, points, request, bar.advance)
    warn((*warnings, *trust.warnings))
    tasks = tuple(reliability_of(trust.predictor, path, request.tolerance_m or 0.0) for path in paths)
    poses = tuple(_pose_figures(trust, Path(name), recorded) for name, recorded in programmes)
    visited = tuple(one for found in poses for one in found)
    made = made_today(*(input_file(Path(name), "points") for name in given.points))
    files = {"report": out / "report.html", "for programs": out / "trust.json", "map": out / "map.npz"}
    write_whole(files["report"], trust_report(trust, tasks, visited, made))
    write_map(files["map"], trust)
    content = trust_json(trust, tasks, visited)
    write_json(files["for programs"], made.heading(FORMAT, arm=arm.name) | content)
    if given.json:
        sys.stdout.write(json_text(content))
    else:
        sys.stdout.write(as_text(trust, tasks, visited))
        sys.stdout.write("\n" + "".join(f"{what:<16}{file}\n" for what, file in files.items()))
    return 0


def _require_points(given: argparse.Namespace) -> None:
    if not given.points:
        raise CalibrationError(
            "--points: give points.csv of the real arm; or --design and --tolerances for an arm that is not built"
        )
    for name in trust_design.OPTIONS:
        if getattr(given, name) is not None:
            raise CalibrationError(f"--{name}: belongs to --design, the arm.toml of an arm that is not built")


def _request(given: argparse.Namespace) -> MapRequest:
    wanted_m = length_m(given.tolerance, "--tolerance")
    if given.task and wanted_m is None:
        raise CalibrationError("--task: give the --tolerance that the path shall keep, such as 0.5mm")
    payloads_kg = tuple(given.payload or (0.0,))
    if min(payloads_kg) < 0.0:
        raise CalibrationError(f"--payload: expected a mass not below 0, got {min(payloads_kg):g} kg")
    return MapRequest(payloads_kg, wanted_m, choice=Choice(boards=board_frames(given.boards)))


def _pose_figures(trust: Trust, file: Path, recorded: Points) -> tuple[PoseFigures, ...]:
    """Of a recorded programme; CalibrationError if it has no plain poses."""
    found = pose_figures(trust.predictor, trust.arm, recorded, file)
    if not found:
        raise CalibrationError(
            f"--visits {file}: no visits of poses (setup pose, P1 to P5): record them with `armwright iso9283`"
        )
    return found
