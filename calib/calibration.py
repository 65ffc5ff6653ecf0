"""The whole calibration, from points to a validated result. Nothing here reads or writes a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from calib.arm_problem.assembly import BASE, BASE_FRAME, CAMERA, Choice, base_frame_of, followed, problem_of, with_own_base
from calib.arm_problem.checks import require_usable, still_joints
from calib.arm_problem.joint_effects import (
    LAWS,
    about_made_effects,
    effect_key,
    impossible,
    made_effects,
    unclear_flanks,
    unphysical,
    with_effects,
)
from calib.arm_problem.observations import Frame, rotation_vector
from calib.arm_problem.posed import usual_noise_m
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask, frozen
from calib.errors import CalibrationError
from calib.identify.identification import Identification, identify
from calib.identify.linear_fit import tilted_axes
from calib.identify.objective import Objective, SumOfDistances
from calib.identify.outliers import Suspects, find_suspects
from calib.points.points import STREAM_FRAME, Points, matrices_of, triangles
from calib.results import DECIMALS, Provenance, entries, write_json
from calib.settling import FITS_MOST, Settling
from calib.validation.holdout import HeldOut, Prediction, held_out
from calib.validation.verdict import NoiseFloor, Verdict, noise_floor, verdict
from calib.validation.verify import Comparison
from control.kinematics.rotation import matrices, quaternion_of, quaternions
from control.model.arm import Arm, Effect
from control.model.description import save_arm
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
    asked, plan = plan, replace(plan, choice=with_made_effects(plan.choice.for_points(arm, points), arm))
    problem = problem_of(arm, points, plan.choice)
    warnings = [
        *([_about_frame(arm)] if BASE in plan.choice.freed and BASE not in asked.choice.freed else []),
        *require_usable(arm, points, problem, plan.choice),
        *about_made_effects(arm),
        *unclear_flanks(arm, points, asked.choice.effects),
    ]
    advance("identifying", 0.1)
    problem, fit = identified(arm, points, plan)
    warnings += [
        *unphysical(fit.solution.corrections),
        *_about_noise(fit),
        *about_settling(fit),
        *tilted_axes(arm, problem, fit.x),
    ]
    advance("looking for outliers", 0.4)
    floor = noise_floor(arm, points, problem, fit.x)
    suspects = find_suspects(problem, fit.x, _cavities(arm), _usual_noise_m(problem, floor))
    held, reasons = _held_out(arm, points, plan, advance)
    judged = verdict(fit, held, floor, suspects, points.setup, still_joints(points.q_rad))
    return Calibrated(
        arm, calibrated_arm(arm, fit, points), points, problem, fit, suspects, held, floor, judged, (*warnings, *reasons)
    )


def identified(arm: Arm, points: Points, plan: CalibrationPlan, rows: Mask | None = None) -> tuple[ArmProblem, Identification]:
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
    first = fit = solved(problem, plan.starts_count)
    unsettled_m = 0.0
    settling = Settling(FITS_MOST)
    while plan.choice.effects and settling.goes_on:
        shaped = calibrated_arm(arm, fit, points)
        there = problem_of(arm, points, plan.choice, shaped)
        slopes = followed(shaped, points, there, fit.solution)
        further = solved(there.following(slopes, fit.solution) if slopes else there, 1)
        moved_m = float(np.linalg.norm(further.error_after_m - fit.error_after_m))
        if settling.takes(moved_m, SAME_sd * further.noise_m):
            problem, fit = there, further
            unsettled_m = moved_m if settling.slow else 0.0
    before_m, value = first.error_before_m, first.objective_before
    fit = replace(fit, error_before_m=before_m, objective_before=value, unsettled_m=unsettled_m)
    if none := impossible(fit.solution.corrections):
        rest = tuple(text for text in plan.choice.effects if effect_key(text, arm) not in none)
        bare = replace(arm, effects=tuple(one for one in arm.effects if (one.effect, one.joint) not in none))
        problem, fit = identified(bare, points, replace(plan, choice=replace(plan.choice, effects=rest)), rows)
        zero = {LAWS[effect][0].name(joint): 0.0 for effect, joint in none}
        solution = replace(fit.solution, corrections={**fit.solution.corrections, **zero})
        return problem, replace(fit, solution=solution)
    return problem if rows is None else problem.of_rows(rows), fit


def with_made_effects(choice: Choice, arm: Arm) -> Choice:
    """With the effects that the arm has by its tolerances, such as the play of its gears, unless they are fixed: left out."""
    names = {text: LAWS[effect][0].name(joint) for text in made_effects(arm) for effect, joint in [effect_key(text, arm)]}
    left_out = {name for text, name in names.items() if name in choice.fixed and text not in choice.effects}
    effects = (*choice.effects, *(text for text, name in names.items() if name not in choice.fixed))
    return replace(choice, effects=tuple(dict.fromkeys(effects)), fixed=[name for name in choice.fixed if name not in left_out])


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


def about_settling(fit: Identification) -> list[str]:
    """A warning where loads still followed the geometry when the fits were ended."""
    if not fit.unsettled_m:
        return []
    return [
        f"loads follow the geometry, and so slowly that {FITS_MOST} fits do not settle it: the last of them moved the tips of all"
        f" poses together by {1e3 * fit.unsettled_m:.2g} mm. Values may be off by many such steps: an effect of loads here is"
        " hardly determined, or is too soft to hold the arm"
    ]


def _about_noise(fit: Identification) -> list[str]:
    """A warning if points scatter unlike their stated noise: weights and intervals follow from it."""
    if fit.weighted is not None:
        if 1.0 / NOISE_RATIO <= fit.weighted <= NOISE_RATIO:
            return []
        return [
            f"the points scatter {fit.weighted:.2g} times as much as their covariances say: something other than this geometry"
            " acts (run `armwright gap`), or the covariances are wrong"
        ]
    turned = fit.orientation
    if turned is None:
        return []
    ratio = turned.noise_ratio(fit.error_after_m)
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


def _held_out(arm: Arm, points: Points, plan: CalibrationPlan, advance: Advance) -> tuple[HeldOut | None, list[str]]:
    """The held-out error, or why there is none."""

    def done(count: int, total: int) -> None:
        advance("leaving points out", 0.5 + 0.5 * count / total)

    def predicted(training: Points, rest: Points) -> tuple[Prediction, Prediction]:
        problem, fit = identified(arm, training, replace(plan, starts_count=1))
        nominal = problem.solution(np.zeros(len(fit.x)))
        # what no file says, such as where a gear lies whose flank is unclear, predicts nothing
        made = problem_of(calibrated_arm(arm, fit, training), rest, replace(plan.choice, effects=()))
        return (problem_of(arm, rest, plan.choice), nominal), (made, fit.solution)

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


# Results of a calibration besides the report: the calibrated arm.toml and calibration.json.


def write_calibrated_arm(path: Path, nominal: Arm, fit: Identification, made: Provenance, points: Points | None = None) -> Arm:
    """Save the arm with the identified parameters (`calibrated_arm`) as a new file, and return it.

    The nominal arm's file is not changed; an existing file at `path` is refused (ArmFileError).
    """
    calibration = made.of_arm(nominal, fit.objective)
    calibrated = dataclasses.replace(calibrated_arm(nominal, fit, points), calibration=calibration)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_arm(calibrated, path)
    return calibrated


def calibrated_arm(nominal: Arm, fit: Identification, points: Points | None = None) -> Arm:
    """The arm with the identified DH table, tool, base frame and effects, and the place of the stream that gave its points."""
    x, y, z = fit.solution.tool_m.tolist()
    tool = nominal.tool
    if any(estimate.parameter.name.startswith("tool_") for estimate in fit.estimates):
        tool = dataclasses.replace(tool, position_m=(x, y, z), known=True)
    framed = with_base_frame(nominal.with_dh(fit.dh), fit.solution.frames[0])
    if points is not None and STREAM_FRAME in points.extra.get("frame", ()):
        framed = with_placed_stream(framed, fit.solution.frames[0])
    return with_effects(dataclasses.replace(framed, tool=tool), fit.solution.corrections)


def with_placed_stream(arm: Arm, frame: Frame) -> Arm:
    """The arm whose [camera.stream] says where its frame is, so that it measures tips as table and camera have them."""
    camera = arm.camera
    if camera is None or camera.stream is None:
        return arm
    base = base_frame_of(arm)
    x, y, z = (base.rotation.T @ (frame.origin_m - base.origin_m)).tolist()
    orientation = quaternion_of((base.rotation.T @ frame.rotation).tolist())
    stream = dataclasses.replace(camera.stream, origin_m=(x, y, z), orientation=orientation)
    return dataclasses.replace(arm, camera=dataclasses.replace(camera, stream=stream))


def with_base_frame(arm: Arm, base: Frame) -> Arm:
    """The arm with a base frame that was identified; unchanged if it was not, or if the frame is a camera's."""
    if not base.is_free or base.name == CAMERA:
        return arm
    vector = [*base.origin_m.tolist(), *rotation_vector(base.rotation).tolist()]
    effect = Effect("base_frame", None, dict(zip(BASE_FRAME, vector, strict=True)))
    others = (e for e in arm.effects if e.effect != "base_frame")
    return dataclasses.replace(arm, effects=(*others, effect))


def write_calibration_json(
    path: Path, arm: str, fit: Identification, made: Provenance, more: Mapping[str, object] | None = None
) -> None:
    """Write the result for other programs; `more` under its own keys: verification, outliers, held-out errors, the verdict."""
    content = made.heading("calibration/1", arm=arm) | _found(fit)
    write_json(path, content | {"verification": None} | dict(more or {}))


def verification_json(verification: Comparison) -> dict[str, object]:
    """The errors of other points by setup, as calibration.json has them."""
    by_setup = {entry.setup: entries(entry, "before", "after", "improvement_percent") for entry in verification.by_setup()}
    return {"verification": by_setup}


def _found(fit: Identification) -> dict[str, object]:
    return {
        "objective": {"name": fit.objective, "before": fit.objective_before, "after": fit.objective_after},
        "points": len(fit.error_after_m),
        "mean_error_m": {"before": fit.mean_before_m, "after": fit.mean_after_m},
        "noise_m": fit.noise_m,
        "rank": fit.rank,
        "condition_number": fit.condition_number,
        "parameters": {
            estimate.parameter.name: entries(estimate.parameter, "unit", "nominal", "bound")
            | entries(estimate, "value", "deviation", "sd", "is_determined", "is_at_bound")
            for estimate in fit.estimates
        },
        "tool_m": fit.solution.tool_m.round(DECIMALS),
        "orientation": None
        if fit.orientation is None
        else {
            "points": len(fit.orientation.rows),
            "mean_error_rad": {"before": fit.orientation.mean_before_rad, "after": fit.orientation.mean_after_rad},
            "target_rotation": fit.orientation.target.round(DECIMALS),  # link_R_target
        },
        "frames": {
            frame.name: {
                "origin_m": frame.origin_m.round(DECIMALS),
                "rotation": frame.rotation.round(DECIMALS),  # base_T_frame
            }
            for frame in fit.solution.frames
            if frame.is_free
        },
        "undetermined": [{"names": g.names, "freedoms": g.freedoms_count} for g in fit.undetermined],
        "at_bound": fit.binding,
        "in_words": fit.in_words(),
    }
