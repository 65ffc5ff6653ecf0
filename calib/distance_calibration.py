"""The whole calibration with lengths: the arm's parameters, where the devices stand, and what readings left
out say of both.

In: an arm and readings. Out: a calibrated arm and calibration.json, text for a terminal, and the comparison
of two models on other readings.

"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel, Parameter, dh_parameters, require_known_names
from calib.arm_problem.assembly import Choice, POSITION_NOISE_m, problem_of, referenced
from calib.arm_problem.expansion import Problem
from calib.arm_problem.observations import Frame
from calib.arm_problem.posed import WeightedProblem, whole_problem
from calib.arm_problem.problem import TOOL_NAMES, ArmProblem, ModelValues
from calib.arrays import Array, frozen
from calib.calibration_report import estimate_lines
from calib.distances import BETWEEN, GAUGE, LEAST, Device, DistanceProblem, Readings, WireKnowledge, devices_of, readings_of
from calib.errors import UnusablePointsError
from calib.identify.determinability import Sensitivity
from calib.identify.identification import Estimate, Estimation, Identification, uncertainty
from calib.identify.objective import Huber, LeastSquares, Objective, value_of
from calib.identify.solver import Minimum, minimise
from calib.points.points import Points
from calib.validation.verify import Comparison, compare
from control.model.arm import Arm
from control.plain_text import Advance, silent

LEAST_READINGS = 6
FOLDS = 5
ONE_SEARCH = 0  # no further starts
THRESHOLDS, SETTLED = 6, 0.8  # rounds in which Huber's threshold falls to less than this share
FAR_OFF_m = 0.1  # median error with the nominal arm beyond which the readings are of another one


@dataclass(frozen=True, slots=True)
class DistancePlan:
    """What to identify: as of a calibration by tips, and of wires."""

    choice: Choice = field(default_factory=Choice)
    wires: WireKnowledge = field(default_factory=WireKnowledge)
    objective: Objective = field(default_factory=Huber)


@dataclass(frozen=True, slots=True)
class DistancesFound:
    """The result. Errors are measured minus modelled lengths (r,) [m].

    before_m: nominal arm, devices where they fit it; after_m: of the fit; held_m: each reading predicted by the others, empty
    with too few. places: fixed point of each wire, direction of each gauge, in the base frame; zero_m of each.
    """

    found: Identification
    readings: Readings
    devices: tuple[Device, ...]
    places: tuple[Array, ...]
    zero_m: tuple[float, ...]
    before_m: Array
    after_m: Array
    held_m: Array
    tips: int


def calibrate_with_distances(
    arm: Arm, points: Points, where: Path, plan: DistancePlan, advance: Advance = silent
) -> DistancesFound:
    """Identify the arm from the lengths of a file, and from its measured tips if there are any.

    PointsFileError or UnusablePointsError if they are unusable.
    """
    readings = readings_of(arm, points, where)
    if len(readings) < LEAST_READINGS:
        raise UnusablePointsError(f"{where}: {len(readings)} readings of lengths, {LEAST_READINGS} are needed at least")
    advance("where the devices stand", 0.0)
    tips, problem = _problem(arm, points, readings, plan)
    before = problem.errors_m(np.zeros(len(problem.parameters)))
    require_of_arm(before, where)
    advance("identifying", 0.1)
    best = solved(problem, plan.objective)
    x = best.x
    held = _held_out(problem, best.objective, advance)
    at = [device.at(values) for device, values in zip(problem.devices, problem.device_values(x), strict=True)]
    return DistancesFound(
        _identification(problem, tips, best),
        readings,
        problem.devices,
        tuple(frozen(place) for place, _ in at),
        tuple(zero_m for _, zero_m in at),
        frozen(before),
        frozen(problem.errors_m(x)),
        held,
        0 if tips is None else len(tips),
    )


def require_of_arm(errors_m: Array, where: Path) -> None:
    """UnusablePointsError for lengths that are of another arm, or in other units."""
    if float(np.median(np.abs(errors_m))) > FAR_OFF_m:
        raise UnusablePointsError(
            f"{where}: with the nominal arm the lengths are off by {1e3 * float(np.median(np.abs(errors_m))):.0f} mm (median)"
            " wherever the devices stand: expected joint angles in rad, lengths in m, of this arm"
        )


def _problem(arm: Arm, points: Points, readings: Readings, plan: DistancePlan) -> tuple[ArmProblem | None, DistanceProblem]:
    """The problem of the measured tips, if there are any, and the whole one."""
    model, choice = ArmModel(arm), plan.choice
    seen = points.chosen(np.flatnonzero(np.isfinite(points.tip_m).all(axis=1)))
    tips: ArmProblem | None = None
    inner: Problem | None = None
    tool_m = model.nominal_tool_m
    if len(seen):
        choice = choice.for_points(arm, seen)
        tips = problem_of(arm, referenced(arm, seen, choice), choice)
        inner, tool_m = whole_problem(tips), tips.solution(np.zeros(len(tips.parameters))).tool_m
    nominal = model.tips(model.nominal_dh, readings.q_rad, tool_m)
    return tips, DistanceProblem(
        model,
        readings,
        devices_of(readings, nominal, plan.wires),
        _free_of_arm(arm, choice) if inner is None else inner.parameters,
        unit_m=_unit_m(arm, readings, inner),
        tool_m=tool_m,
        inner=inner,
    )


def _free_of_arm(arm: Arm, choice: Choice) -> tuple[Parameter, ...]:
    """DH and tool, where no measured tips say what is identified. CalibrationError for an unknown name among the fixed ones."""
    model, bounds = ArmModel(arm), choice.bounds
    parameters = list(dh_parameters(model, bounds))
    if "tool" in choice.freed or not arm.tool.known:
        parameters += [
            Parameter(name, "m", float(value), bounds.of_free(name, "m"))
            for name, value in zip(TOOL_NAMES, model.nominal_tool_m, strict=True)
        ]
    require_known_names(choice.fixed, [parameter.name for parameter in parameters])
    return tuple(parameter for parameter in parameters if parameter.name not in choice.fixed)


def _unit_m(arm: Arm, readings: Readings, inner: Problem | None) -> float:
    """Noise of a coordinate of a tip; without tips, of a usual reading."""
    if isinstance(inner, WeightedProblem):
        return inner.unit_m
    if inner is not None and arm.camera is not None and arm.camera.position_noise_m > 0.0:
        return arm.camera.position_noise_m
    stated = readings.sd_m[np.isfinite(readings.sd_m)]
    return float(np.median(stated)) if inner is None and len(stated) else POSITION_NOISE_m


def solved(problem: DistanceProblem, objective: Objective) -> Minimum:
    """The minimum near the nominal arm. Huber's threshold begins with least squares and follows the fit, until outliers no longer
    raise it: a sum of distances, of rows that hold three lengths each, would make some of them zero.
    """
    if isinstance(objective, Huber) and objective.threshold_m is None:
        rough, last_m = minimise(problem, LeastSquares(), ONE_SEARCH), np.inf
        for _ in range(THRESHOLDS):
            robust = objective.settled_on(problem.residuals(rough.x))
            if robust.threshold_m is None or robust.threshold_m > SETTLED * last_m:
                break
            last_m, rough = robust.threshold_m, minimise(problem, robust, ONE_SEARCH)
        objective = robust
    return minimise(problem, objective, ONE_SEARCH, equal="by noise")


def _held_out(problem: DistanceProblem, objective: Objective, advance: Advance) -> Array:
    """Errors of each reading with the arm and devices that the others give; empty if they are too few."""
    everything = np.arange(len(problem.readings))
    held = np.zeros(len(everything))
    for fold in range(FOLDS):
        advance("leaving readings out", 0.4 + 0.6 * fold / FOLDS)
        is_out = everything % FOLDS == fold
        training = problem.of_readings(everything[~is_out])
        if not all(len(training.readings.of(device.name)) >= LEAST[device.kind] for device in _placed(problem)):
            return frozen(np.zeros(0))
        x = solved(training, objective).x
        held[is_out] = problem.errors_m(x)[is_out]
    return frozen(held)


def _placed(problem: DistanceProblem) -> list[Device]:
    """The devices whose place is unknown."""
    return [device for device in problem.devices if device.parameters]


def _identification(problem: DistanceProblem, tips: ArmProblem | None, best: Minimum) -> Identification:
    x, zero = best.x, np.zeros(len(best.x))
    before, after = problem.residuals(zero), problem.residuals(x)
    estimation: Estimation = uncertainty(
        problem.parameters, best.objective, x, after, Sensitivity.of(problem.sensitivity(x)), best.prior
    )
    dh, tool = problem.arm_at(x)
    tips_count = 0 if tips is None else len(tips.parameters)
    frames = (Frame.base(),) if tips is None else tips.solution(x[:tips_count]).frames
    errors = [_as_vectors(problem.errors_m(at)) for at in (zero, x)]
    if tips is not None:
        errors = [np.concatenate((tips.residuals(at[:tips_count]), e)) for at, e in zip((zero, x), errors, strict=True)]
    return Identification(
        objective=best.objective.name,
        solution=ModelValues(frozen(dh), frozen(tool), frames, {}),
        nominal_dh=frozen(problem.model.nominal_dh),
        estimates=estimation.estimates,
        objective_before=value_of(best.objective, before),
        objective_after=value_of(best.objective, after),
        error_before_m=frozen(errors[0]),
        error_after_m=frozen(errors[1]),
        noise_m=float(np.sqrt(np.sum(after**2) / max(1, after.size - estimation.known.rank))),
        rank=estimation.known.rank,
        condition_number=estimation.known.condition_number,
        undetermined=estimation.known.undetermined,
        is_converged=best.is_converged,
        x=frozen(x),
        noise=estimation.noise,
    )


def _as_vectors(errors_m: Array) -> Array:
    """Errors of lengths (r,) as vectors (r, 3) of the same length."""
    return np.column_stack((errors_m, np.zeros((len(errors_m), 2))))


def distances_text(made: DistancesFound) -> str:
    """Readings left out first, then what is determined, then the arm and where the devices stand."""
    tips = f", {made.tips} measured tips" if made.tips else ""
    lines = [
        _about_held(made),
        f"{len(made.readings)} readings{tips}: mean error of a length {_mm(made.before_m)} mm with the nominal arm,"
        f" {_mm(made.after_m)} mm after, at the readings of the fit.",
        *_by_device(made),
        "",
        *made.found.in_words(),
        "",
        *estimate_lines(_of_the_arm(made)),
        "",
        *_places(made),
    ]
    return "\n".join(lines) + "\n"


def _about_held(made: DistancesFound) -> str:
    if not len(made.held_m):
        return "Too few readings to leave some out: how good the result is elsewhere is unknown."
    return (
        f"On readings not used (every 5th left out in turn), the mean error went from {_mm(made.before_m)} to"
        f" {_mm(made.held_m)} mm (largest {1e3 * float(np.abs(made.held_m).max()):.3f})."
    )


def _by_device(made: DistancesFound) -> list[str]:
    """A line a device if there are several; distances between two poses are one."""
    kinds = [name.partition(":")[0] if name.startswith(BETWEEN) else name for name in made.readings.device]
    groups = {name: np.flatnonzero(np.array(kinds) == name) for name in dict.fromkeys(kinds)}
    if len(groups) < 2:
        return []
    return [f"{name}: {len(rows)} readings, {_mm(made.after_m[rows])} mm." for name, rows in groups.items()]


def _of_the_arm(made: DistancesFound) -> list[Estimate]:
    of_devices = {parameter.name for device in made.devices for parameter in device.parameters}
    frames = {name for frame in made.found.solution.frames if frame.is_free for name in frame.parameter_names}
    return [one for one in made.found.estimates if one.parameter.name not in of_devices | frames]


def _places(made: DistancesFound) -> list[str]:
    lines = []
    for device, place, zero_m in zip(made.devices, made.places, made.zero_m, strict=True):
        if device.kind == BETWEEN:
            continue
        is_gauge = device.kind == GAUGE
        what = "direction" if is_gauge else "fixed point [m]"
        numbers = ", ".join(f"{value:.5f}" for value in place)
        zero = f", zero {zero_m:.5f} m" if zero_m else ""
        lines.append(f"{device.name}: {what} in the base frame: [{numbers}]{zero}")
    return lines


def distances_json(made: DistancesFound) -> dict[str, object]:
    """Entries of calibration.json besides the identification."""
    return {
        "readings": len(made.readings),
        "held_out": None
        if not len(made.held_m)
        else {
            "mean_before_m": np.abs(made.before_m).mean(),
            "mean_after_m": np.abs(made.held_m).mean(),
            "max_after_m": np.abs(made.held_m).max(),
        },
        "devices": {
            device.name: {"direction" if device.kind == GAUGE else "point_m": place, "zero_m": zero_m}
            for device, place, zero_m in zip(made.devices, made.places, made.zero_m, strict=True)
            if device.kind != BETWEEN
        },
    }


def _mm(errors_m: Array) -> str:
    return f"{1e3 * float(np.abs(errors_m).mean()):.3f}"


def compare_lengths(nominal: Arm, calibrated: Arm, points: Points, where: Path, wires: WireKnowledge) -> Comparison:
    """Errors of lengths by two models, as vectors along each length; a device is a setup.

    For each model a wire or gauge of unknown place stands where its other readings fit best. PointsFileError or
    UnusablePointsError for readings that are unusable or too few.
    """
    problems = [_problem_of_others(arm, points, where, wires) for arm in (nominal, calibrated)]
    errors = [_errors_m(problem, where) for problem in problems]
    readings, model = problems[1].readings, problems[1].model
    tips = model.tips(model.nominal_dh, readings.q_rad)[readings.pose[:, 0]]
    return compare([_setup(name) for name in readings.device], readings.name, tips, *errors)


def _setup(device: str) -> str:
    """All distances between two poses are one."""
    return BETWEEN if device.startswith(BETWEEN) else device


def _problem_of_others(arm: Arm, points: Points, where: Path, wires: WireKnowledge) -> DistanceProblem:
    """Of the devices only: the arm is as it says."""
    model, readings = ArmModel(arm), readings_of(arm, points, where)
    tips = model.tips(model.nominal_dh, readings.q_rad)
    devices = devices_of(readings, tips, wires, to_spare=1)
    return DistanceProblem(model, readings, devices, (), unit_m=POSITION_NOISE_m, tool_m=model.nominal_tool_m)


def _errors_m(problem: DistanceProblem, where: Path) -> Array:
    """(r, 3) along each length."""
    require_of_arm(problem.errors_m(np.zeros(len(problem.parameters))), where)
    x = solved(problem, LeastSquares()).x if problem.parameters else np.zeros(0)
    return problem.left_out_m(x)[:, None] * problem.along(x)
