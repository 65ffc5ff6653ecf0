"""Checks of points before a calibration: unusable points are refused, unusual ones give warnings."""

from __future__ import annotations

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of, referenced
from calib.arm_problem.misread import AS_GIVEN, Doubt, doubts_of_arm, doubts_of_reading, doubts_of_turns
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.errors import UnusablePointsError
from calib.points.points import Points, require_radians, seen_again
from control.model.arm import Arm
from control.plain_text import first_of, listed

POINTS_MINIMUM_COUNT = 4
LINE_TOLERANCE = 5e-3  # spread across the best line, as a share of the spread along it: 1 mm for 0.2 m
OTHER_POSTURE_rad = 0.05  # between postures in one cavity that count as different
SAME_PLACE_m = 1e-3
COPIES_SHARE = 0.5  # of points that are copies of others: not a valid session
STILL_rad = 1e-4


def require_of_arm(arm: Arm, points: Points, choice: Choice | None = None) -> tuple[str, ...]:
    """Return warnings for points in the right units and of this arm; UnusablePointsError for others.

    All users of points check them here: non-finite numbers, copies, degrees, counts, millimetres, swapped or rotated
    columns, another arm. Rows are named as poses, counted from 1, with the file's line in brackets (the header is line 1).
    """
    wanted = (choice or Choice()).for_points(arm, points)
    warnings = (*_copies(points), *require_columns_meant(arm, points, wanted))
    known = referenced(arm, points, wanted)
    if len(known) < POINTS_MINIMUM_COUNT:
        return warnings
    return (*warnings, *(one.in_words() for one in doubts_of_arm(arm, known, wanted)))


def require_columns_meant(arm: Arm, points: Points, choice: Choice) -> tuple[str, ...]:
    """Warnings about columns that look like other units, swapped or rotated; UnusablePointsError where they cannot be right."""
    require_finite(points.q_rad, np.zeros((0, 3)))
    known = referenced(arm, points, choice)
    doubts: tuple[Doubt, ...] = ()
    if len(known) >= POINTS_MINIMUM_COUNT:
        doubts = doubts_of_reading(arm, problem_of(arm, known, choice), points.is_as_given)
    require_radians(points.q_rad)
    return tuple(one.in_words() for one in doubts)


def require_usable(arm: Arm, points: Points, problem: ArmProblem, choice: Choice | None = None) -> tuple[str, ...]:
    """`require_of_arm`, and enough points for a calibration: not too few places, not all on a line."""
    require_finite(problem.observed.q_rad, problem.observed.position_m)
    _require_count(problem.observed.q_rad, problem.references_m)
    warnings = require_of_arm(arm, points, choice)
    require_sound(problem)
    turned = doubts_of_turns(problem, points.is_as_given)
    return (*warnings, *(one.in_words() for one in turned), *_still_joints(points.q_rad))


def require_sound(problem: ArmProblem) -> None:
    """UnusablePointsError for points with which any solver fails: not finite, too few, on a line, not in radians."""
    observed = problem.observed
    require_finite(observed.q_rad, observed.position_m)
    _require_count(observed.q_rad, problem.references_m)
    _require_spread(observed.q_rad, problem.references_m)
    require_radians(observed.q_rad)


def require_finite(q_rad: Array, position_m: Array) -> None:
    """UnusablePointsError that names the first angle or coordinate that is not a finite number."""
    for values, names in ((q_rad, [f"q{j + 1}_rad" for j in range(q_rad.shape[1])]), (position_m, ["x_m", "y_m", "z_m"])):
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, column = bad[0]
            what = "joint angle" if values is q_rad else "tip position"
            rows = len(set(bad[:, 0].tolist()))
            raise UnusablePointsError(
                f"{what} of point {row + 1} ({names[column]}) is not a finite number ({rows} such point{'s' if rows > 1 else ''})"
            )


def _require_count(q_rad: Array, references_m: Array) -> None:
    poses = len(np.unique(np.hstack((q_rad, references_m)), axis=0))
    if poses < POINTS_MINIMUM_COUNT:
        raise UnusablePointsError(
            f"{poses} different points are too few: record {POINTS_MINIMUM_COUNT} or more, or the whole board"
        )


def _require_spread(q_rad: Array, references_m: Array) -> None:
    """Refuse points on one line, unless the same place was recorded in several postures."""
    spread = np.linalg.svd(references_m - references_m.mean(axis=0), compute_uv=False)
    if spread[1] <= LINE_TOLERANCE * spread[0] and not _has_several_postures(q_rad, references_m):
        raise UnusablePointsError("all points lie on one straight line: record points that span an area, such as the circle")


def _has_several_postures(q_rad: Array, references_m: Array) -> bool:
    """Whether a place was recorded in different postures."""
    _, places = np.unique(np.round(references_m / SAME_PLACE_m), axis=0, return_inverse=True)
    flat = np.asarray(places).ravel()
    return any(np.ptp(q_rad[flat == place], axis=0).max() > OTHER_POSTURE_rad for place in set(flat.tolist()))


def _copies(points: Points) -> tuple[str, ...]:
    """A warning about identical rows; refused if most are: repeats differ by noise, copies do not."""
    seen: dict[tuple[object, ...], int] = {}
    copies: list[tuple[int, int]] = []
    for row in seen_again(zip(points.setup, points.point, map(bytes, points.q_rad), strict=True)):
        key = (points.setup[row], points.point[row], points.q_rad[row].tobytes(), points.tip_m[row].tobytes())
        if key in seen:
            copies.append((seen[key], row))
        else:
            seen[key] = row
    if not copies:
        return ()
    rows = first_of([f"{first + 1} and {row + 1} (lines {first + 2} and {row + 2})" for first, row in copies], 3)
    warning = f"poses {rows} are identical to the last digit: they are copies, not repeats, and add no information"
    if len(copies) >= COPIES_SHARE * len(points) and not points.is_as_given:
        raise UnusablePointsError(f"{warning}; remove the copies, or {AS_GIVEN}")
    return (warning,)


def still_joints(q_rad: Array) -> tuple[str, ...]:
    """The columns of joints that never move."""
    return tuple(f"q{j + 1}_rad" for j in np.flatnonzero(np.ptp(q_rad, axis=0) < STILL_rad))


def _still_joints(q_rad: Array) -> tuple[str, ...]:
    still = still_joints(q_rad)
    return (f"{listed(still)} never changes: these points do not test that joint",) if still else ()
