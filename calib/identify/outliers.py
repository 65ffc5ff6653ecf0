"""Outliers among points: detected and, if possible, explained; never dropped.

First, the best agreeing points are searched (least trimmed squares with concentration steps: Rousseeuw and Van Driessen,
Technometrics 41 (1999) 212), so that several outliers, or one with high leverage, are not masked. Then every point is
compared with a fit without it: its deleted residual over the noise of the others is F distributed
(Cook and Weisberg, Residuals and Influence in Regression, 1982). The level is divided among the points (Bonferroni), so
that a clean session has a false alarm with a probability of FALSE_ALARM, for any number of points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from calib.arm_problem.observations import cross_matrix
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, frozen, norms
from calib.identify.linear_fit import LinearFit, Mask
from calib.points.points import FREE

FALSE_ALARM = 0.02
TRUSTED_SHARE = 0.55  # of the points: share trusted in the search; a slip may last to the end
STARTS_COUNT = 40
CONCENTRATION_STEPS = 8
POINTS_LIMIT = 5000  # above, the search starts from the fit alone
ROUNDS_LIMIT = 12
CANNOT_BE_TESTED = 0.995  # leverage: the point alone determines something and cannot be contradicted
RESOLUTION_m = 1e-6  # smallest noise, so that data without noise have no outliers
SEED = 0


@dataclass(frozen=True, slots=True)
class Outlier:
    """A point that contradicts the others. `row` counts from 0 in the order of the points.

    `distance_m`: between its reference and where a fit to the others puts the tip; `score`: that over `noise_m`, the
    standard deviation of one axis: the known noise, or the scatter of the other points if that is larger.
    `off_m` (3,): that distance as a vector, base frame. `cause`: the probable cause, where exactly one fits.
    """

    row: int
    setup: str
    point: str
    distance_m: float
    score: float
    noise_m: float
    off_m: Array
    cause: OutlierCause

    @property
    def words(self) -> str:
        """Describe the outlier in a sentence."""
        where = f'point {self.point} of setup "{self.setup}"' if self.setup else f"point {self.point}"
        return (
            f"{where} (pose {self.row + 1}) is {1e3 * self.distance_m:.2f} mm from the position predicted by the other points,"
            f" {self.score:.1f} times the scatter of one axis ({1e3 * self.noise_m:.3f} mm){self.cause.words}"
        )


@dataclass(frozen=True, slots=True)
class OutlierTest:
    """Outlier test: mask of agreeing points, deleted residuals (m, 3) [m], scores (m,), noise of one axis [m]."""

    agrees: Mask
    deleted_m: Array
    score: Array
    noise_m: float


def find_outliers(
    problem: ArmProblem,
    x: Array,
    cavities: Mapping[str, Array] | None = None,
    extra: Array | None = None,
    noise_m: float = RESOLUTION_m,
    false_alarm: float = FALSE_ALARM,
) -> tuple[Outlier, ...]:
    """The outliers of a problem around its solution x (k,), the worst first.

    `cavities`: all cavities in the board's frame, for finding a cause; else those of the points.
    `extra` (m, 3, e): columns of further unknowns, such as a board that is not where the table says. `noise_m`: of one axis,
    if known: the smallest noise assumed.
    """
    fit = LinearFit.around(problem, x, extra)
    test = outlier_test(fit, noise_m, false_alarm)
    observed, outliers = problem.observed, []
    for row in np.flatnonzero(~test.agrees).tolist():
        off_m = fit.unweighted(row, test.deleted_m[row])
        outliers.append(
            Outlier(
                row,
                observed.setup[row] if observed.setup else "",
                observed.point[row] if observed.point else str(row + 1),
                float(np.linalg.norm(off_m)),
                float(test.score[row]),
                test.noise_m,
                frozen(off_m),
                cause_of(problem, x, row, off_m, test.noise_m, cavities or {}),
            )
        )
    return tuple(sorted(outliers, key=lambda outlier: -outlier.score))


def outlier_test(fit: LinearFit, noise_m: float = RESOLUTION_m, false_alarm: float = FALSE_ALARM) -> OutlierTest:
    """Test which points agree, given noise of one axis of at least noise_m; all if there are too few.

    `false_alarm`: probability that one of a clean session does not.
    """
    m = len(fit)
    if 3 * m - fit.rank < 6:
        return OutlierTest(np.ones(m, dtype=bool), fit.residuals, np.zeros(m), math.nan)
    agreeing = _clearly_alike(fit, _most_alike(fit))
    seen: list[bytes] = []
    for _ in range(ROUNDS_LIMIT):
        seen.append(agreeing.tobytes())
        test = _tested(fit, agreeing, max(noise_m, RESOLUTION_m), false_alarm)
        agreeing = test.agrees
        if agreeing.tobytes() in seen:
            break
    return test


def _tested(fit: LinearFit, agreeing: Mask, noise_m: float, false_alarm: float) -> OutlierTest:
    """Test every point against those of `agreeing`, without itself."""
    from scipy.special import fdtri

    residuals, leverage = fit.fitted(agreeing), fit.leverage(agreeing)
    freedom = max(1, 3 * int(agreeing.sum()) - fit.rank)
    sign = np.where(agreeing, -1.0, 1.0)[:, None, None]
    inner = np.linalg.eigvalsh(leverage)[:, -1]
    is_testable = ~agreeing | (inner < CANNOT_BE_TESTED)
    spread = np.where(is_testable[:, None, None], np.eye(3) + sign * leverage, np.eye(3))
    inverse = np.linalg.inv(spread)
    squares = np.einsum("mi,mij,mj->m", residuals, inverse, residuals)
    total = float(np.sum(residuals[agreeing] ** 2))
    others = np.where(agreeing, freedom - 3, freedom)
    variance = np.maximum((total - np.where(agreeing, squares, 0.0)) / np.maximum(others, 1), noise_m**2)
    ratio = np.where(is_testable, squares / 3.0 / variance, 0.0)
    agrees = ratio <= fdtri(3, np.maximum(others, 1), 1.0 - false_alarm / len(fit))
    deleted = np.where(agreeing[:, None], np.einsum("mij,mj->mi", inverse, residuals), residuals)
    return OutlierTest(agrees, deleted, np.sqrt(3.0 * ratio), math.sqrt(max(total / freedom, noise_m**2)))


def _most_alike(fit: LinearFit) -> Array:
    """Squared residuals (m,) of a fit to the TRUSTED_SHARE of points with the least sum of them."""
    m, draw = len(fit), np.random.default_rng(SEED)
    count = min(m, max(math.ceil(TRUSTED_SHARE * m), fit.rank // 3 + 2))
    least = min(m, math.ceil(fit.rank / 3) + 2)
    starts = [norms(fit.residuals), norms(fit.fitted(np.ones(m, dtype=bool)))]
    if m <= POINTS_LIMIT:
        for _ in range(STARTS_COUNT):
            chosen = np.zeros(m, dtype=bool)
            chosen[draw.choice(m, least, replace=False)] = True
            starts.append(norms(fit.fitted(chosen)))
    ends = [_concentrated(fit, start, count) for start in starts]
    return min(ends, key=lambda squares: float(np.sort(squares)[:count].sum()))


def _concentrated(fit: LinearFit, distances: Array, count: int) -> Array:
    """Fit to the `count` nearest points repeatedly: the sum of their squares never increases."""
    before = math.inf
    for _ in range(CONCENTRATION_STEPS):
        chosen = np.zeros(len(fit), dtype=bool)
        chosen[np.argpartition(distances, count - 1)[:count]] = True
        distances = norms(fit.fitted(chosen))
        nearest = np.partition(distances, count - 1)[:count]
        value = float(nearest @ nearest)
        if value >= before * (1.0 - 1e-9):
            break
        before = value
    return distances**2


def _clearly_alike(fit: LinearFit, squares: Array) -> Mask:
    """Points within the 99 % limit from the spread of the best half."""
    from scipy.special import chdtri

    m = len(fit)
    count = min(m, max(math.ceil(TRUSTED_SHARE * m), fit.rank // 3 + 2))
    share = min(1.0, max(0.1, 1.0 - fit.rank / (3.0 * count)))  # degrees of freedom of the fit
    middle = float(np.partition(squares, m // 2)[m // 2])
    variance = max(middle / float(chdtri(3, 0.5)) / share, RESOLUTION_m**2)
    agreeing = squares <= variance * float(chdtri(3, 0.01))
    agreeing[np.argpartition(squares, count - 1)[:count]] = True
    return np.asarray(agreeing)


# The probable cause of an outlier, if exactly one fits its residual.
ALIKE = 4.0  # noise standard deviations within which two positions are equal
LEAST_SLIP_rad = 1e-3
NOT_SEATED_m = 0.006  # a badly seated tip is at most this far from its cavity


@dataclass(frozen=True, slots=True)
class OutlierCause:
    """A wrong `cavity`, an encoder of `joint` slipped by `slip_rad`, or, near its place, a tip that was `badly` measured: how."""

    cavity: str = ""
    joint: int = 0
    slip_rad: float = 0.0
    badly: str = ""

    @property
    def words(self) -> str:
        """Text such as `: the tip was probably in cavity 7`; empty if no single cause fits."""
        if self.cavity:
            return f": the tip was probably in cavity {self.cavity}"
        if self.joint:
            angle = math.degrees(self.slip_rad)
            return f": the encoder of joint {self.joint} probably slipped by {angle:+.2f} deg in this pose"
        return f": {self.badly}" if self.badly else ""


def cause_of(
    problem: ArmProblem, x: Array, row: int, deleted_m: Array, noise_m: float, cavities: Mapping[str, Array]
) -> OutlierCause:
    """The cause of a row whose reference minus tip is `deleted_m` (3,)."""
    near = ALIKE * noise_m
    cavity = _other_cavity(problem, x, row, deleted_m, near, cavities)
    if cavity:
        return OutlierCause(cavity=cavity)
    joints = _slipped_joints(problem, x, row, deleted_m, near)
    if len(joints) == 1:
        return OutlierCause(joint=joints[0][0], slip_rad=joints[0][1])
    if np.linalg.norm(deleted_m) >= NOT_SEATED_m:
        return OutlierCause()
    rotation = problem.observed.rotation  # is measured only where a camera sees a target
    is_seen = rotation is not None and bool(np.isfinite(rotation[row]).all())
    misread = "the camera misread it"
    return OutlierCause(badly=f"probably {misread}" if is_seen else f"the tip was probably not seated, or {misread}")


def _other_cavity(problem: ArmProblem, x: Array, row: int, deleted_m: Array, near_m: float, cavities: Mapping[str, Array]) -> str:
    """The cavity at the arm's tip; empty if there is none, or more than one."""
    observed = problem.observed
    if not observed.point:
        return ""
    same = [k for k in range(len(observed)) if observed.frame[k] == observed.frame[row]]
    if observed.setup:
        same = [k for k in same if observed.setup[k] == observed.setup[row]]
    places = {observed.point[k]: observed.position_m[k] for k in same if k != row}
    if observed.frames[observed.frame[row]].name != "base":
        places |= {name: np.asarray(place) for name, place in cavities.items()}
    places.pop(observed.point[row], None)
    if not places:
        return ""
    rotation = problem.solution(x).frames[observed.frame[row]].rotation
    sat_at = observed.position_m[row] - rotation.T @ deleted_m
    distances = norms(np.array(list(places.values())) - sat_at)
    order = np.argsort(distances)
    away = float(np.linalg.norm(deleted_m))
    reach = max(near_m, 0.05 * away)
    if distances[order[0]] > reach or (len(order) > 1 and distances[order[1]] < 2.0 * reach):
        return ""
    return list(places)[int(order[0])]


def _slipped_joints(problem: ArmProblem, x: Array, row: int, deleted_m: Array, near_m: float) -> list[tuple[int, float]]:
    """Joints of which a change of the angle alone moves the tip to the reference: (joint, change)."""
    solution = problem.solution(x)
    q = problem.observed.q_rad[row : row + 1]
    slips = []
    for joint in range(q.shape[1]):
        angle = 0.0
        for _ in range(4):
            turned = q.copy()
            turned[0, joint] += angle
            slopes = problem.model.slopes(solution.dh, turned, solution.tool_m)
            here = slopes.by_dh[0, :, problem.model.theta_places[joint]]
            missing = deleted_m + problem.model.tips(solution.dh, q, solution.tool_m)[0] - slopes.tips[0]
            angle += float(here @ missing) / max(float(here @ here), 1e-12)
        turned = q.copy()
        turned[0, joint] += angle
        moved = problem.model.tips(solution.dh, turned, solution.tool_m)[0]
        left = deleted_m - (moved - problem.model.tips(solution.dh, q, solution.tool_m)[0])
        if np.linalg.norm(left) < near_m and abs(angle) > LEAST_SLIP_rad:
            slips.append((joint + 1, angle))
    return slips


# Contradictions among the points: shifted setups, slipped encoders, single outliers.


PART = 50_000  # points that are compared with each other: far more than the fit's unknowns need, in some 100 MB
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
        sentences = [] if self.is_systematic else [shift.words for shift in self.setups]
        sentences += [self.slip.words] if self.slip is not None else []
        single = self._single()
        listed_count = REPORTED_IF_SYSTEMATIC if self.is_systematic else REPORTED_LIMIT
        sentences += [outlier.words for outlier in single[:listed_count]]
        if len(single) > listed_count:
            sentences.append(f"{len(single) - listed_count} more points contradict the others, less than those listed")
        return tuple(sentences)

    def _single(self) -> list[Outlier]:
        rows = set(self.slip.rows) if self.slip is not None else set()
        return [one for one in self.outliers if one.row not in rows]


def find_suspects(
    problem: ArmProblem, x: Array, cavities: Mapping[str, Array] | None = None, noise_m: float = RESOLUTION_m
) -> Suspects:
    """Find suspects around the solution x (k,) of a problem; points of a shifted setup are compared only with each other.

    `noise_m`: of one axis, if known; deviations within it are never suspicious. More than PART points are compared in parts,
    each spread evenly over all.
    """
    parts = max(1, math.ceil(len(problem) / PART))
    setups = shifted_setups(problem.of_rows(slice(None, None, parts)) if parts > 1 else problem, x)
    outliers: list[Outlier] = []
    for first in range(parts):
        part = problem.of_rows(slice(first, None, parts)) if parts > 1 else problem
        moved = [moved_columns(part, shift.setup) for shift in setups]
        extra = np.concatenate(moved, axis=2) if moved else None
        of_part = find_outliers(part, x, cavities, extra, noise_m, FALSE_ALARM / parts)
        outliers += [replace(outlier, row=first + parts * outlier.row) for outlier in of_part]
    worst_first = tuple(sorted(outliers, key=lambda outlier: -outlier.score))
    return Suspects(setups, worst_first, len(problem), _slip(problem, x, worst_first))


def _slip(problem: ArmProblem, x: Array, outliers: tuple[Outlier, ...]) -> Slip | None:
    """The joint for which a constant change of its angle explains the longest run of outliers."""
    run = _longest_run(sorted(outlier.row for outlier in outliers))
    if len(run) < SLIPPED_COUNT or len(outliers) - len(run) >= SYSTEMATIC_COUNT:
        return None
    off = {outlier.row: outlier.off_m for outlier in outliers}
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
    shifted: list[ShiftedSetup] = []
    if len(names) < 2:
        return ()
    fixed = LinearFit.around(problem, x)
    everything = np.concatenate([fixed.weighted(moved_columns(problem, name)) for name in names], axis=2)
    agrees = outlier_test(LinearFit.of(fixed.residuals, fixed.columns, everything)).agrees
    while len(shifted) + 1 <= LARGEST_SHARE * len(names):
        motions = [fixed.weighted(moved_columns(problem, shift.setup)) for shift in shifted]
        rest = [name for name in names if name not in [shift.setup for shift in shifted]]
        best = max((_moved(problem, name, fixed, motions, agrees) for name in rest), key=lambda candidate: candidate[0])
        if best[0] < SHIFT_EXPLAINED_SHARE or best[1] > CHANCE:
            break
        shifted.append(best[2])
    return tuple(shifted)


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
    problem: ArmProblem, name: str, fixed: LinearFit, motions: list[Array], agrees: Mask
) -> tuple[float, float, ShiftedSetup]:
    """Explained share, p-value, and the motion."""
    from scipy.special import fdtrc

    motion = fixed.weighted(moved_columns(problem, name))
    before_columns = np.concatenate((fixed.columns, *motions), axis=2)
    wanted = -fixed.residuals[agrees].ravel()
    before, before_rank, _ = _solved(before_columns[agrees], wanted)
    after, after_rank, step = _solved(np.concatenate((before_columns, motion), axis=2)[agrees], wanted)
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
