"""Identification: the deviations that best explain the measured tips, with their uncertainty."""

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.expansion import Problem
from calib.arm_problem.observations import Observations
from calib.arm_problem.parameters import Bounds, Parameter
from calib.arm_problem.problem import ArmProblem
from calib.identify.identification import Identification, identify
from calib.identify.objective import LeastSquares, Objective, SumOfDistances

__all__ = [
    "ArmModel",
    "ArmProblem",
    "Bounds",
    "Choice",
    "Identification",
    "LeastSquares",
    "Objective",
    "Observations",
    "Parameter",
    "Problem",
    "SumOfDistances",
    "identify",
    "problem_of",
]
