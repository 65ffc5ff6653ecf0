"""Detects misread points: degrees, counts, millimetres, swapped or rotated columns.

At nominal parameters a calibration starts some millimetres to some centimetres from the points. If it starts more than
about 10 cm away, and another reading of the columns starts close, that reading is the intended one. If there is none,
the points are not of this arm.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator

import numpy as np

from calib.arm_problem.observations import Observations
from calib.arm_problem.problem import ArmProblem
from calib.arm_problem.starts import started_tool, with_started_frames
from calib.arrays import Array, norms
from calib.errors import UnusablePointsError
from control.model.arm import Arm

ODD_m = 0.01  # median distance at nominal below which no check is made
NEARER = 4.0  # factor by which another reading must reduce the distance
FAR_TIMES = 1.5  # the reach of all bounds together, some 0.1 m: no deviation explains a distance beyond
WHOLE_PERMUTATIONS_JOINTS = (
    4  # up to this count all orders of the joints are tried, beyond only swapped pairs
)
AS_GOOD = 1.5  # readings this close to the best are ambiguous: a mirrored arm has mirrored deviations
REPORTED_LIMIT = 3
ROWS_LIMIT = 300  # this many rows suffice

Reading = tuple[str, Array, Array]


def require_read_as_meant(arm: Arm, problem: ArmProblem) -> None:
    """UnusablePointsError says how the columns should be read, or that the points are of another arm."""
    observed = _some(problem.observed)
    as_read = _distance_m(problem, observed)
    if as_read < ODD_m:
        return
    tried = [
        (_distance_m(problem, dataclasses.replace(observed, q_rad=q, position_m=position)), description)
        for description, q, position in _readings(arm, observed)
    ]
    best = min(distance for distance, _ in tried)
    if best < as_read / NEARER:
        alike = [description for distance, description in tried if distance < AS_GOOD * best]
        raise UnusablePointsError(
            f"{', or '.join(alike[:REPORTED_LIMIT])}: the nominal arm would then be {1e3 * best:.1f} mm from the points (median);"
            f" with the file as given it is {_length(as_read)}; correct the file"
        )
    reach = _reach_m(problem)
    if as_read > FAR_TIMES * reach:
        raise UnusablePointsError(
            f"the nominal arm is {_length(as_read)} from the points (median), expected at most {1e3 * reach:.0f} mm, which all"
            " deviations within their bounds explain: check that the points are of this arm and use its zeros"
        )


def _some(observed: Observations) -> Observations:
    """At most ROWS_LIMIT evenly spaced poses, without corrections, with free frames unplaced."""
    frames = tuple(dataclasses.replace(frame, is_placed=not frame.is_free) for frame in observed.frames)
    chosen = observed.chosen(np.arange(len(observed))[_spread(len(observed))])
    return dataclasses.replace(chosen, frames=frames, corrections=())


def _spread(count: int) -> slice:
    """Rows of `count` that are evenly spaced, at most ROWS_LIMIT."""
    return slice(None, None, max(1, -(-count // ROWS_LIMIT)))


def _distance_m(problem: ArmProblem, observed: Observations) -> float:
    """Median distance at nominal, unknown tool and boards where they fit best."""
    model = problem.model
    is_tool_free = any(parameter.name.startswith("tool_") for parameter in problem.parameters)
    tool = started_tool(model, observed) if is_tool_free else model.nominal_tool_m
    placed = with_started_frames(model, observed, tool)
    references = np.empty_like(observed.position_m)
    for k, frame in enumerate(placed.frames):
        rows = placed.rows_of(k)
        references[rows] = frame.to_base(observed.position_m[rows])
    return float(np.median(norms(references - model.tips(model.nominal_dh, observed.q_rad, tool))))


def _reach_m(problem: ArmProblem) -> float:
    """Largest displacement of a tip with all bounded parameters at their bounds, median over evenly spaced points."""
    bounded = [k for k, p in enumerate(problem.parameters) if p.has_bound]
    nominal, rows = np.zeros(len(problem.parameters)), _spread(len(problem))
    jacobian = problem.residuals_and_jacobian(nominal, rows)[1][:, :, bounded]
    limits = np.array([problem.parameters[k].limit for k in bounded])
    return float(np.median(np.sum(np.linalg.norm(jacobian, axis=1) * limits, axis=1)))


def _readings(arm: Arm, observed: Observations) -> Iterator[Reading]:
    """All other readings of the columns: description, joint angles, positions."""
    q, position = observed.q_rad, observed.position_m
    yield "the joint angles look like degrees", np.radians(q), position
    if len(arm.drives) == q.shape[1]:
        counts = np.array([drive.encoder_counts_per_rev * drive.gear_ratio for drive in arm.drives])
        zeros = np.array([drive.zero_count for drive in arm.drives])
        yield "the joint angles look like encoder counts", 2.0 * math.pi * (q - zeros) / counts, position
    yield from _joint_columns(q, position)
    if any(frame.name == "base" for frame in (observed.frames[k] for k in set(observed.frame.tolist()))):
        yield "the positions look like millimetres", q, 1e-3 * position
        yield "joint angles look like degrees and positions like millimetres", np.radians(q), 1e-3 * position
        yield from _position_columns(q, position)


def _joint_columns(q: Array, position: Array) -> Iterator[Reading]:
    n = q.shape[1]
    for order in _orders(n):
        wrong = [j for j in range(n) if order[j] != j]
        names = [f"q{j + 1}_rad" for j in wrong]
        yield f"the columns {_listed(names)} look swapped", q[:, order], position
    for j in range(n):
        flipped = q.copy()
        flipped[:, j] *= -1.0
        yield f"the sign of q{j + 1}_rad looks inverted", flipped, position
    if n > 1:
        yield "the signs of all joint angles look inverted", -q, position
    for j, quarter in itertools.product(range(n), (1, 2, 3)):
        shifted = q.copy()
        shifted[:, j] += quarter * math.pi / 2
        yield (
            f"q{j + 1}_rad looks {90 * quarter if quarter < 3 else -90} deg short of this arm's zero",
            shifted,
            position,
        )


def _position_columns(q: Array, position: Array) -> Iterator[Reading]:
    for order in itertools.permutations(range(3)):
        if order != (0, 1, 2):
            names = [f"{'xyz'[j]}_m" for j in range(3) if order[j] != j]
            yield f"the columns {_listed(names)} look swapped", q, position[:, order]
    for axis in range(3):
        flipped = position.copy()
        flipped[:, axis] *= -1.0
        yield f"the sign of {'xyz'[axis]}_m looks inverted", q, flipped


def _orders(n: int) -> Iterator[list[int]]:
    """Other orders of n columns."""
    if n <= WHOLE_PERMUTATIONS_JOINTS:
        yield from (
            list(order) for order in itertools.permutations(range(n)) if list(order) != list(range(n))
        )
        return
    for i, j in itertools.combinations(range(n), 2):
        order = list(range(n))
        order[i], order[j] = j, i
        yield order


def _length(distance_m: float) -> str:
    return f"{1e3 * distance_m:.0f} mm" if distance_m < 1.0 else f"{distance_m:.3g} m"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
