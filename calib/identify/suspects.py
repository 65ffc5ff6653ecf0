"""What the points contradict among themselves: whole setups that are off, then single points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.identify.outliers import Outlier, find_outliers
from calib.identify.problem import ArmProblem
from calib.identify.shifted import ShiftedSetup, moved_columns, shifted_setups

TOLD_LIMIT = 10  # points told one by one
TOLD_IF_SYSTEMATIC = 3
IN_ONE_PIECE = 0.8  # share of the poses between first and last of a slip that show it
ALIKE_SLIP = 0.15  # slips of one joint that differ by less than this share are one slip
SYSTEMATIC_COUNT = 12  # so many outliers that are no slip of an encoder are an effect rather
SYSTEMATIC_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Suspects:
    """Points and setups that the others contradict; they are told, never left out. `points_count`: of all."""

    setups: tuple[ShiftedSetup, ...]
    outliers: tuple[Outlier, ...]
    points_count: int

    @property
    def is_systematic(self) -> bool:
        """Whether so many points contradict the others that an effect is missing rather than that hands slipped."""
        single = len(self.outliers) - len(self._slipped()[1])
        return single >= SYSTEMATIC_COUNT and single > SYSTEMATIC_SHARE * self.points_count

    def in_words(self) -> tuple[str, ...]:
        """One sentence each, setups first; an encoder that slipped and stayed so is told once."""
        said = [one.words for one in self.setups]
        sentence, slipped = self._slipped()
        said += [sentence] if sentence else []
        rest = [one for one in self.outliers if one not in slipped]
        told = TOLD_IF_SYSTEMATIC if self.is_systematic else TOLD_LIMIT
        said += [one.words for one in rest[:told]]
        if len(rest) > told:
            said.append(f"{len(rest) - told} more points contradict the others, by less than these")
        return tuple(said)

    def _slipped(self) -> tuple[str, list[Outlier]]:
        """The largest set of points, three or more, with one slip of one joint's encoder, and a sentence about it."""
        best: list[Outlier] = []
        for one in self.outliers:
            alike = [other for other in self.outliers if _is_same_slip(one, other)]
            best = alike if len(alike) > max(2, len(best)) and _is_in_one_piece(alike) else best
        if not best:
            return "", []
        joint, angle = best[0].story.joint, float(np.median([one.story.slip_rad for one in best]))
        rows = [one.row + 1 for one in best]
        return (
            f"{len(best)} points between poses {min(rows)} and {max(rows)}: as if the encoder of joint {joint} had slipped by"
            f" {math.degrees(angle):+.2f} deg there; home the joint and measure them again"
        ), best


def find_suspects(problem: ArmProblem, x: Array, cavities: Mapping[str, Array] | None = None) -> Suspects:
    """Around the solution x (k,) of a problem: the points of a setup that is off are held against each other only."""
    setups = shifted_setups(problem, x)
    moved = [moved_columns(problem, one.setup) for one in setups]
    extra = np.concatenate(moved, axis=2) if moved else None
    return Suspects(setups, find_outliers(problem, x, cavities, extra), len(problem))


def _is_same_slip(one: Outlier, other: Outlier) -> bool:
    if one.story.joint == 0 or one.story.joint != other.story.joint:
        return False
    return abs(one.story.slip_rad - other.story.slip_rad) < ALIKE_SLIP * abs(one.story.slip_rad)


def _is_in_one_piece(alike: list[Outlier]) -> bool:
    rows = [one.row for one in alike]
    return len(rows) >= IN_ONE_PIECE * (max(rows) - min(rows) + 1)
