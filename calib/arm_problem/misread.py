"""Detects misread points: degrees, counts, millimetres, swapped or rotated columns, orientations of another convention.

A reading of the columns is judged by the share of the tips' spread that the nominal arm leaves unexplained in it: tips in
metres that are taken for millimetres lie in a thousandth of the room, and a distance of 2 mm then explains nothing. A reading
that leaves far less than the file as it stands is a doubt. It refuses only points that no deviation within its bound explains,
or of which this arm explains nothing and the other reading nearly all.
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain, combinations

import numpy as np
import numpy.typing as npt

from calib.arm_problem.arm_model import ArmModel, Bounds, dh_parameters, prior_sd
from calib.arm_problem.assembly import Choice, problem_of, started_tool, with_started_frames
from calib.arm_problem.observations import Observations
from calib.arm_problem.posed import PosedProblem
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, frozen, norms, slim_product
from calib.errors import UnusablePointsError
from calib.points.points import Points
from control.kinematics.rotation import matrices, quaternions
from control.model.arm import Arm
from control.model.description import arm_names, load_arm
from control.model.drive import SERVOS, JointMap
from control.plain_text import listed

# A guess about input: what it looks like, the figures for and against, and what settles it.
#
# A guess is said aloud and the work goes on. It refuses only input that cannot be right as it stands, and then names
# `--as-given`, the option that takes a file at its word.

AS_GIVEN = "--as-given takes the file at its word"


@dataclass(frozen=True, slots=True)
class Doubt:
    """What input looks like, with the figure if it is that (`then`), the figure as it stands (`as_given`), and what to do."""

    looks: str
    then: str
    as_given: str
    remedy: str

    def in_words(self) -> str:
        """One sentence, for a warning."""
        return f"{self.looks}: {self.then}; with the file as given {self.as_given}; {self.remedy}"

    def refusal(self) -> UnusablePointsError:
        """The error where the input cannot be right as it stands."""
        return UnusablePointsError(f"{self.in_words()}, or {AS_GIVEN}")


ODD = 0.05  # of the spread, unexplained at nominal: below it no check is made
NEARER = 4.0  # factor by which another reading must leave less of the spread
FAR_TIMES = 1.5  # the reach of all bounds together, some 0.1 m: no deviation explains a distance beyond
WHOLE_PERMUTATIONS_JOINTS = 4  # up to this count all orders of the joints are tried, beyond only swapped pairs
AS_GOOD = 1.5  # readings this close to the best are ambiguous: a mirrored arm has mirrored deviations
REPORTED_LIMIT = 3
ROWS_LIMIT = 300  # this many rows suffice

Reading = tuple[str, Array, Array]


@dataclass(frozen=True, slots=True)
class _Misfit:
    """Of a reading: what the nominal arm leaves of the tips' spread, median distance over the references' (both in m)."""

    distance_m: float
    spread_m: float

    @property
    def left(self) -> float:
        """The share; infinite where all references are in one place."""
        return self.distance_m / self.spread_m if self.spread_m > 0.0 else math.inf

    def in_words(self) -> str:
        return f"{_length(self.distance_m)} from the points (median), {100 * self.left:.3g} % of their spread"


def doubts_of_reading(arm: Arm, problem: ArmProblem, is_as_given: bool = False) -> tuple[Doubt, ...]:
    """Other readings of the columns that explain more of the spread than the file as it stands.

    UnusablePointsError if no deviation within its bound explains the file as it stands, unless it is to be taken at its word.
    """
    observed = _some(problem.observed)
    as_read = _misfit(problem, observed)
    if as_read.left < ODD:
        return ()
    tried = [
        (_misfit(problem, dataclasses.replace(observed, q_rad=q, position_m=position)), description)
        for description, q, position in _readings(arm, observed)
    ]
    best = min((misfit for misfit, _ in tried), key=lambda misfit: misfit.left)
    reach_m = _reach_m(problem)
    if best.left < as_read.left / NEARER:
        alike = [description for misfit, description in tried if misfit.left < AS_GOOD * best.left]
        doubt = Doubt(
            ", or ".join(alike[:REPORTED_LIMIT]),
            f"the nominal arm would then be {best.in_words()}",
            f"it is {as_read.in_words()}",
            "correct the file",
        )
        explains_nothing = as_read.left >= 1.0 and best.left < ODD
        if (as_read.distance_m > reach_m or explains_nothing) and not is_as_given:
            raise doubt.refusal()
        return (doubt,)
    if as_read.distance_m > FAR_TIMES * reach_m:
        frames = tuple(dataclasses.replace(frame, is_placed=False) for frame in observed.frames)
        placed = _misfit(problem, dataclasses.replace(observed, frames=frames))
        far = (
            Doubt(
                "the tips look measured in a frame that stands elsewhere than the arm's file says",
                f"placed where it fits best, the nominal arm would be {placed.in_words()}",
                f"it is {as_read.in_words()}",
                "--free base identifies the frame (calibrate), and without base_frame and [table] known_pose it is placed always",
            )
            if placed.left < as_read.left / NEARER
            else Doubt(
                "the points may be of another arm, or of one with other zeros",
                f"expected at most {1e3 * reach_m:.0f} mm, which all deviations within their bounds explain",
                f"the nominal arm is {as_read.in_words()}",
                "check that the points are of this arm and use its zeros",
            )
        )
        if not is_as_given:
            raise far.refusal()
        return (far,)
    return ()


def _some(observed: Observations) -> Observations:
    """At most ROWS_LIMIT evenly spaced poses, without corrections, with free frames unplaced."""
    frames = tuple(dataclasses.replace(frame, is_placed=not frame.is_free) for frame in observed.frames)
    chosen = observed.chosen(np.arange(len(observed))[_spread(len(observed))])
    return dataclasses.replace(chosen, frames=frames, corrections=())


def _spread(count: int) -> slice:
    """Rows of `count` that are evenly spaced, at most ROWS_LIMIT."""
    return slice(None, None, max(1, -(-count // ROWS_LIMIT)))


def _misfit(problem: ArmProblem, observed: Observations) -> _Misfit:
    """Of the nominal arm, unknown tool and boards where they fit best."""
    model = problem.model
    is_tool_free = any(parameter.name.startswith("tool_") for parameter in problem.parameters)
    tool = started_tool(model, observed) if is_tool_free else model.nominal_tool_m
    placed = with_started_frames(model, observed, tool)
    references = np.empty_like(observed.position_m)
    for k, frame in enumerate(placed.frames):
        rows = placed.rows_of(k)
        references[rows] = frame.to_base(observed.position_m[rows])
    distances_m = norms(references - model.tips(model.nominal_dh, observed.q_rad, tool))
    spread_m = norms(references - references.mean(axis=0))
    return _Misfit(float(np.median(distances_m)), float(np.sqrt(np.mean(spread_m**2))))


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
        counts = np.array([drive.counts_per_joint_turn for drive in arm.drives])
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
        yield f"the columns {listed(names)} look swapped", q[:, order], position
    for j in range(n):
        flipped = q.copy()
        flipped[:, j] *= -1.0
        yield f"the sign of q{j + 1}_rad looks inverted", flipped, position
    if n > 1:
        yield "the signs of all joint angles look inverted", -q, position
    for j, quarter in itertools.product(range(n), (1, 2, 3)):
        shifted = q.copy()
        shifted[:, j] += quarter * math.pi / 2
        yield (f"q{j + 1}_rad looks {90 * quarter if quarter < 3 else -90} deg short of this arm's zero", shifted, position)


def _position_columns(q: Array, position: Array) -> Iterator[Reading]:
    for order in itertools.permutations(range(3)):
        if order != (0, 1, 2):
            names = [f"{'xyz'[j]}_m" for j in range(3) if order[j] != j]
            yield f"the columns {listed(names)} look swapped", q, position[:, order]
    for axis in range(3):
        flipped = position.copy()
        flipped[:, axis] *= -1.0
        yield f"the sign of {'xyz'[axis]}_m looks inverted", q, flipped


def _orders(n: int) -> Iterator[list[int]]:
    """Other orders of n columns."""
    if n <= WHOLE_PERMUTATIONS_JOINTS:
        yield from (list(order) for order in itertools.permutations(range(n)) if list(order) != list(range(n)))
        return
    for i, j in itertools.combinations(range(n), 2):
        order = list(range(n))
        order[i], order[j] = j, i
        yield order


def _length(distance_m: float) -> str:
    return f"{1e3 * distance_m:.3g} mm" if distance_m < 1.0 else f"{distance_m:.3g} m"


OFF_rad = 0.35  # mean angle at nominal beyond which they are not this arm's: deviations of 2 deg make a few of them
CLOSER = 0.3  # share of that angle below which another reading explains it


def doubts_of_turns(problem: ArmProblem, is_as_given: bool = False) -> tuple[Doubt, ...]:
    """What the orientations look like if they disagree with the nominal arm, which deviations within their bounds cannot do.

    UnusablePointsError, unless they are to be taken at their word.
    """
    if not len(problem.observed.turned_rows):
        return ()
    off = _angle_rad(problem)
    if off <= OFF_rad:
        return ()
    looks, then_rad, remedy = _explained(problem, off)
    doubt = Doubt(looks, f"they would then be {_deg(then_rad)} off the arm's in the mean", f"they are {_deg(off)} off", remedy)
    if not is_as_given:
        raise doubt.refusal()
    return (doubt,)


def _explained(problem: ArmProblem, off: float) -> tuple[str, float, str]:
    """The reading that agrees best, its mean angle, and what to do."""
    expected = "expected qw, qx, qy, qz of the target in the frame of x_m"
    for reading, rotation in _turn_readings(problem):
        angle = _angle_rad(_with(problem, rotation))
        if angle < CLOSER * off:
            return reading, angle, expected
    if problem.observed.is_target_known:
        free = copy.copy(problem)
        free.observed = dataclasses.replace(problem.observed, is_target_known=False)
        angle = _angle_rad(free)
        if angle < CLOSER * off:
            return "the target's axes do not look like the last link's", angle, "leave out --fix target"
    return (
        "the measured orientations look like those of something else",
        0.0,
        f"{expected}; remove qw to qz if they are something else",
    )


def _deg(angle_rad: float) -> str:
    return f"{np.degrees(angle_rad):.2g} deg"


def _angle_rad(problem: ArmProblem) -> float:
    """Mean angle at nominal, the target where it fits best if it is free."""
    whole = PosedProblem(problem)
    return float(np.mean(norms(whole.angles_rad(np.zeros(len(whole.parameters))))))


def _with(problem: ArmProblem, rotation: Array) -> ArmProblem:
    reread = copy.copy(problem)
    reread.observed = dataclasses.replace(problem.observed, rotation=frozen(rotation))
    return reread


def _turn_readings(problem: ArmProblem) -> Iterator[tuple[str, Array]]:
    rows, rotation = problem.observed.turned_rows, problem.observed.rotation
    if rotation is None:
        return
    given = quaternions(rotation[rows])
    yield "the quaternions look like x, y, z, w", _placed(rotation, rows, matrices(given[:, [3, 0, 1, 2]]))
    yield ("they look inverted (the frame in the target)", _placed(rotation, rows, np.swapaxes(rotation[rows], 1, 2)))


def _placed(rotation: Array, rows: npt.NDArray[np.intp], turned: Array) -> Array:
    whole = np.array(rotation)
    whole[rows] = turned
    return whole


# Detects points of another arm, such as the left one of a pair, by comparing arms.
#
# Deviations within their bounds bring one arm close to another, so a small residual proves nothing. The criterion
# is the size of the deviations. Each candidate (this arm, the supplied ones, this arm with offsets of opposite sign, or with a
# servo's horn on another tooth) is fitted with the same prior, and the points are attributed to the one with the lowest cost:
#
#     cost = min(1, c / s)^2 sum over poses of (nu + 3) log(1 + |r|^2 / (nu s^2))
#            + sum over deviations of (x / p)^2 + 2 k log p,
#
# twice the negative logarithm of a posterior with Student's errors (no single pose decides). Errors beyond a camera's, c, are
# effects that no candidate has: neighbouring poses share them, and count for less. The scale s of the errors is estimated from
# the best candidate, the size p of the k deviations that the points show for each (the evidence framework: MacKay, Neural
# Computation 4 (1992) 415): with one size for all, the smallest that any needs, an arm that is off by more is soon another.
# Candidates have the same unknowns, so that the volumes of their posteriors cancel; that it is any of the other arms is as likely
# beforehand as that it is this one.


LARGEST, SMALLEST = 0.5, 0.02  # size of the deviations in their bounds: the spread of uniform ones is 0.58
NU = 4.0  # degrees of freedom of Student's errors, for outliers and effects that no candidate has
SCALE_m = 2e-4  # smallest scale of errors: no camera is better; what is beyond is no noise
MEDIAN_LENGTH = 1.54  # of a normal vector of three coordinates, standard deviation 1
UNBOUNDED = 1e-6  # precision of an unknown without a bound: all board poses are equally likely
STILL = 1e-4  # converged if no deviation changes by more
STEPS = 12  # longest step; the quadratic model is valid for half a bound
SURE = 20.0  # twice the logarithm of the odds: 1 to 20,000 against a mistake; points of the arm itself stayed below 6
LIKELY = 8.0  # odds of 55 to 1: a doubt
FEWEST = 8  # poses; with fewer, deviations can explain anything
MIRRORED_LIMIT = 4  # number of offsets up to which all combinations of signs are tried


@dataclass(frozen=True, slots=True)
class _Candidate:
    """An arm that the points may belong to, and its name."""

    arm: Arm
    name: str
    advice: str


@dataclass(frozen=True, slots=True)
class _Fit:
    """Fit of a candidate to the points: residual lengths (m,), and the required deviations.

    `nominal_m`: median distance before any; `spread_m`: of the references, root mean square; `square`: sum of the squared
    deviations in their bounds; `shown`: how many of them the points determine; `size`: the standard deviation of these.
    """

    nominal_m: float
    spread_m: float
    distance_m: Array
    square: float
    shown: float
    size: float

    @property
    def left(self) -> float:
        """Share of the points' spread that deviations leave."""
        return float(np.median(self.distance_m)) / self.spread_m

    def in_words(self) -> str:
        """Before any deviation."""
        share = 100.0 * self.nominal_m / self.spread_m
        return f"{1e3 * self.nominal_m:.3g} mm from them (median), {share:.3g} % of their spread"

    def cost(self, scale_m: float, shown: float) -> float:
        """At errors of this size, and deviations of the size that suits this arm best, of which the points show so many."""
        errors = np.log1p(self.distance_m**2 / (NU * scale_m**2))
        counts = min(1.0, SCALE_m / scale_m) ** 2
        size = min(max(math.sqrt(self.square / shown), SMALLEST), LARGEST)
        return counts * (NU + 3.0) * float(np.sum(errors)) + self.square / size**2 + 2.0 * shown * math.log(size)


def doubts_of_arm(arm: Arm, points: Points, choice: Choice | None = None) -> tuple[Doubt, ...]:
    """The arm that the points fit with smaller deviations than `arm`, and that leaves no more of the points' spread.

    UnusablePointsError where that arm, as drawn, explains nearly all of it and this one does not, unless the points are to be
    taken at their word.
    """
    if len(points) < FEWEST:
        return ()
    thinned = points.chosen(range(0, len(points), -(-len(points) // ROWS_LIMIT)))
    candidates = [_Candidate(arm, "", ""), *_alternatives(arm, (choice or Choice()).bounds)]
    problems = [problem_of(candidate.arm, thinned, choice) for candidate in candidates]
    size = min(_fitted(problem, LARGEST).size for problem in problems)
    arm_fit, *others = [_fitted(problem, size) for problem in problems]
    rivals = [(c, fit) for c, fit in zip(candidates[1:], others, strict=True) if fit.left <= AS_GOOD * arm_fit.left]
    if not rivals:
        return ()
    scale_m = max(SCALE_m, min(float(np.median(fit.distance_m)) / MEDIAN_LENGTH for fit in (arm_fit, *others)))
    rival, fit = min(rivals, key=lambda pair: pair[1].cost(scale_m, arm_fit.shown))
    excess = arm_fit.cost(scale_m, arm_fit.shown) - fit.cost(scale_m, arm_fit.shown) - 2.0 * math.log(len(others))
    if excess <= LIKELY:
        return ()
    is_sure = excess > SURE and fit.nominal_m < arm_fit.nominal_m / NEARER
    doubt = Doubt(
        f"these points fit {rival.name} {'far ' if is_sure else ''}better than arm {arm.name}",
        f"as drawn it is {fit.in_words()}, and smaller deviations explain them",
        f"{arm.name} is {arm_fit.in_words()}",
        rival.advice,
    )
    if is_sure and not points.is_as_given:
        raise doubt.refusal()
    return (doubt,)


def _alternatives(arm: Arm, bounds: Bounds) -> Iterator[_Candidate]:
    """Arms of the same kind with another geometry: the supplied ones, and this one with offsets of opposite sign.

    An offset that a deviation within its bound turns round makes no other arm.
    """
    for name, supplied in _supplied():
        if _is_of_kind(supplied, arm) and not np.allclose(supplied.dh, arm.dh):
            yield _Candidate(arm.with_dh(supplied.dh), f"the arm {name}", f"if they are of {name}, give its file with --arm")
    yield from _a_tooth_off(arm)
    within_m = [one.bound for one in dh_parameters(ArmModel(arm), bounds)[::4]]
    for links in _subsets([k for k, d in enumerate(arm.dh[:, 0]) if 2.0 * abs(d) > within_m[k]]):
        dh = arm.dh.copy()
        dh[list(links), 0] *= -1.0
        wrong = " and ".join(f"d{k + 1} = {1e3 * dh[k, 0]:+.4g} mm" for k in links)
        yield _Candidate(
            arm.with_dh(dh),
            f"an arm with {wrong}",
            "check the sign of this offset in arm.toml, and whether the points are of a mirrored arm",
        )


@cache
def _supplied() -> tuple[tuple[str, Arm], ...]:
    """Names and arms, read once: every check of points compares with all of them."""
    return tuple((name, load_arm(name)) for name in arm_names())


def _a_tooth_off(arm: Arm) -> Iterator[_Candidate]:
    """This arm with the horn of a servo put on a tooth further, either way: its joint stands where the count does not say."""
    turning = [k for k, turns in enumerate(arm.joints) if turns]
    for drive in arm.drives:
        teeth = SERVOS[drive.servo].horn_teeth if drive.servo else 0
        for tooth_rad in (2.0 * math.pi / teeth, -2.0 * math.pi / teeth) if teeth else ():
            dh = arm.dh.copy()
            dh[turning[drive.joint - 1], 1] += tooth_rad
            zero_count = drive.zero_count - round(JointMap(drive).counts_per_radian * tooth_rad)
            yield _Candidate(
                arm.with_dh(dh),
                f"an arm whose {arm.joint_names[drive.joint - 1]} stands {math.degrees(tooth_rad):+.1f} deg further",
                f"its servo's horn is on another tooth: turn it by one, or set its zero_count to {zero_count}; then record again",
            )


def _is_of_kind(candidate: Arm, arm: Arm) -> bool:
    """Whether one arm's geometry can replace the other's."""
    kinds = [[link.joint for link in one.links] for one in (candidate, arm)]
    return kinds[0] == kinds[1] and candidate.dh_convention == arm.dh_convention


def _subsets(links: list[int]) -> Iterator[tuple[int, ...]]:
    """Sets of offsets that change sign: all combinations of a few, else one at a time and all together."""
    if len(links) <= MIRRORED_LIMIT:
        return chain.from_iterable(combinations(links, count + 1) for count in range(len(links)))
    return chain(((k,) for k in links), (tuple(links),))


def _fitted(problem: ArmProblem, size: float) -> _Fit:
    """The most probable deviations of an arm: Gauss-Newton's steps with Student's weights."""
    has_bound = np.array([one.has_bound for one in problem.parameters])
    unit = prior_sd(problem.parameters, LARGEST, LARGEST) / LARGEST  # of a deviation: its bound, or twice its standard deviation
    prior = np.diag(np.where(has_bound, (size * unit) ** -2, UNBOUNDED))
    x, scale_m, normal = np.zeros(len(prior)), np.inf, prior
    for _ in range(STEPS):
        residual, jacobian = problem.residuals_and_jacobian(x)
        distance = norms(residual)
        scale_m = max(SCALE_m, min(scale_m, float(np.median(distance)) / MEDIAN_LENGTH))
        weight = (NU + 3.0) / (NU * scale_m**2 + distance**2)
        columns = jacobian.transpose(2, 1, 0)  # (k, 3, m), as it is stored
        weighted = (columns * weight).reshape(len(x), -1)
        normal = slim_product(weighted, columns.reshape(len(x), -1)) + prior
        step = -np.linalg.solve(normal, weighted @ residual.T.ravel() + prior @ x)
        x = x + step
        if float(np.abs(step).max()) < STILL:
            break
    shown = float(np.sum(has_bound) - np.trace((prior @ np.linalg.inv(normal))[np.ix_(has_bound, has_bound)]))
    square = float(np.sum((x / unit)[has_bound] ** 2))
    return _Fit(
        float(np.median(norms(problem.residuals(np.zeros(len(x)))))),
        float(np.sqrt(np.mean(norms(problem.references_m - problem.references_m.mean(axis=0)) ** 2))),
        norms(problem.residuals(x)),
        square,
        max(shown, 1.0),
        float(np.clip(np.sqrt(square / max(shown, 1.0)), SMALLEST, LARGEST)),
    )
