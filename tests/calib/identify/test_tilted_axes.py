"""The remark on parallel axes that are tilted against each other: where they are, and only there."""

import dataclasses
import re

import numpy as np
import pytest

from benchmarks.gap.static.cases import ARM, case
from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import problem_of
from calib.arm_problem.parallel_axes import tilt_row, with_tilt_behind
from calib.identify.linear_fit import tilted_axes
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise


@pytest.mark.parametrize(("tilt_rad", "said"), [(0.0, []), (0.003, [3.0])])
def test_a_tilt_is_remarked_with_its_size_and_an_arm_without_one_is_not(tilt_rad: float, said: list[float]) -> None:
    points, tilted = case(37), with_tilt_behind(ARM, 2)
    dh = np.array(tilted.dh)
    dh[tilt_row(tilted, 2), 3] += tilt_rad
    off = ArmModel(tilted).tips(dh, points.q_rad) - ArmModel(ARM).tips(ARM.dh, points.q_rad)
    problem = problem_of(ARM, dataclasses.replace(points, tip_m=points.tip_m + off))
    found = tilted_axes(ARM, problem, minimise(problem, LeastSquares(), 1).x)
    sizes = [re.search(r"joints 2 and 3 may not be parallel: a tilt of ([\d.]+) mrad", one) for one in found]
    assert [float(size[1]) for size in sizes if size] == pytest.approx(said, rel=0.1)
