"""Identification: which deviations explain the measured tips best, and how well each is known."""

from calib.identify.arm_model import ArmModel
from calib.identify.assembly import Choice, problem_of
from calib.identify.identification import Identification, identify
from calib.identify.objective import LeastSquares, Objective, SumOfDistances
from calib.identify.observations import Observations
from calib.identify.parameters import Bounds, Parameter
from calib.identify.problem import ArmProblem, Problem

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
