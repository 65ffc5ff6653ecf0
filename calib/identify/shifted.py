"""Detects shifted setups: the board (or the camera) was not at the assumed place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.arm_problem.frames import cross_matrix
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.identify.linear_fit import LinearFit, Mask
from calib.identify.outliers import outlier_test

FREE = "free"  # poses away from any board
POINTS_MINIMUM_COUNT = 6  # of a setup, to determine the shift and rotation of its board
LARGEST_SHARE = 0.5  # if more setups disagree, the cause is not a single one
CHANCE = 1e-6  # probability of a false alarm for a setup
# Share of the squared residuals that the motion must explain. A missing effect also makes setups differ, but
# a rigid motion explains little of that.
EXPLAINED_SHARE = 0.3
LENGTH_m, TURN_rad = 0.001, 0.01  # scales of the two kinds of columns


@dataclass(frozen=True, slots=True)
class ShiftedSetup:
    """A setup whose points fit the others after a shift [m] and a rotation [rad] (3,) about their centre, base frame."""

    setup: str
    shift_m: Array
    turn_rad: Array
    explained_share: float
    words: str


def shifted_setups(problem: ArmProblem, x: Array) -> tuple[ShiftedSetup, ...]:
    """Shifted setups, the worst first; none if every board is identified anyway."""
    names = _candidates(problem)
    found: list[ShiftedSetup] = []
    if len(names) < 2:
        return ()
    fixed = LinearFit.around(problem, x)
    everything = np.concatenate([fixed.weighted(moved_columns(problem, name)) for name in names], axis=2)
    agrees = outlier_test(LinearFit.of(fixed.residuals, fixed.columns, everything)).agrees
    while len(found) + 1 <= LARGEST_SHARE * len(names):
        taken = [fixed.weighted(moved_columns(problem, one.setup)) for one in found]
        rest = [name for name in names if name not in [one.setup for one in found]]
        best = max((_moved(problem, name, fixed, taken, agrees) for name in rest), key=lambda one: one[0])
        if best[0] < EXPLAINED_SHARE or best[1] > CHANCE:
            break
        found.append(best[2])
    return tuple(found)


def moved_columns(problem: ArmProblem, setup: str) -> Array:
    """Derivative (m, 3, 6) of the residuals by a shift and a rotation of one setup's references."""
    rows = np.array([name == setup for name in problem.observed.setup])
    columns = np.zeros((len(rows), 3, 6))
    arms = problem.references_m[rows] - problem.references_m[rows].mean(axis=0)
    columns[rows, :, :3] = LENGTH_m * np.eye(3)
    for axis in range(3):
        columns[rows, :, 3 + axis] = TURN_rad * arms @ cross_matrix(np.eye(3)[axis]).T
    return columns


def _candidates(problem: ArmProblem) -> list[str]:
    """Setups with enough points whose references are known."""
    observed = problem.observed
    known = [not observed.frames[frame].is_free for frame in observed.frame]
    names = [n for n, is_known in zip(observed.setup, known, strict=False) if is_known and n != FREE]
    return [name for name in dict.fromkeys(names) if names.count(name) >= POINTS_MINIMUM_COUNT]


def _moved(
    problem: ArmProblem, name: str, fixed: LinearFit, taken: list[Array], agrees: Mask
) -> tuple[float, float, ShiftedSetup]:
    """Explained share, p-value, and the motion."""
    from scipy.special import fdtrc

    own = fixed.weighted(moved_columns(problem, name))
    before_columns = np.concatenate((fixed.columns, *taken), axis=2)
    wanted = -fixed.residuals[agrees].ravel()
    before, before_rank, _ = _solved(before_columns[agrees], wanted)
    after, after_rank, step = _solved(np.concatenate((before_columns, own), axis=2)[agrees], wanted)
    freedom = max(1, len(wanted) - after_rank)
    gained = max(1, after_rank - before_rank)
    chance = float(fdtrc(gained, freedom, max(0.0, before - after) / gained / max(after / freedom, 1e-300)))
    shift, turn = LENGTH_m * step[-6:-3], TURN_rad * step[-3:]
    share = 1.0 - after / max(before, 1e-300)
    return share, chance, ShiftedSetup(name, shift, turn, share, _words(name, shift, turn, share))


def _solved(columns: Array, wanted: Array) -> tuple[float, int, Array]:
    """Sum of squares left [m^2], rank, and the shortest solution."""
    rows = columns.reshape(-1, columns.shape[2])
    step, _, rank, _ = np.linalg.lstsq(rows, wanted, rcond=1e-6)
    return float(np.sum((rows @ step - wanted) ** 2)), int(rank), np.asarray(step)


def _words(name: str, shift_m: Array, turn_rad: Array, share: float) -> str:
    x, y, z = 1e3 * shift_m
    return (
        f'setup "{name}" does not fit the others: a shift of its board (or of the camera) by {x:+.2f}, {y:+.2f},'
        f" {z:+.2f} mm and a rotation by {math.degrees(float(np.linalg.norm(turn_rad))):.2f} deg explain"
        f" {100 * share:.0f} % of the squared residuals; measure the board's pose, or free the table"
    )
