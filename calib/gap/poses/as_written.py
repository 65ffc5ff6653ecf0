"""What the named laws leave as arm.toml has them: without how real parts depart from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np

from calib.arm_problem.assembly import problem_of
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.poses.measured import Fit, Left
from calib.gap.poses.state import Around
from calib.gap.posterior.search import Weighed
from calib.gap.posterior.term import Key
from calib.points.points import Points
from control.model.arm import Arm

STEPS = 2  # of the places of tool and boards, which follow in nearly a straight line


def left_as_written(arm: Arm, points: Points, rows: Mask) -> Left:
    """What an arm's file leaves as it is; what no file says (tool, boards, target) is placed by the poses of a mask (m,)."""
    problem = problem_of(arm, points)
    x = np.zeros(len(problem.parameters))
    for _ in range(STEPS):
        x = _placed(problem, x, rows)
    return Fit.nominal(problem, x).left()


def _placed(problem: ArmProblem, x: Array, rows: Mask) -> Array:
    """A step of what has no nominal value."""
    free = [k for k, parameter in enumerate(problem.parameters) if not parameter.has_bound]
    if not free:
        return x
    residual, slope = problem.residuals_and_jacobian(x)
    step, *_ = np.linalg.lstsq(
        slope[rows][:, :, free].reshape(-1, len(free)), -residual[rows].ravel(), rcond=1e-9
    )
    moved = x.copy()
    moved[free] += step
    return moved


def without_unnamed(around: Around, best: Weighed, names: Collection[EffectName]) -> Weighed:
    """The set without effects that are not named: the file's geometry must do without them, too."""
    some = tuple(one for one in best.members if not _is_left_out(around.terms[one[0]].key, names))
    return dataclasses.replace(best, members=some)


def _is_left_out(key: Key, names: Collection[EffectName]) -> bool:
    return isinstance(key, EffectName) and key not in names
