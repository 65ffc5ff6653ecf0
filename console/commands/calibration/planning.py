"""`armwright plan-poses`: chooses the next points, tilts and free poses by their information.
`armwright plan-path`: a path or stops with the least expected tip error, by what is known of the arm.
`armwright plan-contacts`: which contacts of two arms of a cell say most about both.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from calib import task_files as path_files
from calib.arm_problem.assembly import Choice
from calib.closed_chain.pair_problem import DISTANCE_MOST_m
from calib.closed_chain.planning import pair_of, plan_contacts, plan_text, write_contacts
from calib.design.candidates import CameraBox
from calib.design.information import NAMES, Uncertainty
from calib.design.plan import Plan, in_words, known_to, plan_json, write_plan
from calib.design.planning import Request, plan_poses
from calib.errors import CalibrationError
from calib.points.points import Points, base_points_for
from calib.results import input_file, made_today
from calib.task_planning import Freedom, StopsPlan, planned_path, planned_stops
from calib.trust.prediction import Path as TaskPath
from calib.trust.prediction import Predictor, Reliability, reliability_of
from calib.trust.trust import MapRequest, trust_in
from console.commands.calibration.options import board_frames, length_m, orientation_noise_rad, quantity
from console.commands.progress import Bar, answer, say, to_type, warn
from control.model.arm import Arm
from control.model.cell import load_cell
from control.model.description import load_arm
from control.motion.waypoints import read_waypoints
from control.plain_text import aligned
from procedures.folders import require_new, require_writable

USUAL_COUNT = 12


def run_plan_poses(args: argparse.Namespace) -> int:
    """Plan, print the plan, write plan.csv and plan.json."""
    arm = load_arm(args.arm)
    if args.out:
        require_writable(Path(args.out))
    recorded = _taken(args, arm)
    choice = Choice(boards=board_frames(args.boards))
    plan = plan_poses(arm, recorded, request_of(args), choice)
    answer(args, plan_json(plan, arm.name), described(plan, arm.name))
    if args.out:
        for path in write_plan(Path(args.out), plan, arm.name):
            (sys.stderr if args.json else sys.stdout).write(f"written: {path}\n")
    return 0


def request_of(args: argparse.Namespace) -> Request:
    """The request of the options; `--free N` alone asks for N free poses and nothing else."""
    count = args.count
    if count is None:
        count = USUAL_COUNT if args.free is None else args.free
    if args.free is not None and args.only == "table":
        raise CalibrationError("--free and --only table contradict each other: give one")
    return Request(
        count=count,
        free_count=args.free,
        setups=_setups(args.setups),
        only=args.only,
        criterion=args.criterion,
        noise_m=length_m(args.noise, "--noise"),
        turn_noise_rad=orientation_noise_rad(args.orientation_noise),
        view=_view(args.view),
    )


def _setups(text: str | None) -> tuple[str, ...] | None:
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise CalibrationError(f'--setups: expected names separated by commas, such as normal,roll; got "{text}"')
    return names


def _view(corners_m: list[float] | None) -> CameraBox | None:
    if corners_m is None:
        return None
    x, y, z = (tuple(corners_m[k : k + 2]) for k in (0, 2, 4))
    for axis, (lower, upper) in zip("xyz", (x, y, z), strict=True):
        if not lower < upper:
            raise CalibrationError(f"--view: expected {axis} from smaller to larger, got {lower:g} {upper:g}")
    return CameraBox((x[0], y[0], z[0]), (x[1], y[1], z[1]))


def _taken(args: argparse.Namespace, arm: Arm) -> Points | None:
    if args.points is None:
        return None
    points, warnings = base_points_for(arm, [Path(args.points)], "plan-poses", args.as_given)
    warn(warnings)
    return points


def described(plan: Plan, arm: str) -> str:
    """The plan as text: candidates, gain of each pose, alternatives, remarks."""
    candidates = ", ".join(f"{count} {setup}" for setup, count in plan.candidates.items())
    head = ("setup", "point", "visit", "log det", "tip mm", "worst mm", *NAMES, "weakest")
    poses = [(pose.setup, pose.point, str(pose.visit), f"+{pose.gain:.2f}", *_figures(pose.after)) for pose in plan.poses]
    others = [(one.setup, str(one.count), "", f"+{one.gain:.2f}", *_figures(one.after)) for one in plan.alternatives]
    return "\n".join(
        [
            f"arm {arm}: {plan.before.points_count} points recorded; candidates: {candidates}; noise"
            f" {1e3 * plan.noise_m:.3g} mm per axis; criterion {plan.criterion}",
            "\n  Poses by value, and the accuracy after each:",
            aligned([head, ("", "", "", "", *_figures(plan.before)), *poses], left=2, indent="  "),
            *(("\n  Best plans of one kind:", aligned(others, left=2, indent="  ")) if others else ()),
            "",
            *in_words(plan),
        ]
    )


def _figures(state: Uncertainty) -> tuple[str, ...]:
    indices = state.indices.as_dict()
    return (
        f"{1e3 * state.tip_m:.3f}",
        f"{1e3 * state.tip_worst_m:.3f}",
        f"{indices['O1']:.1f}",
        f"{indices['O2']:.4f}",
        f"{indices['O3']:.2f}",
        f"{indices['O4']:.3f}",
        f"{indices['O5']:.2f}",
        known_to(state),
    )


PREDICTED = 0.4  # of the work is the prediction, the rest the search
FARTHEST_m = 1.0  # that work is moved; more is a number in mm


def run_plan_path(args: argparse.Namespace) -> int:
    """Read, plan, write. Nothing is written before all input has been read and checked; nothing moves."""
    arm, out = load_arm(args.arm), Path(args.out)
    require_new(out, path_files.RESULTS)
    freedom, wanted_m = _freedom(args), length_m(args.tolerance, "--tolerance")
    waypoints = read_waypoints(args.file)
    points, warnings = base_points_for(arm, [Path(name) for name in args.points], "plan-path", args.as_given)
    request = MapRequest((freedom.payload_kg,), is_checked=False, choice=Choice(boards=board_frames(args.boards)))
    plan: path_files.Plan
    with Bar("plan-path") as bar:
        trust = trust_in(arm, points, request, lambda what, done: bar.advance(what, PREDICTED * done))
        planner = planned_stops if args.stops else planned_path
        plan = planner(
            arm, trust.predictor, waypoints, freedom, lambda what, done: bar.advance(what, PREDICTED + (1.0 - PREDICTED) * done)
        )
    warn((*warnings, *trust.warnings))
    tasks = None if wanted_m is None else _tasks(trust.predictor, plan, wanted_m)
    points_files = (input_file(Path(name), "points") for name in args.points)
    path_files.write_plan(out, plan, tasks, made_today(input_file(Path(args.file), "way-points"), *points_files))
    run_it = f"run it           {to_type('script', out / 'script.txt')}"
    answer(args, path_files.plan_json(plan, tasks), "\n".join((*path_files.sentences(plan, tasks), "", run_it)))
    return 0


def _freedom(args: argparse.Namespace) -> Freedom:
    x, y, z = args.shift or (0.0, 0.0, 0.0)
    if not all(0.0 <= half <= FARTHEST_m for half in (x, y, z)):
        raise CalibrationError(f"--shift: expected 0 to {FARTHEST_m:g} m along x, y and z, got {x:g} {y:g} {z:g}")
    payload_kg = args.payload or 0.0
    if payload_kg < 0.0:
        raise CalibrationError(f"--payload: expected a mass not below 0, got {payload_kg:g} kg")
    return Freedom((x, y, z), args.any_order, payload_kg)


def _tasks(predictor: Predictor, plan: path_files.Plan, wanted_m: float) -> tuple[Reliability, Reliability]:
    """The probability that all of it is kept, as given and as planned."""
    if isinstance(plan, StopsPlan):
        plain, planned = (TaskPath(np.arange(float(len(way.poses))), way.poses) for way in (plan.plain, plan.chosen))
    else:
        plain, planned = plan.plain.motion, plan.chosen.motion
    return reliability_of(predictor, plain, wanted_m), reliability_of(predictor, planned, wanted_m)


def run_plan_contacts(args: argparse.Namespace) -> int:
    """Plan, print what the contacts determine, write contacts.csv."""
    cell = load_cell(args.cell)
    names, distances_m = pair_of(cell, args.arms), _distances(args.distance or ["0mm"])
    if args.count < 1:
        raise CalibrationError(f"--count: expected a number of contacts from 1 on, got {args.count}")
    out = Path(args.out) if args.out else None
    if out is not None:
        require_new(out.parent, [out.name])
    plan = plan_contacts(cell, names, distances_m, args.count)
    sys.stdout.write(plan_text(plan))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_contacts(out, plan.chosen.contacts)
        say(f"written: {out}")
    return 0


def _distances(texts: list[str]) -> list[float]:
    distances_m = [quantity(text, "m", "--distance") for text in texts]
    for text, distance_m in zip(texts, distances_m, strict=True):
        if not 0.0 <= distance_m <= DISTANCE_MOST_m:
            raise CalibrationError(f"--distance: expected 0 to {DISTANCE_MOST_m:g} m, got {text}")
    return distances_m
