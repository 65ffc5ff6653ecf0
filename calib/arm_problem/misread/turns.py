"""Measured orientations that are not what their columns say: another order, the inverse, another frame, another target."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from calib.arm_problem.posed import PosedProblem
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, frozen, norms
from calib.errors import UnusablePointsError
from control.kinematics.rotation import matrices, quaternions

OFF_rad = (
    0.35  # mean angle at nominal beyond which they are not this arm's: deviations of 2 deg make a few of them
)
CLOSER = 0.3  # share of that angle below which another reading explains it


def require_turns_meant(problem: ArmProblem) -> None:
    """UnusablePointsError if the orientations disagree with the nominal arm, with the reading that would agree."""
    rows = problem.observed.turned_rows
    if not len(rows):
        return
    off = _angle_rad(problem)
    if off <= OFF_rad:
        return
    what = f"the measured orientations are {np.degrees(off):.0f} deg off the arm's in the mean"
    for reading, rotation in _readings(problem):
        if _angle_rad(_with(problem, rotation)) < CLOSER * off:
            raise UnusablePointsError(
                f"{what}: {reading}; expected qw, qx, qy, qz of the target in the frame of x_m"
            )
    if problem.observed.is_target_known:
        free = copy.copy(problem)
        free.observed = dataclasses.replace(problem.observed, is_target_known=False)
        if _angle_rad(free) < CLOSER * off:
            raise UnusablePointsError(
                f"{what}, always by the same turn: the target's axes are not the last link's; leave out --fix target"
            )
    raise UnusablePointsError(
        f"{what}: expected the orientation of a target on the last link, in the frame of x_m, y_m, z_m; remove qw to qz if they"
        " are something else"
    )


def _angle_rad(problem: ArmProblem) -> float:
    """Mean angle at nominal, the target where it fits best if it is free."""
    whole = PosedProblem(problem)
    return float(np.mean(norms(whole.angles_rad(np.zeros(len(whole.parameters))))))


def _with(problem: ArmProblem, rotation: Array) -> ArmProblem:
    other = copy.copy(problem)
    other.observed = dataclasses.replace(problem.observed, rotation=frozen(rotation))
    return other


def _readings(problem: ArmProblem) -> Iterator[tuple[str, Array]]:
    rows, rotation = problem.observed.turned_rows, problem.observed.rotation
    if rotation is None:
        return
    given = quaternions(rotation[rows])
    yield "the quaternions look like x, y, z, w", _placed(rotation, rows, matrices(given[:, [3, 0, 1, 2]]))
    yield (
        "they look inverted (the frame in the target)",
        _placed(rotation, rows, np.swapaxes(rotation[rows], 1, 2)),
    )


def _placed(rotation: Array, rows: npt.NDArray[np.intp], turned: Array) -> Array:
    whole = np.array(rotation)
    whole[rows] = turned
    return whole
