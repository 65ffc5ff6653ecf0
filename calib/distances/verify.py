"""Two models of an arm on lengths that calibration did not use: measured against modelled."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import POSITION_NOISE_m
from calib.arm_problem.parameters import dh_names
from calib.arrays import Array
from calib.distances.calibrate import require_of_arm, solved
from calib.distances.devices import Vector, devices_of
from calib.distances.problem import DistanceProblem
from calib.distances.readings import BETWEEN, readings_of
from calib.identify.objective import LeastSquares
from calib.points.points import Points
from calib.validation.verify import Comparison, compare
from control.model.arm import Arm


def compare_lengths(
    nominal: Arm, calibrated: Arm, points: Points, where: Path, free_zero: bool, known_m: Mapping[str, Vector]
) -> Comparison:
    """Errors of lengths by two models, as vectors along each length; a device is a setup.

    For each model a wire or gauge of unknown place stands where its other readings fit best. PointsFileError or
    UnusablePointsError for readings that are unusable or too few.
    """
    problems = [_problem(arm, points, where, free_zero, known_m) for arm in (nominal, calibrated)]
    errors = [_errors_m(problem, where) for problem in problems]
    readings, model = problems[1].readings, problems[1].model
    tips = model.tips(model.nominal_dh, readings.q_rad)[readings.pose[:, 0]]
    return compare([_setup(name) for name in readings.device], readings.name, tips, *errors)


def _setup(device: str) -> str:
    """All distances between two poses are one."""
    return BETWEEN if device.startswith(BETWEEN) else device


def _problem(
    arm: Arm, points: Points, where: Path, free_zero: bool, known_m: Mapping[str, Vector]
) -> DistanceProblem:
    """Of the devices only: the arm is as it says."""
    model, readings = ArmModel(arm), readings_of(arm, points, where)
    tips = model.tips(model.nominal_dh, readings.q_rad)
    devices = devices_of(readings, tips, free_zero, known_m, to_spare=1)
    return DistanceProblem(
        model, readings, devices, unit_m=POSITION_NOISE_m, tool_m=model.nominal_tool_m, fixed=dh_names(len(arm.links))
    )  # fmt: skip


def _errors_m(problem: DistanceProblem, where: Path) -> Array:
    """(r, 3) along each length."""
    require_of_arm(problem.errors_m(np.zeros(len(problem.parameters))), where)
    x = solved(problem, LeastSquares()).x if problem.parameters else np.zeros(0)
    return problem.left_out_m(x)[:, None] * problem.along(x)
