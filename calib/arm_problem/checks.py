"""Checks of points before a calibration: unusable points are refused, unusual ones give warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of, referenced
from calib.arm_problem.misread.other_arm import require_own_arm
from calib.arm_problem.misread.points import require_read_as_meant
from calib.arm_problem.misread.turns import require_turns_meant
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.errors import UnusablePointsError
from calib.points.points import Points, seen_again
from control.model.arm import Arm

POINTS_MINIMUM_COUNT = 4
LINE_TOLERANCE = 5e-3  # spread across the best line, as a share of the spread along it: 1 mm for 0.2 m
OTHER_POSTURE_rad = 0.05  # between postures in one cavity that count as different
SAME_PLACE_m = 1e-3
TURNS_LIMIT_rad = 6 * math.pi  # no joint turns more than three times
COPIES_SHARE = 0.5  # of points that are copies of others: not a valid session
STILL_rad = 1e-4


def require_of_arm(arm: Arm, points: Points, choice: Choice | None = None) -> tuple[str, ...]:
    """Return warnings for points in the right units and of this arm; UnusablePointsError for others.

    All users of points check them here: non-finite numbers, copies, degrees, counts, millimetres, swapped or rotated
    columns, another arm. Rows are named as poses, counted from 1, with the file's line in brackets (the header is line 1).
    """
    warnings = _copies(points)
    wanted = (choice or Choice()).for_points(arm, points)
    referenced_points = require_columns_meant(arm, points, wanted)
    if len(referenced_points) >= POINTS_MINIMUM_COUNT:
        warnings = (*warnings, *require_own_arm(arm, referenced_points, wanted))
    return warnings


def require_columns_meant(arm: Arm, points: Points, choice: Choice) -> Points:
    """Return the poses with a known tip; UnusablePointsError for columns in other units, swapped, rotated, or not finite."""
    require_finite(points.q_rad, np.zeros((0, 3)))
    referenced_points = referenced(arm, points, choice)
    if len(referenced_points) >= POINTS_MINIMUM_COUNT:
        require_read_as_meant(arm, problem_of(arm, referenced_points, choice))
    _require_radians(points.q_rad)
    return referenced_points


def require_usable(
    arm: Arm, points: Points, problem: ArmProblem, choice: Choice | None = None
) -> tuple[str, ...]:
    """`require_of_arm`, and enough points for a calibration: not too few places, not all on a line."""
    require_finite(problem.observed.q_rad, problem.observed.position_m)
    _require_count(problem.observed.q_rad, problem.references_m)
    warnings = require_of_arm(arm, points, choice)
    require_sound(problem)
    require_turns_meant(problem)
    return (*warnings, *_still_joints(points.q_rad))


def require_sound(problem: ArmProblem) -> None:
    """UnusablePointsError for points with which any solver fails: not finite, too few, on a line, not in radians."""
    observed = problem.observed
    require_finite(observed.q_rad, observed.position_m)
    _require_count(observed.q_rad, problem.references_m)
    _require_spread(observed.q_rad, problem.references_m)
    _require_radians(observed.q_rad)


def require_finite(q_rad: Array, position_m: Array) -> None:
    """UnusablePointsError that names the first angle or coordinate that is not a finite number."""
    for values, names in (
        (q_rad, [f"q{j + 1}_rad" for j in range(q_rad.shape[1])]),
        (position_m, ["x_m", "y_m", "z_m"]),
    ):
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, column = bad[0]
            what = "joint angle" if values is q_rad else "tip position"
            rows = len(set(bad[:, 0].tolist()))
            raise UnusablePointsError(
                f"{what} of point {row + 1} (line {row + 2}, {names[column]}) is not a finite number ({rows} such"
                f" point{'s' if rows > 1 else ''})"
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
        raise UnusablePointsError(
            "all points lie on one straight line: record points that span an area, such as the circle"
        )


def _has_several_postures(q_rad: Array, references_m: Array) -> bool:
    """Whether a place was recorded in different postures."""
    _, places = np.unique(np.round(references_m / SAME_PLACE_m), axis=0, return_inverse=True)
    flat = np.asarray(places).ravel()
    return any(np.ptp(q_rad[flat == place], axis=0).max() > OTHER_POSTURE_rad for place in set(flat.tolist()))


def _require_radians(q_rad: Array) -> None:
    """Refuse angles beyond three turns: they are degrees or counts."""
    largest = float(np.max(np.abs(q_rad)))
    if largest > TURNS_LIMIT_rad:
        joint = int(np.argmax(np.max(np.abs(q_rad), axis=0))) + 1
        raise UnusablePointsError(
            f"q{joint}_rad reaches {largest:.6g}, more than three turns: expected radians, not degrees or counts"
        )


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
    listed_rows = ", ".join(
        f"{first + 1} and {row + 1} (lines {first + 2} and {row + 2})" for first, row in copies[:3]
    )
    more = f" and {len(copies) - 3} more" if len(copies) > 3 else ""
    warning = f"poses {listed_rows}{more} are identical to the last digit: they are copies, not repeats, and add no information"
    if len(copies) >= COPIES_SHARE * len(points):
        raise UnusablePointsError(f"{warning}; remove the copies")
    return (warning,)


def _still_joints(q_rad: Array) -> tuple[str, ...]:
    still = [f"q{j + 1}_rad" for j in np.flatnonzero(np.ptp(q_rad, axis=0) < STILL_rad)]
    return (f"{_listed(still)} never changes: these points do not test that joint",) if still else ()


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
