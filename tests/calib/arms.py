"""The plain chains as arms and identification problems of calib."""

from __future__ import annotations

import numpy as np

from benchmarks.calibration.chains import ChainModel
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.observations import Observations
from calib.arm_problem.problem import ArmProblem
from calib.identify.identification import Identification, identify
from control.model.arm import Arm, Link, Tool


def arm_of(model: ChainModel, dh: np.ndarray) -> Arm:
    """The same arm as control knows it."""
    links = tuple(Link("revolute" if turns else "fixed", *row) for row, turns in zip(dh.tolist(), model.joints, strict=True))
    convention = "modified" if model.modified else "standard"
    return Arm("test", links, dh_convention=convention, tool=Tool(model.tool_m))


def problem_of_tips(model: ChainModel, dh: np.ndarray, q, tips, **choice) -> ArmProblem:
    """Tips measured in the base frame against the DH parameters of an arm; `choice` as ArmProblem takes it."""
    return ArmProblem(ArmModel(arm_of(model, dh)), Observations.of_tips(q, tips), **choice)


def identified(model: ChainModel, dh: np.ndarray, q, tips, bounds=None, fixed=(), **how) -> Identification:
    """What an identification makes of tips measured in the base frame."""
    return identify(problem_of_tips(model, dh, q, tips, bounds=bounds, fixed=fixed), **how)
