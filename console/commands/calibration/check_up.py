"""`armwright check-up`: a few poses that decide between fine, recalibrate, and inspect joint j.
`armwright trend`: what drifts, how fast, and when the next calibration is due.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from calib.arm_problem.checks import require_of_arm
from calib.checkup import POSES, checkup_plan, decide, decision_json, expectation_of, sentences
from calib.errors import CalibrationError
from calib.gap.plan.plan import RecordingPlan
from calib.history import read_history
from calib.points.points import Points, points_for
from calib.results import write_json
from calib.trend import as_text, trend_json, trend_of
from console.commands.calibration.gap import REAL_SPEED, recorded
from console.commands.calibration.options import length_m
from console.commands.progress import answer, warn
from control.errors import ArmError
from control.model.arm import Arm
from control.model.description import load_arm
from procedures.folders import require_new

RESULT = "check-up.json"
POSES_LEAST, POSES_MOST = 3, 40
LEAST_EARLIER = 10  # points: fewer do not say what is usual


def run_check_up(args: argparse.Namespace) -> int:
    """Plan, record, decide. Exit status 0: fine; 1: something is to be done; 2: wrong input."""
    _require_consistent(args)
    arm = load_arm(args.arm)
    if not args.plan_only:
        require_new(Path(args.out), (RESULT,))
    earlier = _measured(arm, args.points, LEAST_EARLIER, args.as_given)
    if args.recorded is not None:
        new = _measured(arm, [args.recorded], POSES_LEAST, args.as_given)
    else:
        plan = checkup_plan(arm, earlier, args.poses or POSES, 1.0 if args.mock else REAL_SPEED)
        if args.plan_only:
            sys.stdout.write(_plan_text(plan))
            return 0
        out = Path(args.out)
        _record(args, arm, plan, out)
        new = _measured(arm, [str(out / "points.csv")], POSES_LEAST, args.as_given)
    decision = decide(expectation_of(arm, earlier, new))
    content = decision_json(decision)
    write_json(Path(args.out) / RESULT, content)
    answer(args, content, "\n".join(sentences(decision)))
    return 0 if decision.action == "fine" and decision.is_sure else 1


def _require_consistent(args: argparse.Namespace) -> None:
    if args.poses is not None and not POSES_LEAST <= args.poses <= POSES_MOST:
        raise CalibrationError(f"--poses: expected {POSES_LEAST} to {POSES_MOST}, got {args.poses}")
    if args.recorded is not None and (args.mock or args.plan_only or args.poses is not None):
        raise CalibrationError("--recorded: nothing moves; omit --mock, --plan-only and --poses")
    if not args.mock and (args.scenario is not None or args.seed is not None):
        raise CalibrationError("--scenario and --seed need --mock")


def _measured(arm: Arm, files: list[str], least: int, is_as_given: bool) -> Points:
    """Points whose tip was measured; CalibrationError if they are too few."""
    points, warnings = points_for(arm, [Path(name) for name in files], is_as_given)
    warn((*warnings, *require_of_arm(arm, points)))
    rows = np.flatnonzero(np.isfinite(points.tip_m).all(axis=1)).tolist()
    if len(rows) < least:
        raise CalibrationError(
            f"{', '.join(files)}: expected at least {least} points with a measured tip (x_m, y_m, z_m), got {len(rows)}"
        )
    return points.chosen(rows)


def _record(args: argparse.Namespace, arm: Arm, plan: RecordingPlan, out: Path) -> None:
    sys.stderr.write(f"{len(plan.visits)} visits, about {plan.duration_s / 60.0:.1f} minutes\n")
    recorded(args, mocked_arm(arm) if args.mock else arm, plan, out, "check-up")


def mocked_arm(arm: Arm) -> Arm:
    """What a mock is made of: the file that a calibrated arm came from, or it would be another robot than was calibrated."""
    if arm.calibration is None:
        return arm
    from procedures.survey import nominal_of

    try:
        return nominal_of(arm, None)
    except ArmError:
        raise CalibrationError(
            f"--mock: a mock is made of the arm that {arm.path} was calibrated from, and {arm.calibration.source} is neither"
            " beside it nor in this folder: put it there, or give --arm the uncalibrated file"
        ) from None


def _plan_text(plan: RecordingPlan) -> str:
    lines = [
        f"{visit.point}: {', '.join(f'{q:.4f}' for q in visit.q_rad)} rad, from {_signs(visit.direction)}"
        for visit in plan.visits
    ]
    return "".join(f"{line}\n" for line in [*lines, f"about {plan.duration_s / 60.0:.1f} minutes"])


def _signs(direction: tuple[int, ...]) -> str:
    return "".join("+" if one > 0 else "-" for one in direction)


def run_trend(args: argparse.Namespace) -> int:
    """Read the record and print."""
    arm, wanted_m = load_arm(args.arm), length_m(args.tolerance, "--tolerance")
    trend = trend_of(arm, read_history(Path(args.history), arm.name), wanted_m)
    answer(args, trend_json(trend), as_text(trend))
    return 0
