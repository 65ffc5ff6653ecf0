"""The whole calibration, from points to a validated result. Nothing here reads or writes a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from calib.arm_problem.assembly import BASE, CAMERA, Choice, followed, problem_of, with_own_base
from calib.arm_problem.checks import require_usable, still_joints
from calib.arm_problem.joint_effects import LAWS, effect_key, impossible, unclear_flanks, unphysical
from calib.arm_problem.problem import ArmProblem
from calib.arm_problem.weighted import usual_noise_m
from calib.arrays import Array, Mask, frozen
from calib.calibration.outcome import calibrated_arm
from calib.errors import CalibrationError
from calib.identify.identification import Identification, identify
from calib.identify.objective import Objective, SumOfDistances
from calib.identify.suspects import Suspects, find_suspects
from calib.identify.tilted_axes import tilted_axes
from calib.points.points import Points, matrices_of, triangles
from calib.settling import FITS_MOST, Settling
from calib.validation.holdout import HeldOut, Prediction, held_out
from calib.validation.verdict import NoiseFloor, Verdict, noise_floor, verdict
from control.kinematics.rotation import matrices, quaternions
from control.model.arm import Arm
from control.model.table import board_cavities
from control.plain_text import Advance, silent

NOISE_RATIO = 2.0  # between the scatter of orientations and positions and their stated noises, either way
SAME_sd = 0.1  # standard deviations that any value moves at most where all predictions together move by less than this
LeaveOut = Literal["setup"] | int | None


@dataclass(frozen=True, slots=True)
class CalibrationPlan:
    """What to identify, by which objective, and how to validate it.

    `accuracy_limit_m` is the a of E <= k a (SpringerPlus 5:1771, eq. 4), None without it. `leave_out`: argument of `held_out`.
    """

    choice: Choice = field(default_factory=Choice)
    objective: Objective = field(default_factory=SumOfDistances)
    accuracy_limit_m: float | None = None
    leave_out: LeaveOut = None
    starts_count: int = 4
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The result: the calibrated arm, its identification and its validation.

    `held` is None if nothing can be left out; `floor` is None if the noise is unknown.
    """

    nominal: Arm
    arm: Arm
    points: Points
    problem: ArmProblem
    found: Identification
    suspects: Suspects
    held: HeldOut | None
    floor: NoiseFloor | None
    verdict: Verdict
    warnings: tuple[str, ...] = ()


def calibrate(arm: Arm, points: Points, plan: CalibrationPlan, advance: Advance = silent) -> Calibrated:
    """Identify, find outliers, cross-validate, give a verdict. UnusablePointsError if the points allow no calibration."""
    advance("checking the points", 0.0)
    arm = with_own_base(arm) if BASE in plan.choice.fixed else arm  # so that its file says it, too
    asked, plan = plan, replace(plan, choice=plan.choice.for_points(arm, points))
    problem = problem_of(arm, points, plan.choice)
    warnings = [
        *([_about_frame(arm)] if BASE in plan.choice.freed and plan.choice != asked.choice else []),
        *require_usable(arm, points, problem, plan.choice),
        *unclear_flanks(arm, points, plan.choice.effects),
    ]
    advance("identifying", 0.1)
    problem, found = identified(arm, points, plan)
    warnings += [
        *unphysical(found.solution.corrections),
        *_about_noise(found),
        *about_settling(found),
        *tilted_axes(arm, problem, found.x),
    ]
    advance("looking for outliers", 0.4)
    floor = noise_floor(arm, points, problem, found.x)
    suspects = find_suspects(problem, found.x, _cavities(arm), _usual_noise_m(problem, floor))
    held, reasons = _held_out(arm, points, plan, advance)
    judged = verdict(found, held, floor, suspects, points.setup, still_joints(points.q_rad))
    advance("done", 1.0)
    return Calibrated(
        arm,
        calibrated_arm(arm, found, points),
        points,
        problem,
        found,
        suspects,
        held,
        floor,
        judged,
        (*warnings, *reasons),
    )


def identified(
    arm: Arm, points: Points, plan: CalibrationPlan, rows: Mask | None = None
) -> tuple[ArmProblem, Identification]:
    """What is identified at the points, or at those of a mask (m,), and its problem.

    An effect that no part can have is none, and so it is in the file: all else is identified without it. Its value is then zero.
    Effects of loads follow the geometry: they are evaluated at that of the identification before, to first order around it, until
    what the arm predicts settles.
    """

    def solved(problem: ArmProblem, starts_count: int) -> Identification:
        return identify(
            problem if rows is None else problem.of_rows(rows),
            objective=plan.objective,
            starts_count=starts_count,
            seed=plan.seed,
            accuracy_limit_m=plan.accuracy_limit_m,
        )

    problem = problem_of(arm, points, plan.choice)
    first = found = solved(problem, plan.starts_count)
    unsettled_m = 0.0
    settling = Settling(FITS_MOST)
    while plan.choice.effects and settling.goes_on:
        shaped = calibrated_arm(arm, found, points)
        there = problem_of(arm, points, plan.choice, shaped)
        slopes = followed(shaped, points, there, found.solution)
        further = solved(there.following(slopes, found.solution) if slopes else there, 1)
        moved_m = float(np.linalg.norm(further.error_after_m - found.error_after_m))
        if settling.takes(moved_m, SAME_sd * further.noise_m):
            problem, found = there, further
            unsettled_m = moved_m if settling.slow else 0.0
    before_m, value = first.error_before_m, first.objective_before
    found = replace(found, error_before_m=before_m, objective_before=value, unsettled_m=unsettled_m)
    if none := impossible(found.solution.corrections):
        rest = tuple(text for text in plan.choice.effects if effect_key(text, arm) not in none)
        bare = replace(arm, effects=tuple(one for one in arm.effects if (one.effect, one.joint) not in none))
        problem, found = identified(
            bare, points, replace(plan, choice=replace(plan.choice, effects=rest)), rows
        )
        zero = {LAWS[effect][0].name(joint): 0.0 for effect, joint in none}
        solution = replace(found.solution, corrections={**found.solution.corrections, **zero})
        return problem, replace(found, solution=solution)
    return problem if rows is None else problem.of_rows(rows), found


def _about_frame(arm: Arm) -> str:
    return (
        f"the file of arm {arm.name} does not tie the tips' frame to the arm's base (no base_frame, no table with known_pose):"
        " the frame's pose was identified too; --fix base equates it with the arm's base"
    )


def _usual_noise_m(problem: ArmProblem, floor: NoiseFloor | None) -> float:
    """Noise of one axis of a usual point, 0 if unknown."""
    if problem.observed.covariance is not None:
        return usual_noise_m(problem.observed.covariance[:, 0])
    return floor.axis_m if floor is not None else 0.0


def about_settling(found: Identification) -> list[str]:
    """A warning where loads still followed the geometry when the fits were ended."""
    if not found.unsettled_m:
        return []
    return [
        f"loads follow the geometry, and so slowly that {FITS_MOST} fits do not settle it: the last of them moved the tips of all"
        f" poses together by {1e3 * found.unsettled_m:.2g} mm. Values may be off by many such steps: an effect of loads here is"
        " hardly determined, or is too soft to hold the arm"
    ]


def _about_noise(found: Identification) -> list[str]:
    """A warning if points scatter unlike their stated noise: weights and intervals follow from it."""
    if found.weighted is not None:
        if 1.0 / NOISE_RATIO <= found.weighted <= NOISE_RATIO:
            return []
        return [
            f"the points scatter {found.weighted:.2g} times as much as their covariances say: something other than this geometry"
            " acts (run `armwright gap`), or the covariances are wrong"
        ]
    turned = found.orientation
    if turned is None:
        return []
    ratio = turned.noise_ratio(found.error_after_m)
    if 1.0 / NOISE_RATIO <= ratio <= NOISE_RATIO:
        return []
    rms_rad = float(np.sqrt(np.mean(turned.error_after_rad**2)))
    return [
        f"orientations scatter {ratio:.2g} times as much as their noise says, compared with positions: if nothing else is wrong,"
        f" state --orientation-noise {1e3 * rms_rad:.2g}mrad"
    ]


def _cavities(arm: Arm) -> Mapping[str, Array]:
    """All cavities in the board's frame, to guess in which one a tip was seated."""
    if arm.table is None:
        return {}
    return {name: np.array(place) for name, place in board_cavities(arm.table).items()}


def _held_out(
    arm: Arm, points: Points, plan: CalibrationPlan, advance: Advance
) -> tuple[HeldOut | None, list[str]]:
    """The held-out error, or why there is none."""

    def done(count: int, total: int) -> None:
        advance("leaving points out", 0.5 + 0.5 * count / total)

    def predicted(some: Points, rest: Points) -> tuple[Prediction, Prediction]:
        problem, found = identified(arm, some, replace(plan, starts_count=1))
        nominal = problem.solution(np.zeros(len(found.x)))
        # what no file says, such as where a gear lies whose flank is unclear, predicts nothing
        made = problem_of(calibrated_arm(arm, found, some), rest, replace(plan.choice, effects=()))
        return (problem_of(arm, rest, plan.choice), nominal), (made, found.solution)

    try:
        return held_out(predicted, points, plan.leave_out, done), []
    except CalibrationError as error:
        return None, [f"no held-out error: {error}"]


# Points that a camera measured, in the arm's base frame as a calibration found it: for commands that need them there.


def points_in_base(made: Calibrated) -> Points | None:
    """The points with tips, orientations and covariances turned from the camera's to the base frame; None for other points."""
    frame, points = made.found.solution.frames[0], made.points
    if frame.name != CAMERA:
        return None
    turned = np.array(points.orientation)
    rows = np.isfinite(turned).all(axis=1)
    turned[rows] = quaternions(frame.rotation @ matrices(turned[rows]))
    spread = frame.rotation @ matrices_of(points.covariance.reshape(-1, 2, 6)) @ frame.rotation.T
    return dataclasses.replace(
        points,
        tip_m=frozen(frame.to_base(points.tip_m)),
        orientation=frozen(turned),
        covariance=frozen(triangles(spread).reshape(-1, 12)),
        extra={name: column for name, column in points.extra.items() if name != "frame"},
    )
