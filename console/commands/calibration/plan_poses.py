"""`armwright plan-poses`: chooses the next points, tilts and free poses by their information."""

import argparse
import sys
from pathlib import Path

from calib.arm_problem.assembly import Choice
from calib.design.candidates import CameraBox
from calib.design.information import NAMES, Uncertainty
from calib.design.planning import Plan, Request, in_words, known_to, plan_json, plan_poses, write_plan
from calib.errors import CalibrationError
from calib.points.arm_points import base_points_for
from calib.points.points import Points
from console.commands.calibration.options import board_frames, length_m, orientation_noise_rad
from console.commands.progress import answer, warn
from control.model.arm import Arm
from control.model.description import load_arm
from control.plain_text import aligned
from procedures.folders import require_writable

USUAL_COUNT = 12


def run(given: argparse.Namespace) -> int:
    """Plan, print the plan, write plan.csv and plan.json."""
    arm = load_arm(given.arm)
    if given.out:
        require_writable(Path(given.out))
    taken = _points(given, arm)
    choice = Choice(boards=board_frames(given.boards))
    plan = plan_poses(arm, taken, request_of(given), choice)
    answer(given, plan_json(plan, arm.name), described(plan, arm.name))
    if given.out:
        for path in write_plan(Path(given.out), plan, arm.name):
            (sys.stderr if given.json else sys.stdout).write(f"written: {path}\n")
    return 0


def request_of(given: argparse.Namespace) -> Request:
    """The request of the options; `--free N` alone asks for N free poses and nothing else."""
    count = given.count
    if count is None:
        count = USUAL_COUNT if given.free is None else given.free
    if given.free is not None and given.only == "table":
        raise CalibrationError("--free and --only table contradict each other: give one")
    return Request(
        count=count,
        free_count=given.free,
        setups=_setups(given.setups),
        only=given.only,
        criterion=given.criterion,
        noise_m=length_m(given.noise, "--noise"),
        turn_noise_rad=orientation_noise_rad(given.orientation_noise),
        view=_view(given.view),
    )


def _setups(text: str | None) -> tuple[str, ...] | None:
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise CalibrationError(
            f'--setups: expected names separated by commas, such as normal,roll; got "{text}"'
        )
    return names


def _view(corners_m: list[float] | None) -> CameraBox | None:
    if corners_m is None:
        return None
    x, y, z = (tuple(corners_m[k : k + 2]) for k in (0, 2, 4))
    for axis, (lower, upper) in zip("xyz", (x, y, z), strict=True):
        if not lower < upper:
            raise CalibrationError(f"--view: expected {axis} from smaller to larger, got {lower:g} {upper:g}")
    return CameraBox((x[0], y[0], z[0]), (x[1], y[1], z[1]))


def _points(given: argparse.Namespace, arm: Arm) -> Points | None:
    if given.points is None:
        return None
    points, warnings = base_points_for(arm, [Path(given.points)], "plan-poses", given.as_given)
    warn(warnings)
    return points


def described(plan: Plan, arm: str) -> str:
    """The plan as text: candidates, gain of each pose, alternatives, remarks."""
    candidates = ", ".join(f"{count} {setup}" for setup, count in plan.candidates.items())
    head = ("setup", "point", "visit", "log det", "tip mm", "worst mm", *NAMES, "weakest")
    poses = [
        (pose.setup, pose.point, str(pose.visit), f"+{pose.gain:.2f}", *_figures(pose.after))
        for pose in plan.poses
    ]
    others = [
        (one.setup, str(one.count), "", f"+{one.gain:.2f}", *_figures(one.after)) for one in plan.alternatives
    ]
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
    found = state.indices.as_dict()
    return (
        f"{1e3 * state.tip_m:.3f}",
        f"{1e3 * state.tip_worst_m:.3f}",
        f"{found['O1']:.1f}",
        f"{found['O2']:.4f}",
        f"{found['O3']:.2f}",
        f"{found['O4']:.3f}",
        f"{found['O5']:.2f}",
        known_to(state),
    )
