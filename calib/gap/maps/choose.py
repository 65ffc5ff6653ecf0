"""Which tables a map needs, how smooth they are, and whether they help recordings that were not fitted.

All is linear: y = base @ b + sum of tables + noise. Tables come in one after the other, each time the one that best foretells
recordings left out in turn; those that report are looked at once, at the end, and decide whether anything is written.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from calib.arm_problem.arm_model import prior_sd
from calib.arm_problem.assembly import problem_of
from calib.arm_problem.joint_effects import along, node_values, spline_columns
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, Mask, rms
from calib.calibration import with_base_frame
from calib.gap.effects.record import load_of
from calib.gap.finding import MapCheck
from calib.gap.poses.linear import Fit, along_joint, by_joints
from calib.gap.poses.outcome import StaticGap
from calib.gap.posterior.constants import LARGE, PAYS, CHECKED_sd, SURE_sd
from calib.identify.objective import LeastSquares
from calib.identify.solver import minimise
from calib.points.points import Points
from control.model.arm import Arm
from control.model.maps import NODES_LEAST, CorrectionMap, Corrects, Over

# Nodes by variable: their distance, and the most. What is finer than a node is not followed.
# of a joint's angle: an eccentricity's fourth harmonic has eight nodes a period
NODE_rad, NODES_MOST = 0.2, 33
NODES_OF_LOAD, NODES_OF_SPEED = 7, 13
MEASURED = 0.999  # of the values lie below the upper end of a table, and above its lower
LOAD_LEAST = 0.05  # of a load, by which it must change
# Of a motor turn: six nodes a period for a motor of few poles, of many, and for 72 periods a turn, the most that motors have.
NODES_OF_TURN = (36, 144, 432)
# Standard deviation of the bend from node to node, of the usual size: from a straight line's to no rule at all.
BENDS: Final = (0.03, 0.2, 1.0)
LEVEL: Final = 1.0  # standard deviation of the values themselves, of the usual size: they are hardly held


@dataclass(frozen=True, slots=True)
class Candidate:
    """One part of a map: the same in both directions, or, `is_directed`, with the sign of the motion."""

    joint: int
    corrects: Corrects
    over: Over
    count: int
    lower: float
    upper: float
    is_directed: bool = False

    @property
    def is_periodic(self) -> bool:
        """Whether it goes round."""
        return self.over == "motor_turn_rad"

    def columns(self, x: Array, direction: Array) -> sparse.csr_array:
        """What the spline of each node does at places x (m,) and directions (m,), (m, count)."""
        splines = spline_columns(self.count, self.lower, self.upper, self.is_periodic, x)
        return sparse.csr_array(sparse.diags_array(direction) @ splines) if self.is_directed else splines

    def precision(self, bend: float) -> Array:
        """Inverse of the prior covariance of the splines' coefficients over the usual size squared, (count, count)."""
        unit = np.eye(self.count)
        ahead, behind = np.roll(unit, 1, axis=1), np.roll(unit, -1, axis=1)
        bends = ahead - 2.0 * unit + behind
        if not self.is_periodic:
            bends = bends[1:-1]
        return np.asarray(bends.T @ bends / bend**2 + unit / LEVEL**2)


def over_angle(joint: int, corrects: Corrects, q_rad: Array) -> tuple[Candidate, ...]:
    """Tables over a joint's angle."""
    lower, upper = _range(q_rad)
    count = min(max(math.ceil((upper - lower) / NODE_rad) + 1, NODES_LEAST), NODES_MOST)
    candidate = Candidate(joint, corrects, "angle_rad", count, lower, upper)
    return _both(candidate) if upper - lower > NODE_rad else ()


def over_load(joint: int, corrects: Corrects, load_Nm: Array, least_Nm: float = 0.0) -> tuple[Candidate, ...]:
    """Tables over what a joint transmits; none where that changes by no more than `least_Nm`."""
    lower, upper = _range(load_Nm)
    is_varied = upper - lower > max(least_Nm, LOAD_LEAST * max(abs(lower), abs(upper)))
    candidate = Candidate(joint, corrects, "load_Nm", NODES_OF_LOAD, lower, upper)
    return _both(candidate) if is_varied else ()


def over_speed(joint: int, speed_rad_s: Array) -> tuple[Candidate, ...]:
    """A table over the joint's speed, both signs."""
    lower, upper = _range(speed_rad_s)
    candidate = Candidate(joint, "torque_Nm", "speed_rad_s", NODES_OF_SPEED, lower, upper)
    return (candidate,) if lower < upper else ()


def over_turn(joint: int, travel_rad: float) -> tuple[Candidate, ...]:
    """Tables over a turn of the joint's motor, coarse to fine; none if it never went round (`travel_rad`, of the motor)."""
    if travel_rad < math.tau:
        return ()
    return tuple(Candidate(joint, "torque_Nm", "motor_turn_rad", count, 0.0, math.tau) for count in NODES_OF_TURN)


def _range(values: Array) -> tuple[float, float]:
    """Where nearly all were measured; beyond, a table keeps its end value."""
    lower, upper = np.quantile(values, (1.0 - MEASURED, MEASURED))
    return float(lower), float(upper)


def _both(candidate: Candidate) -> tuple[Candidate, ...]:
    """The same both ways, and with the direction."""
    return candidate, replace(candidate, is_directed=True)


def maps_of(parts: list[tuple[Candidate, Array]]) -> tuple[CorrectionMap, ...]:
    """Candidates with the coefficients of their splines as maps; both parts of one table become one."""
    tables: dict[tuple[int, Over], dict[bool, Array]] = {}
    first: dict[tuple[int, Over], Candidate] = {}
    for part, coefficients in parts:
        where = part.joint, part.over
        tables.setdefault(where, {})[part.is_directed] = node_values(coefficients, part.is_periodic)
        first.setdefault(where, part)
    maps = []
    for where, table in tables.items():
        part = first[where]
        plain, directed = (tuple(table[way].tolist()) if way in table else () for way in (False, True))
        plain = plain or (0.0,) * part.count
        maps.append(CorrectionMap(part.joint, part.corrects, part.over, plain, part.lower, part.upper, directed))
    return tuple(maps)


@dataclass(frozen=True, slots=True)
class DrawnMap:
    """A map over its variable: at places `at` (k,) what all else leaves, `data`, and what the map says, `table` (k,), in SI."""

    map: CorrectionMap
    at: Array
    data: Array
    table: Array


@dataclass(frozen=True, slots=True)
class MapsFound:
    """The maps that help, how much, and what was said where none does."""

    drawn: tuple[DrawnMap, ...]
    checks: tuple[MapCheck, ...]
    sentences: tuple[str, ...] = ()

    @property
    def maps(self) -> tuple[CorrectionMap, ...]:
        """As arm.toml has them."""
        return tuple(drawn.map for drawn in self.drawn)

    def __add__(self, other: MapsFound) -> MapsFound:
        """Both."""
        return MapsFound(self.drawn + other.drawn, self.checks + other.checks, self.sentences + other.sentences)


# Standard deviations by which the gain of all pieces, or the count of those that gain, has to stand out of nothing: of some sixty
# tables that are tried, none may get in by chance. A few pieces far from the model would hide a gain from the mean, and many that
# lie still would hide it from the count.
TABLES_MOST = 12
Places = npt.NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class MapRows:
    """Rows y (r,) over their noise; `base` (r, b) with `base_precision` (b,) is fitted beside every map.

    `tables` (r, c) per candidate, per usual size of its coefficients. `folds` (r,): left out in turn, -1: reports, less: not
    used. `pieces` (r,): rows of one number hang together.
    """

    y: Array
    base: Array
    base_precision: Array
    candidates: tuple[Candidate, ...]
    tables: tuple[Array, ...]
    folds: Places
    pieces: Places

    @property
    def reports(self) -> Mask:
        """Rows that only report."""
        return np.asarray(self.folds == -1)


@dataclass(frozen=True, slots=True)
class Chosen:
    """Tables by number with the coefficients of their splines in usual sizes, the base's values, and rows left (r,)."""

    numbers: tuple[int, ...]
    values: tuple[Array, ...]
    base: Array
    before: Array
    after: Array


def chosen(measured: MapRows) -> Chosen | None:
    """What is worth writing; None where nothing is."""
    folded = _Folded(measured)
    members: list[tuple[int, float]] = []
    while len(members) < TABLES_MOST and folded.is_possible:
        tried = [(folded.foretold([*members, (number, bend)]), number, bend) for number in folded.free(members) for bend in BENDS]
        if not tried:
            break
        _, number, bend = min(tried)
        more = [*members, (number, bend)]
        before, after = (folded.foretold_rows(tables) for tables in (members, more))
        if not helps(before, after, measured.pieces[folded.decides], SURE_sd):
            break
        members = more
    if not members:
        return None
    before, (base, _) = folded.residual([]), folded.fitted(members)
    after, (base, values) = folded.residual(members), folded.fitted(members)
    choice = Chosen(tuple(number for number, _ in members), values, base, before, after)
    rows = measured.reports
    return choice if helps(before[rows], after[rows], measured.pieces[rows], CHECKED_sd) else None


def helps(before: Array, after: Array, pieces: Places, sure_sd: float) -> bool:
    """Whether rows (r,) that were not fitted are better off, by something and surely; rows of one piece hang together."""
    gained = before**2 - after**2
    share = float(gained.sum()) / max(float(np.sum(before**2)), 1e-300)
    if share < PAYS or share > LARGE:
        return share > LARGE
    _, piece = np.unique(pieces, return_inverse=True)
    sums = np.bincount(piece, gained)
    count, better = len(sums), int(np.sum(sums > 0.0))
    is_seen_in_count = better - 0.5 * count > sure_sd * 0.5 * math.sqrt(count)
    return is_seen_in_count or float(sums.sum()) > sure_sd * float(np.std(sums)) * math.sqrt(count)


class _Folded:
    """Inner products of everything, fold by fold, so that a set is tried without its rows."""

    def __init__(self, measured: MapRows) -> None:
        self.measured = measured
        counts = [measured.base.shape[1], *(table.shape[1] for table in measured.tables)]
        self._ends = np.cumsum(counts)
        self._folds = folds = [fold for fold in np.unique(measured.folds).tolist() if fold >= 0]
        self.is_possible = len(folds) > 1 and bool(measured.reports.any())
        self._columns = np.hstack([measured.base, *measured.tables, measured.y[:, None]])
        parts = [self._columns[measured.folds == fold] for fold in folds]
        self._grams = [part.T @ part for part in parts]
        self._whole = np.sum(self._grams, axis=0)

    def free(self, members: Sequence[tuple[int, float]]) -> list[int]:
        """Candidates that may still come in: a motor's turn has one table."""
        present = {self.measured.candidates[number] for number, _ in members}
        places = {(part.joint, part.over, part.is_directed) for part in present}
        return [k for k, part in enumerate(self.measured.candidates) if (part.joint, part.over, part.is_directed) not in places]

    def foretold(self, members: Sequence[tuple[int, float]]) -> float:
        """Sum of squares that each fold leaves with what the others give."""
        at, precision = self._at(members)
        total = 0.0
        for gram in self._grams:
            size = self._solved(self._whole - gram, at, precision)
            total += float(gram[-1, -1] - 2.0 * size @ gram[at, -1] + size @ gram[np.ix_(at, at)] @ size)
        return total

    @property
    def decides(self) -> Mask:
        """Rows that are left out in turn."""
        return np.asarray(self.measured.folds >= 0)

    def foretold_rows(self, members: Sequence[tuple[int, float]]) -> Array:
        """What each fold leaves with what the others give, the rows that decide."""
        at, precision = self._at(members)
        residual = np.zeros(len(self.measured.y))
        for fold, gram in zip(self._folds, self._grams, strict=True):
            rows = self.measured.folds == fold
            size = self._solved(self._whole - gram, at, precision)
            residual[rows] = self.measured.y[rows] - self._columns[np.ix_(rows, at)] @ size
        return residual[self.decides]

    def fitted(self, members: Sequence[tuple[int, float]]) -> tuple[Array, tuple[Array, ...]]:
        """The base's values and those of the tables, from all rows that do not report."""
        at, precision = self._at(members)
        size = self._solved(self._whole, at, precision)
        first = self.measured.base.shape[1]
        ends = np.cumsum([first, *(self.measured.candidates[number].count for number, _ in members)])
        values = tuple(size[a:b] for a, b in itertools.pairwise(ends))
        return size[:first], values

    def residual(self, members: Sequence[tuple[int, float]]) -> Array:
        """All rows without what a set explains, (r,)."""
        at, precision = self._at(members)
        return np.asarray(self.measured.y - self._columns[:, at] @ self._solved(self._whole, at, precision))

    def _at(self, members: Sequence[tuple[int, float]]) -> tuple[Array, Array]:
        """Places of a set's columns, and their prior precision."""
        first = self.measured.base.shape[1]
        at = [np.arange(first), *(np.arange(self._ends[k], self._ends[k + 1]) for k, _ in members)]
        places = np.concatenate(at)
        precision = np.zeros((len(places), len(places)))
        precision[:first, :first] = np.diag(self.measured.base_precision)
        for number, bend in members:
            count = self.measured.candidates[number].count
            precision[first : first + count, first : first + count] = self.measured.candidates[number].precision(bend)
            first += count
        return places, precision

    def _solved(self, gram: Array, at: Array, precision: Array) -> Array:
        if not len(at):
            return np.zeros(0)
        return np.asarray(cho_solve(cho_factor(gram[np.ix_(at, at)] + precision), gram[at, -1]))


# Maps of joints' angles from static poses: what the tip is off by, beside the geometry, the frames and everything named.


USUAL_rad = 1e-3  # of what a joint is off by, after everything named
FOLDS = 6
LIGHT = 0.001  # of the heaviest joint's load: a gear that carries less does not give way to it
NONE = "no map of the joints' angles helps poses that were held out: none is written"


def angle_maps(arm: Arm, gap: StaticGap) -> tuple[Arm, MapsFound]:
    """The arm with maps of its joints' angles, where these help poses that were held out, and what they do.

    `arm`: as the finding leaves it, with the maps that sets have. Its geometry and base frame are fitted anew beside the maps:
    what departs from every law has bent them.
    """
    problem = problem_of(arm, gap.points)
    x = minimise(problem.of_rows(gap.split.known), LeastSquares(), 1).x
    there = _Poses(gap.points, load_of(arm, gap.points, problem.observed.q_rad), by_joints(Fit(problem, x, None))[0])
    measured = _measured(problem, x, gap, there, {(correction.joint, correction.over) for correction in arm.maps})
    choice = chosen(measured)
    if choice is None:
        return arm, MapsFound((), (), (NONE,))
    solution = problem.solution(x + choice.base)
    parts = [(measured.candidates[k], USUAL_rad * values) for k, values in zip(choice.numbers, choice.values, strict=True)]
    maps = maps_of(parts)
    before, after = (gap.floor.tip_m * rms(residual[measured.reports]) for residual in (choice.before, choice.after))
    drawn = tuple(there.drawn(correction, gap.floor.tip_m * choice.after.reshape(-1, 3)) for correction in maps)
    framed = with_base_frame(arm.with_dh(solution.dh), solution.frames[0])
    written = dataclasses.replace(framed, maps=(*arm.maps, *maps))
    return written, MapsFound(drawn, (MapCheck("tip_m", None, before, after),))


@dataclass(frozen=True, slots=True)
class _Poses:
    """Poses, gravity's torques (m, n) if the masses are known, and how tips follow joints (m, 3, n)."""

    points: Points
    load_Nm: Array | None
    by_joint: Array

    def place(self, joint: int, over: str) -> Array:
        """The variable of a table of a joint (1-based), (m,)."""
        if over == "load_Nm" and self.load_Nm is not None:
            return np.asarray(self.load_Nm[:, joint - 1])
        return np.asarray(self.points.q_rad[:, joint - 1])

    def direction(self, joint: int) -> Array:
        """Of the joint's last motion, (m,)."""
        return np.asarray(self.points.direction[:, joint - 1])

    def drawn(self, correction: CorrectionMap, left_m: Array) -> DrawnMap:
        """A map over its own variable, beside what it and the tips' residuals (m, 3) say of the joint."""
        at = self.place(correction.joint, correction.over)
        table = along(correction, at, self.direction(correction.joint))
        residual_rad = along_joint(self.by_joint[:, :, correction.joint - 1], left_m)
        return DrawnMap(correction, at, table + residual_rad, table)


def _measured(problem: ArmProblem, x: Array, gap: StaticGap, there: _Poses, mapped: Set[tuple[int, str]]) -> MapRows:
    residual, jacobian = problem.residuals_and_jacobian(x)
    rows, noise = 3 * len(gap.points), gap.floor.tip_m
    candidates = tuple(candidate for candidate in _candidates(there) if (candidate.joint, candidate.over) not in mapped)
    tables = []
    for candidate in candidates:
        columns = candidate.columns(there.place(candidate.joint, candidate.over), there.direction(candidate.joint)).toarray()
        moved = there.by_joint[:, :, candidate.joint - 1, None] * columns[:, None, :]
        tables.append(moved.reshape(rows, -1) * (USUAL_rad / noise))
    precision = prior_sd(problem.parameters, 1.0) ** -2.0
    return MapRows(
        residual.ravel() / noise,
        -jacobian.reshape(rows, -1) / noise,
        precision,
        candidates,
        tuple(tables),
        _folds(gap),
        np.repeat(np.arange(len(gap.points)), 3),
    )


def _candidates(there: _Poses) -> tuple[Candidate, ...]:
    candidates: list[Candidate] = []
    heaviest_Nm = 0.0 if there.load_Nm is None else float(np.ptp(there.load_Nm, axis=0).max())
    for joint in range(1, there.points.joint_count + 1):
        of_joint = over_angle(joint, "angle_rad", there.place(joint, "angle_rad"))
        if there.load_Nm is not None:
            load = there.place(joint, "load_Nm")
            of_joint += over_load(joint, "angle_rad", load, LIGHT * heaviest_Nm)
        both_ways = {-1.0, 1.0} <= set(there.direction(joint).tolist())
        candidates += [candidate for candidate in of_joint if both_ways or not candidate.is_directed]
    return tuple(candidates)


def _folds(gap: StaticGap) -> Places:
    """Poses that are fitted in turn, three rows each; -1: reports, -2: is not looked at."""
    folds = np.where(gap.split.report & gap.split.is_divided, -1, -2).astype(np.intp)
    known = np.flatnonzero(gap.split.known)
    folds[known] = np.arange(len(known)) % FOLDS
    return np.repeat(folds, 3)
