"""`armwright plan-path`: a path or stops with the least expected tip error, by what is known of the arm."""

import argparse
from pathlib import Path

import numpy as np

from calib.arm_problem.assembly import Choice
from calib.errors import CalibrationError
from calib.planning.files import RESULTS, Plan, plan_json, sentences, write_plan
from calib.planning.search import Freedom, StopsPlan, planned_path, planned_stops
from calib.points.arm_points import base_points_for
from calib.results import input_file, made_today
from calib.trust.prediction import Path as TaskPath
from calib.trust.prediction import Predictor, Reliability, reliability_of
from calib.trust.trust import MapRequest, trust_in
from console.commands.calibration.options import board_frames, length_m
from console.commands.progress import Bar, answer, warn
from control.model.description import load_arm
from control.motion.waypoints import read_waypoints
from procedures.folders import require_new

PREDICTED = 0.4  # of the work is the prediction, the rest the search
FARTHEST_m = 1.0  # that work is moved; more is a number in mm


def run(given: argparse.Namespace) -> int:
    """Read, plan, write. Nothing is written before all input has been read and checked; nothing moves."""
    arm, out = load_arm(given.arm), Path(given.out)
    require_new(out, RESULTS)
    freedom, wanted_m = _freedom(given), length_m(given.tolerance, "--tolerance")
    waypoints = read_waypoints(given.file)
    points, warnings = base_points_for(
        arm, [Path(name) for name in given.points], "plan-path", given.as_given
    )
    request = MapRequest(
        (freedom.payload_kg,), is_checked=False, choice=Choice(boards=board_frames(given.boards))
    )
    plan: Plan
    with Bar("plan-path") as bar:
        trust = trust_in(arm, points, request, lambda what, done: bar.advance(what, PREDICTED * done))
        planner = planned_stops if given.stops else planned_path
        plan = planner(
            arm,
            trust.predictor,
            waypoints,
            freedom,
            lambda what, done: bar.advance(what, PREDICTED + (1.0 - PREDICTED) * done),
        )
    warn((*warnings, *trust.warnings))
    tasks = None if wanted_m is None else _tasks(trust.predictor, plan, wanted_m)
    points_files = (input_file(Path(name), "points") for name in given.points)
    write_plan(out, plan, tasks, made_today(input_file(Path(given.file), "way-points"), *points_files))
    run_it = f"run it           armwright script {out / 'script.txt'}"
    answer(given, plan_json(plan, tasks), "\n".join((*sentences(plan, tasks), "", run_it)))
    return 0


def _freedom(given: argparse.Namespace) -> Freedom:
    x, y, z = given.shift or (0.0, 0.0, 0.0)
    if not all(0.0 <= half <= FARTHEST_m for half in (x, y, z)):
        raise CalibrationError(
            f"--shift: expected 0 to {FARTHEST_m:g} m along x, y and z, got {x:g} {y:g} {z:g}"
        )
    payload_kg = given.payload or 0.0
    if payload_kg < 0.0:
        raise CalibrationError(f"--payload: expected a mass not below 0, got {payload_kg:g} kg")
    return Freedom((x, y, z), given.any_order, payload_kg)


def _tasks(predictor: Predictor, plan: Plan, wanted_m: float) -> tuple[Reliability, Reliability]:
    """The probability that all of it is kept, as given and as planned."""
    if isinstance(plan, StopsPlan):
        given, planned = (
            TaskPath(np.arange(float(len(way.poses))), way.poses) for way in (plan.plain, plan.chosen)
        )
    else:
        given, planned = plan.plain.motion, plan.chosen.motion
    return reliability_of(predictor, given, wanted_m), reliability_of(predictor, planned, wanted_m)
