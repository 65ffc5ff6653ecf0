"""Held-out error: cross-validation of an identification.

Every setup in turn, or every k-th point, is left out, the rest identified, and the left-out part predicted. A board of
unknown pose that is completely left out has no reference: then the scatter of the predicted tips of each cavity about
their mean is used, since all of them were seated in the same place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from calib.arm_problem.problem import ArmProblem, ModelValues
from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from calib.points.points import FREE, Points, seen_again
from calib.validation.statistics import improvement_percent

FOLDS_COUNT = 5
GROUPS_PER_FOLD = 3
FREE_PARTS = 4
Prediction = tuple[ArmProblem, ModelValues]
# Of the points that a fit may use and of others: the others' problem with the nominal values, and that with the fit's.
Predictor = Callable[[Points, Points], tuple[Prediction, Prediction]]
Measure = Literal["error", "scatter"]


@dataclass(frozen=True, slots=True)
class Fold:
    """One left-out part: `rows` of the points, distances [m] of each before (nominal) and after calibration.

    `measure`: "error" against the reference, or "scatter" about the mean of the cavity's predicted tips.
    """

    name: str
    rows: tuple[int, ...]
    measure: Measure
    before_m: Array
    after_m: Array

    @property
    def mean_before_m(self) -> float:
        """Mean distance with nominal parameters."""
        return float(np.mean(self.before_m))

    @property
    def mean_after_m(self) -> float:
        """Mean distance with parameters from the other points."""
        return float(np.mean(self.after_m))

    @property
    def rms_after_m(self) -> float:
        """Root mean square distance after calibration."""
        return float(np.sqrt(np.mean(self.after_m**2)))

    @property
    def max_after_m(self) -> float:
        """Largest distance after calibration."""
        return float(np.max(self.after_m))


@dataclass(frozen=True, slots=True)
class HeldOut:
    """All folds; `by`: "setup", or k for every k-th point."""

    by: str
    folds: tuple[Fold, ...]

    @property
    def before_m(self) -> Array:
        """Distances of all left-out points with nominal parameters."""
        return np.concatenate([fold.before_m for fold in self.folds])

    @property
    def after_m(self) -> Array:
        """Distances with parameters from the other points."""
        return np.concatenate([fold.after_m for fold in self.folds])

    @property
    def improvement_percent(self) -> float:
        """100 (before - after) / before of the means; negative if worse."""
        return improvement_percent(float(np.mean(self.before_m)), float(np.mean(self.after_m)))

    def without(self, rows: Collection[int]) -> HeldOut | None:
        """The folds without these points; None if nothing is left."""
        folds = []
        for fold in self.folds:
            remaining = [k for k, row in enumerate(fold.rows) if row not in rows]
            if remaining:
                names = tuple(fold.rows[k] for k in remaining)
                folds.append(replace(fold, rows=names, before_m=fold.before_m[remaining], after_m=fold.after_m[remaining]))
        return HeldOut(self.by, tuple(folds)) if folds else None

    @property
    def is_scatter(self) -> bool:
        """Whether only the scatter could be evaluated."""
        return all(fold.measure == "scatter" for fold in self.folds)

    def in_words(self) -> tuple[str, ...]:
        """One sentence per fold."""
        what = "scatter" if self.is_scatter else "error"
        return tuple(
            f"Held out {fold.name} ({len(fold.rows)} points): {what} mean {1e3 * fold.mean_before_m:.3f} mm before,"
            f" {1e3 * fold.mean_after_m:.3f} mm after (rms {1e3 * fold.rms_after_m:.3f}, largest"
            f" {1e3 * fold.max_after_m:.3f})."
            for fold in self.folds
        )


def held_out(
    predictor: Predictor,
    points: Points,
    by: Literal["setup"] | int | None = None,
    report: Callable[[int, int], None] | None = None,
) -> HeldOut:
    """Leave out each setup (`by` "setup"; free poses in parts) or every k-th point (`by` k).

    By default setups if there are several, else every fifth point.

    `predictor` makes the fit whose predictions are judged; `report` gets the number of folds done, and the total.
    CalibrationError if nothing can be left out.
    """
    chosen = by if by is not None else ("setup" if len(set(points.setup)) > 1 else FOLDS_COUNT)
    parts = _setups(points) if chosen == "setup" else _every(points, chosen)
    folds: list[Fold] = []
    for name, rows in parts:
        folds += _fold(predictor, points, name, rows)
        if report is not None:
            report(len(folds), len(parts))
    if not folds:
        raise CalibrationError("held-out error: no held-out point can be predicted from the others")
    return HeldOut("setup" if chosen == "setup" else f"every {chosen}th point", tuple(folds))


def _setups(points: Points) -> list[tuple[str, list[int]]]:
    names = list(dict.fromkeys(points.setup))
    if len(names) < 2:
        raise CalibrationError(
            f'held-out error: expected two setups or more, got one ("{names[0]}"); hold out every {FOLDS_COUNT}th point instead'
        )
    parts = []
    for name in names:
        rows = [k for k, setup in enumerate(points.setup) if setup == name]
        parts += _free_parts(points, rows) if name == FREE else [(f'setup "{name}"', rows)]
    return parts


def _free_parts(points: Points, rows: list[int]) -> list[tuple[str, list[int]]]:
    """Parts of the free poses, which share no board: they are left out part by part."""
    points_names = list(dict.fromkeys(points.point[k] for k in rows))
    if len(points_names) < GROUPS_PER_FOLD * FREE_PARTS:
        return [(f'setup "{FREE}"', rows)]
    place = {name: i % FREE_PARTS for i, name in enumerate(points_names)}
    return [
        (f'part {j + 1} of {FREE_PARTS} of setup "{FREE}"', [k for k in rows if place[points.point[k]] == j])
        for j in range(FREE_PARTS)
    ]


def _every(points: Points, k: int) -> list[tuple[str, list[int]]]:
    """Interleaved folds; repeats of a point stay together if there are enough points."""
    if not 2 <= k <= len(points):
        raise CalibrationError(f"held-out error: expected to hold out every k-th point, k from 2 to {len(points)}; got {k}")
    if not seen_again(zip(points.setup, points.point, strict=True)):  # a table of very many names is large
        return [(f"part {j + 1} of {k}", list(range(j, len(points), k))) for j in range(k)]
    keys: list[object] = list(zip(points.setup, points.point, strict=True))
    if len(set(keys)) < GROUPS_PER_FOLD * k:
        keys = list(range(len(points)))
    place = {key: i % k for i, key in enumerate(dict.fromkeys(keys))}
    return [(f"part {j + 1} of {k}", [row for row, key in enumerate(keys) if place[key] == j]) for j in range(k)]


def _fold(predictor: Predictor, points: Points, name: str, rows: Sequence[int]) -> list[Fold]:
    """Evaluate one left-out part; None if it has no reference and no two tips of one cavity."""
    is_left_out = np.zeros(len(points), dtype=np.bool_)
    is_left_out[list(rows)] = True
    before, after = predictor(points.chosen(np.flatnonzero(~is_left_out)), points.chosen(list(rows)))
    seen, values = after
    known = {frame.name for frame in values.frames}
    is_referred = np.array([_is_known(seen, k, known) for k in range(len(seen))])
    groups = _cavity_groups(seen, ~is_referred)
    used = np.flatnonzero(is_referred | (groups >= 0))
    if not len(used):
        return []
    distances = [_distances(*one, is_referred, groups)[used] for one in (before, after)]
    measure: Measure = "error" if is_referred.any() else "scatter"
    return [Fold(name, tuple(rows[int(k)] for k in used), measure, frozen(distances[0]), frozen(distances[1]))]


def _is_known(seen: ArmProblem, row: int, known: set[str]) -> bool:
    """Whether the pose of a row's frame is known without the row."""
    frame = seen.observed.frames[seen.observed.frame[row]]
    return frame.name in known or not frame.is_free


def _cavity_groups(seen: ArmProblem, wanted: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
    """A number for each cavity of each frame with two or more rows, -1 for other rows."""
    keys = [
        (int(frame), tuple(position))
        for frame, position in zip(seen.observed.frame, seen.observed.position_m.tolist(), strict=True)
    ]
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    several = {key for key, count in Counter(keys).items() if count > 1}
    return np.array([numbers[key] if key in several and wanted[row] else -1 for row, key in enumerate(keys)])


def _distances(
    seen: ArmProblem, solution: ModelValues, is_referred: npt.NDArray[np.bool_], groups: npt.NDArray[np.intp]
) -> Array:
    """Distance of each row's tip from its reference, or from the mean of its cavity's tips, (m,)."""
    observed, tips = seen.observed, seen.tips(solution)
    wanted = np.array(tips)
    frames = {frame.name: frame for frame in solution.frames}
    for k, frame in enumerate(observed.frames):
        rows = observed.rows_of(k)
        rows = rows[is_referred[rows]]
        wanted[rows] = frames.get(frame.name, frame).to_base(observed.position_m[rows])
    for group in set(groups[groups >= 0].tolist()):
        rows = np.flatnonzero(groups == group)
        wanted[rows] = tips[rows].mean(axis=0)
    return norms(wanted - tips)
