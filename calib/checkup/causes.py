"""What may have happened to an arm since its points were taken, and which of it new poses speak for.

Each cause moves the tip along columns X with amplitudes that are normal with an unknown size s; measured minus expected tips have
the covariance S + s^2 X X', with S of `expectation`. The scale of both is an estimate, known as by FREEDOM coordinates, so that
the evidence is that of Student's distribution: tips that are all somewhat farther off than expected are no change. Sizes are
averaged over a grid. "several" has the columns of all causes, for what no single one explains. Probabilities follow from these
evidences and equal odds of "nothing" and "something".
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from calib.arm_problem.frames import cross_matrix
from calib.arrays import Array
from calib.checkup.expectation import Expectation

Kind = Literal["nothing", "zero", "play", "load", "link", "frame", "several"]
FREEDOM: Final = (
    10.0  # what is left of predicted tips was 0.85 to 1.6 times what had been promised (make trust-study)
)
ANGLES_rad: Final = (
    3e-4,
    1e-3,
    3e-3,
    1e-2,
    3e-2,
)  # sizes of a joint's change: from below what shows to a slipped tooth
LENGTHS_m: Final = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # of a frame's or a link's
LEVER_m: Final = 0.3  # turns one into the other
STRAIGHT_rad: Final = 1e-3  # up to which the tip's way is straight to a micrometre
CHORDS: Final = 3  # rounds, until the chord is that of the angle


@dataclass(frozen=True, slots=True)
class Cause:
    """A change: kind, joint or link (1-based, 0: none); its columns (m, 3, k) and how far it scatters a visit (m, 3, 3)."""

    kind: Kind
    number: int
    columns: Array
    scatter: Array | None
    sizes: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Judged:
    """A cause with its probability, its most probable amplitudes (k,), and the tip's shift by them, root mean square [m].

    misfit: chi-squared of what it leaves, over its degrees of freedom.
    """

    cause: Cause
    probability: float
    amplitudes: Array
    shift_m: float
    misfit: float


def causes_of(at: Expectation) -> tuple[Cause, ...]:
    """All causes that poses can show; the first is nothing."""
    return tuple(_causes(at))


def _causes(at: Expectation) -> Iterator[Cause]:
    count = len(at)
    yield Cause("nothing", 0, np.zeros((count, 3, 0)), None, (1.0,))
    for j in range(at.by_joint.shape[2]):
        moves = at.by_joint[:, :, j]
        yield Cause("zero", j + 1, moves[:, :, None], None, ANGLES_rad)
        loose = 0.25 * (at.flank[:, j] == 0.0)[:, None, None] * np.einsum("mi,mk->mik", moves, moves)
        yield Cause("play", j + 1, -0.5 * (at.flank[:, j, None] * moves)[:, :, None], loose, ANGLES_rad)
        if at.load[:, j].any():
            pulls = np.stack(
                (at.load[:, j], at.held[:, j]), axis=1
            )  # of friction, a part is on the link's side
            yield Cause("load", j + 1, -moves[:, :, None] * pulls[:, None, :], None, ANGLES_rad)
    for link in range(at.by_link.shape[2] // 4):
        d, _, length, alpha = (at.by_link[:, :, 4 * link + k] for k in range(4))
        yield Cause("link", link + 1, np.stack((d, length, alpha / LEVER_m), axis=2), None, LENGTHS_m)
    turns = np.array([-cross_matrix(tip) for tip in at.tip_m]) / LEVER_m
    shifts = np.broadcast_to(np.eye(3), turns.shape)
    yield Cause("frame", 0, np.concatenate((shifts, turns), axis=2), None, LENGTHS_m)


def judged(at: Expectation) -> tuple[Judged, ...]:
    """Every cause, the most probable first."""
    singles = [_along_circle(at, cause) for cause in causes_of(at)]
    causes = [*singles, _several(singles)]
    prior = np.log(np.array([0.5, *np.full(len(causes) - 1, 0.5 / (len(causes) - 1))]))
    tried = [[_tried(at, cause, size) for size in cause.sizes] for cause in causes]
    evidence = np.array([_mean_of([one.evidence for one in of_sizes]) for of_sizes in tried]) + prior
    probability = np.exp(evidence - evidence.max())
    probability /= probability.sum()
    found = []
    for cause, of_sizes, share in zip(causes, tried, probability, strict=True):
        best = max(of_sizes, key=lambda one: one.evidence)
        moved = cause.columns @ best.amplitudes
        shift_m = math.sqrt(float(np.mean(np.sum(moved**2, axis=1))))
        found.append(Judged(cause, float(share), best.amplitudes, shift_m, best.misfit))
    return tuple(sorted(found, key=lambda one: -one.probability))


def misfit_limit(coordinates: int) -> float:
    """The chi-squared a coordinate that chance and the estimated scale leave in 99 of 100 cases (Fisher's distribution)."""
    from scipy.special import fdtri

    return float(fdtri(coordinates, FREEDOM, 0.99))


def _several(singles: Sequence[Cause]) -> Cause:
    """All causes at once, each with amplitudes of one size: angles in rad, lengths over a lever."""
    columns = [
        one.columns if one.sizes == ANGLES_rad else one.columns * LEVER_m
        for one in singles
        if one.kind != "nothing"
    ]
    return Cause("several", 0, np.concatenate(columns, axis=2), None, ANGLES_rad)


def _along_circle(at: Expectation, cause: Cause) -> Cause:
    """A turned joint moves the tip on a circle: its column as the chord to where it turned, not the tangent."""
    if cause.kind != "zero":
        return cause
    for _ in range(CHORDS):
        best = max((_tried(at, cause, size) for size in cause.sizes), key=lambda one: one.evidence)
        angle_rad = float(best.amplitudes[0])
        if abs(angle_rad) > STRAIGHT_rad:
            chord = at.turned_m(cause.number - 1, angle_rad) / angle_rad
            cause = dataclasses.replace(cause, columns=chord[:, :, None])
    return cause


@dataclass(frozen=True, slots=True)
class _Tried:
    evidence: float
    amplitudes: Array
    misfit: float


def _tried(at: Expectation, cause: Cause, size: float) -> _Tried:
    """The evidence of a cause of one size."""
    y, x = at.left_m.ravel(), cause.columns.reshape(3 * len(at), -1) * size
    noise = at.covariance.copy()
    if cause.scatter is not None:
        for k, part in enumerate(cause.scatter):
            noise[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += size**2 * part
    root = np.linalg.cholesky(noise + x @ x.T)
    white = np.linalg.solve(root, y)
    amplitudes = size * x.T @ np.linalg.solve(root.T, white)
    left = y - (x / size) @ amplitudes
    misfit = float(left @ np.linalg.solve(noise, left)) / len(y)
    square = 0.5 * (FREEDOM + len(y)) * math.log1p(float(white @ white) / FREEDOM)
    return _Tried(-square - float(np.log(np.diag(root)).sum()), amplitudes, misfit)


def _mean_of(logs: list[float]) -> float:
    """Logarithm of the mean of what these are the logarithms of."""
    top = max(logs)
    return top + math.log(sum(math.exp(one - top) for one in logs) / len(logs))
