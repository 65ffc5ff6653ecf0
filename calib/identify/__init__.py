"""Identification: which DH deviations explain the measured tips best, and how well each is known."""

from calib.identify.arm_model import ArmModel
from calib.identify.identification import Identification, identify
from calib.identify.objective import LeastSquares, Objective, SumOfDistances
from calib.identify.parameters import Bounds, Parameter
from calib.identify.problem import DhProblem, Problem, TipModel

__all__ = [
    "ArmModel",
    "Bounds",
    "DhProblem",
    "Identification",
    "LeastSquares",
    "Objective",
    "Parameter",
    "Problem",
    "SumOfDistances",
    "TipModel",
    "identify",
]
