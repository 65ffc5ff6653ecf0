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
from calib.doubt import Doubt
from control.kinematics.rotation import matrices, quaternions

OFF_rad = (
    0.35  # mean angle at nominal beyond which they are not this arm's: deviations of 2 deg make a few of them
)
CLOSER = 0.3  # share of that angle below which another reading explains it


def doubts_of_turns(problem: ArmProblem, is_as_given: bool = False) -> tuple[Doubt, ...]:
    """What the orientations look like if they disagree with the nominal arm, which deviations within their bounds cannot do.

    UnusablePointsError, unless they are to be taken at their word.
    """
    if not len(problem.observed.turned_rows):
        return ()
    off = _angle_rad(problem)
    if off <= OFF_rad:
        return ()
    looks, then_rad, remedy = _explained(problem, off)
    found = Doubt(
        looks,
        f"they would then be {_deg(then_rad)} off the arm's in the mean",
        f"they are {_deg(off)} off",
        remedy,
    )
    if not is_as_given:
        raise found.refusal()
    return (found,)


def _explained(problem: ArmProblem, off: float) -> tuple[str, float, str]:
    """The reading that agrees best, its mean angle, and what to do."""
    expected = "expected qw, qx, qy, qz of the target in the frame of x_m"
    for reading, rotation in _readings(problem):
        angle = _angle_rad(_with(problem, rotation))
        if angle < CLOSER * off:
            return reading, angle, expected
    if problem.observed.is_target_known:
        free = copy.copy(problem)
        free.observed = dataclasses.replace(problem.observed, is_target_known=False)
        angle = _angle_rad(free)
        if angle < CLOSER * off:
            return "the target's axes do not look like the last link's", angle, "leave out --fix target"
    return (
        "the measured orientations look like those of something else",
        0.0,
        f"{expected}; remove qw to qz if they are something else",
    )


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.2g} deg"


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
