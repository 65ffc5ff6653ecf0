"""Points that no calibration can be made of are refused before a solver sees them; what is odd about others is said."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of, referenced
from calib.arm_problem.misread import require_read_as_meant
from calib.arm_problem.other_arm import require_own_arm
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.errors import UnusablePointsError
from calib.points.points import Points
from control.model.arm import Arm

POINTS_MINIMUM_COUNT = 4
LINE_TOLERANCE = 5e-3  # spread across the best line, as a share of the spread along it: 1 mm for 0.2 m
OTHER_POSTURE_rad = 0.05  # between postures in one cavity that tell more than one posture does
SAME_PLACE_m = 1e-3
TURNS_LIMIT_rad = 6 * math.pi  # no joint turns more than three times
COPIES_SHARE = 0.5  # of points that are copies of others: not a session any more
STILL_rad = 1e-4


def require_of_arm(arm: Arm, points: Points, choice: Choice | None = None) -> tuple[str, ...]:
    """Warnings about points that are what their columns say, and of this arm; UnusablePointsError for others.

    Everything that takes points checks them here: numbers that are none, copies, degrees, counts, millimetres, swapped or turned
    columns, another arm. Rows are named as poses, counted from 1, with the file's line in brackets (the header is line 1).
    """
    warnings = _copies(points)
    wanted = (choice or Choice()).for_points(arm, points)
    told = require_columns_meant(arm, points, wanted)
    if len(told) >= POINTS_MINIMUM_COUNT:
        require_own_arm(arm, told, wanted)
    return warnings


def require_columns_meant(arm: Arm, points: Points, choice: Choice) -> Points:
    """The poses that say where the tip was; UnusablePointsError for columns in other units, swapped, turned, or no numbers."""
    require_finite(points.q_rad, np.zeros((0, 3)))
    told = referenced(arm, points, choice)
    if len(told) >= POINTS_MINIMUM_COUNT:
        require_read_as_meant(arm, problem_of(arm, told, choice))
    _require_radians(points.q_rad)
    return told


def require_usable(
    arm: Arm, points: Points, problem: ArmProblem, choice: Choice | None = None
) -> tuple[str, ...]:
    """`require_of_arm`, and points enough for a calibration: not too few places, nor all on a line."""
    require_finite(problem.observed.q_rad, problem.observed.position_m)
    _require_count(problem.observed.q_rad, problem.references_m)
    warnings = require_of_arm(arm, points, choice)
    require_sound(problem)
    return (*warnings, *_still_joints(points.q_rad))


def require_sound(problem: ArmProblem) -> None:
    """UnusablePointsError for what makes any solver fail: numbers that are none, too few points, a line, no radians."""
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
    """Points on one line tell little, unless the same place was taken in several postures."""
    spread = np.linalg.svd(references_m - references_m.mean(axis=0), compute_uv=False)
    if spread[1] <= LINE_TOLERANCE * spread[0] and not _has_several_postures(q_rad, references_m):
        raise UnusablePointsError(
            "all points lie on one straight line: record points that span an area, such as the circle"
        )


def _has_several_postures(q_rad: Array, references_m: Array) -> bool:
    """Whether one place was taken in postures that differ."""
    _, places = np.unique(np.round(references_m / SAME_PLACE_m), axis=0, return_inverse=True)
    flat = np.asarray(places).ravel()
    return any(np.ptp(q_rad[flat == place], axis=0).max() > OTHER_POSTURE_rad for place in set(flat.tolist()))


def _require_radians(q_rad: Array) -> None:
    """Beyond three turns, somebody wrote degrees or counts."""
    largest = float(np.max(np.abs(q_rad)))
    if largest > TURNS_LIMIT_rad:
        joint = int(np.argmax(np.max(np.abs(q_rad), axis=0))) + 1
        raise UnusablePointsError(
            f"q{joint}_rad reaches {largest:.6g}, more than three turns: expected radians, not degrees or counts"
        )


def _copies(points: Points) -> tuple[str, ...]:
    """A warning about rows that are copies; refused where most are: repeats differ by noise, copies do not."""
    seen: dict[tuple[object, ...], int] = {}
    copies: list[tuple[int, int]] = []
    for row in range(len(points)):
        key = (points.setup[row], points.point[row], points.q_rad[row].tobytes(), points.tip_m[row].tobytes())
        if key in seen:
            copies.append((seen[key], row))
        else:
            seen[key] = row
    if not copies:
        return ()
    told = ", ".join(
        f"{first + 1} and {row + 1} (lines {first + 2} and {row + 2})" for first, row in copies[:3]
    )
    more = f" and {len(copies) - 3} more" if len(copies) > 3 else ""
    said = f"poses {told}{more} are identical to the last digit: they are copies, not repeats, and add no information"
    if len(copies) >= COPIES_SHARE * len(points):
        raise UnusablePointsError(f"{said}; remove the copies")
    return (said,)


def _still_joints(q_rad: Array) -> tuple[str, ...]:
    still = [f"q{j + 1}_rad" for j in np.flatnonzero(np.ptp(q_rad, axis=0) < STILL_rad)]
    return (f"{_listed(still)} never changes: these points do not test that joint",) if still else ()


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
