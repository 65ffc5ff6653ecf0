"""Outliers of a rigid registration: markers that are not at their place on the board.

For j = 0, 1, 2, ... the k - j best agreeing markers are searched (least trimmed squares: Rousseeuw 1984), and an F test decides
whether leaving one more out is significant; the largest j that passes counts, so that several outliers do not mask
each other (generalised extreme studentised deviate test: Rosner 1983).
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from calib.arrays import Array
from calib.boards.rigid import Motion, best_motion, squares_m2

FEWEST_TO_NAME = 5  # with four, leaving one out leaves three, which nearly always fit
FALSE_ALARM = 0.01  # probability that a registration without an outlier names one
RESOLUTION_m = 1e-6  # smaller residuals are ignored, so that a set without noise has no outliers
LARGEST_SHARE = 3  # at most every third marker may be wrong; else the whole set is
TRIPLES = 2000  # starts of the search
REFINED = 20  # number of best starts to refine
POSE_UNKNOWNS = 6


def outlying(board_m: Array, seen_m: Array) -> tuple[int, ...]:
    """Rows of the outliers among markers board_m (k, 3) and seen_m (k, 3); none if k is below five."""
    k = len(board_m)
    if k < FEWEST_TO_NAME:
        return ()
    motions = _starts(board_m, seen_m)
    agreeing = [_agreeing(motions, board_m, seen_m, k - j) for j in range(min(k // LARGEST_SHARE, k - 4) + 1)]
    squares = [_sum_of_squares(board_m, seen_m, rows) for rows in agreeing]
    passed = [j for j in range(1, len(agreeing)) if _is_more_than_chance(squares[j - 1], squares[j], k - j)]
    return tuple(sorted(set(range(k)) - set(agreeing[max(passed)]))) if passed else ()


def _starts(board_m: Array, seen_m: Array) -> Motion:
    """The motions of many triples of markers."""
    triples = np.array(list(combinations(range(len(board_m)), 3)))
    if len(triples) > TRIPLES:
        triples = np.random.default_rng(0).choice(triples, TRIPLES, replace=False)
    return best_motion(board_m[triples], seen_m[triples])


def _agreeing(motions: Motion, board_m: Array, seen_m: Array, count: int) -> tuple[int, ...]:
    """The `count` markers with the least sum of squares under one motion."""
    squares = np.sort(squares_m2(motions, board_m, seen_m), axis=-1)
    promising = np.argsort(squares[:, :count].sum(axis=-1))[:REFINED]
    candidates = {
        _refined(Motion(motions.rotation[i], motions.shift_m[i]), board_m, seen_m, count) for i in promising
    }
    return min(sorted(candidates), key=lambda rows: _sum_of_squares(board_m, seen_m, rows))


def _refined(motion: Motion, board_m: Array, seen_m: Array, count: int) -> tuple[int, ...]:
    """Fit the best markers and select again, until the selection is stable."""
    rows: tuple[int, ...] = ()
    for _ in range(10):
        best = np.argsort(squares_m2(motion, board_m, seen_m), kind="stable")[:count]
        chosen = tuple(sorted(int(i) for i in best))
        if chosen == rows:
            break
        rows = chosen
        motion = best_motion(board_m[list(rows)], seen_m[list(rows)])
    return rows


def _sum_of_squares(board_m: Array, seen_m: Array, rows: tuple[int, ...]) -> float:
    board, seen = board_m[list(rows)], seen_m[list(rows)]
    return float(squares_m2(best_motion(board, seen), board, seen).sum())


def _is_more_than_chance(before_m2: float, after_m2: float, left: int) -> bool:
    """Whether leaving out one of left + 1 markers reduces the sum of squares significantly."""
    from scipy.special import fdtrc

    freedom = 3 * left - POSE_UNKNOWNS
    variance_m2 = max(after_m2 / freedom, RESOLUTION_m**2)
    ratio = (before_m2 - after_m2) / 3.0 / variance_m2
    return float(fdtrc(3, freedom, max(0.0, ratio))) < FALSE_ALARM / (left + 1)
