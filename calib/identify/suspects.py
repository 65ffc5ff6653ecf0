"""Contradictions among the points: shifted setups, slipped encoders, single outliers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.arm_problem.frames import cross_matrix
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.identify.linear_fit import LinearFit, Mask
from calib.identify.outliers import FALSE_ALARM, Outlier, RESOLUTION_m, find_outliers, outlier_test

PART = (
    50_000  # points that are compared with each other: far more than the fit's unknowns need, in some 100 MB
)
REPORTED_LIMIT = 10  # outliers reported individually
REPORTED_IF_SYSTEMATIC = 3
SYSTEMATIC_COUNT = 12  # this many outliers without a slip indicate an effect
SYSTEMATIC_SHARE = 0.1
SLIPPED_COUNT = 3  # fewest points for a lasting slip of an encoder
IN_ONE_PIECE = 0.8  # share of the poses between first and last of a slip that must show it
EXPLAINED_SHARE = 0.9  # of their squared distances


@dataclass(frozen=True, slots=True)
class Slip:
    """A lasting encoder slip of `angle_rad`; `rows` (from 0) are the consecutive poses that show it."""

    joint: int
    angle_rad: float
    rows: tuple[int, ...]

    @property
    def words(self) -> str:
        """Describe the slip in a sentence."""
        return (
            f"{len(self.rows)} points between poses {self.rows[0] + 1} and {self.rows[-1] + 1}: the encoder of joint"
            f" {self.joint} probably slipped by {math.degrees(self.angle_rad):+.2f} deg; home the joint and measure these"
            " points again"
        )


@dataclass(frozen=True, slots=True)
class Suspects:
    """Points and setups that contradict the others; reported, never excluded. `points_count`: of all."""

    setups: tuple[ShiftedSetup, ...]
    outliers: tuple[Outlier, ...]
    points_count: int
    slip: Slip | None = None

    @property
    def is_systematic(self) -> bool:
        """Whether too many points contradict the others for single mistakes: an effect is missing."""
        single = len(self._single())
        return single >= SYSTEMATIC_COUNT and single > SYSTEMATIC_SHARE * self.points_count

    def in_words(self) -> tuple[str, ...]:
        """One sentence each, setups first; a lasting encoder slip is reported once."""
        sentences = [] if self.is_systematic else [one.words for one in self.setups]
        sentences += [self.slip.words] if self.slip is not None else []
        single = self._single()
        listed_count = REPORTED_IF_SYSTEMATIC if self.is_systematic else REPORTED_LIMIT
        sentences += [one.words for one in single[:listed_count]]
        if len(single) > listed_count:
            sentences.append(
                f"{len(single) - listed_count} more points contradict the others, less than those listed"
            )
        return tuple(sentences)

    def _single(self) -> list[Outlier]:
        rows = set(self.slip.rows) if self.slip is not None else set()
        return [one for one in self.outliers if one.row not in rows]


def find_suspects(
    problem: ArmProblem,
    x: Array,
    cavities: Mapping[str, Array] | None = None,
    noise_m: float = RESOLUTION_m,
) -> Suspects:
    """Find suspects around the solution x (k,) of a problem; points of a shifted setup are compared only with each other.

    `noise_m`: of one axis, if known; deviations within it are never suspicious. More than PART points are compared in parts,
    each spread evenly over all.
    """
    parts = max(1, math.ceil(len(problem) / PART))
    setups = shifted_setups(problem.of_rows(slice(None, None, parts)) if parts > 1 else problem, x)
    found: list[Outlier] = []
    for first in range(parts):
        part = problem.of_rows(slice(first, None, parts)) if parts > 1 else problem
        moved = [moved_columns(part, one.setup) for one in setups]
        extra = np.concatenate(moved, axis=2) if moved else None
        outliers = find_outliers(part, x, cavities, extra, noise_m, FALSE_ALARM / parts)
        found += [replace(one, row=first + parts * one.row) for one in outliers]
    worst_first = tuple(sorted(found, key=lambda one: -one.score))
    return Suspects(setups, worst_first, len(problem), _slip(problem, x, worst_first))


def _slip(problem: ArmProblem, x: Array, outliers: tuple[Outlier, ...]) -> Slip | None:
    """The joint for which a constant change of its angle explains the longest run of outliers."""
    run = _longest_run(sorted(one.row for one in outliers))
    if len(run) < SLIPPED_COUNT or len(outliers) - len(run) >= SYSTEMATIC_COUNT:
        return None
    off = {one.row: one.off_m for one in outliers}
    missing = np.array([off[row] for row in run])
    solution = problem.solution(x)
    slopes = problem.model.slopes(solution.dh, problem.observed.q_rad[run], solution.tool_m)
    best = (0.0, 0, 0.0)
    for joint, place in enumerate(problem.model.theta_places, 1):
        by_joint = slopes.by_dh[:, :, place]
        angle = float(np.sum(by_joint * missing) / max(float(np.sum(by_joint**2)), 1e-300))
        share = 1.0 - float(np.sum((missing - angle * by_joint) ** 2) / np.sum(missing**2))
        best = max(best, (share, joint, angle))
    return Slip(best[1], best[2], tuple(run)) if best[0] >= EXPLAINED_SHARE else None


def _longest_run(rows: list[int]) -> list[int]:
    """The longest run that contains at least IN_ONE_PIECE of the rows between its first and last."""
    best: list[int] = []
    for start in range(len(rows)):
        for end in range(len(rows) - 1, start + len(best) - 1, -1):
            if end - start + 1 >= IN_ONE_PIECE * (rows[end] - rows[start] + 1):
                best = rows[start : end + 1]
                break
    return best


# Detects shifted setups: the board (or the camera) was not at the assumed place.
FREE = "free"  # poses away from any board
POINTS_MINIMUM_COUNT = 6  # of a setup, to determine the shift and rotation of its board
LARGEST_SHARE = 0.5  # if more setups disagree, the cause is not a single one
CHANCE = 1e-6  # probability of a false alarm for a setup
# Share of the squared residuals that the motion must explain. A missing effect also makes setups differ, but
# a rigid motion explains little of that.
SHIFT_EXPLAINED_SHARE = 0.3
LENGTH_m, TURN_rad = 0.001, 0.01  # scales of the two kinds of columns


@dataclass(frozen=True, slots=True)
class ShiftedSetup:
    """A setup whose points fit the others after a shift [m] and a rotation [rad] (3,) about their centre, base frame."""

    setup: str
    shift_m: Array
    turn_rad: Array
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
        if best[0] < SHIFT_EXPLAINED_SHARE or best[1] > CHANCE:
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
    return share, chance, ShiftedSetup(name, shift, turn, _words(name, shift, turn, share))


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
