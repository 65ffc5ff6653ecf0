"""Detects points of another arm, such as the left one of a pair, by comparing arms.

Deviations within their bounds bring one arm close to another, so a small residual proves nothing. The criterion
is the size of the deviations. Each candidate (this arm, the supplied ones, this arm with offsets of opposite sign, or with a
servo's horn on another tooth) is fitted with the same prior, and the points are attributed to the one with the lowest cost:

    cost = min(1, c / s)^2 sum over poses of (nu + 3) log(1 + |r|^2 / (nu s^2)) + sum over deviations of (x / p)^2,

twice the negative logarithm of a posterior with Student's errors (no single pose decides). Errors beyond a camera's, c, are
effects that no candidate has: neighbouring poses share them, and count for less. The scale s of the errors and the
size p of the deviations are estimated from the best candidates (the evidence framework: MacKay, Neural Computation 4 (1992)
415); candidates have the same unknowns, so that the volumes of their posteriors cancel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import chain, combinations

import numpy as np

from calib.arm_problem.arm_model import Bounds, dh_parameters
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.misread.points import Doubt
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array, norms, slim_product
from calib.points.points import Points
from control.model.arm import Arm
from control.model.description import arm_names, load_arm
from control.model.joint_map import JointMap
from control.model.servos import SERVOS

LARGEST, SMALLEST = 0.5, 0.02  # size of the deviations in their bounds: the spread of uniform ones is 0.58
NU = 4.0  # degrees of freedom of Student's errors, for outliers and effects that no candidate has
SCALE_m = 2e-4  # smallest scale of errors: no camera is better; what is beyond is no noise
MEDIAN_LENGTH = 1.54  # of a normal vector of three coordinates, standard deviation 1
UNBOUNDED = 1e-6  # precision of an unknown without a bound: all board poses are equally likely
STILL = 1e-4  # converged if no deviation changes by more
STEPS = 12  # longest step; the quadratic model is valid for half a bound
SURE = 20.0  # twice the logarithm of the odds: 1 to 20,000 against a mistake; points of the arm itself stayed below 6
LIKELY = 8.0  # odds of 55 to 1: a doubt
NEARER = 4.0  # factor by which the other arm, as drawn, must leave less of the points' spread for a refusal
ROWS_LIMIT = 300  # this many suffice
AS_GOOD = 1.5  # what another arm may leave, in what this one leaves: explaining less with smaller deviations is no better
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
    deviations in their bounds; `size`: their standard deviation, of the determined ones.
    """

    nominal_m: float
    spread_m: float
    distance_m: Array
    square: float
    size: float

    @property
    def left(self) -> float:
        """Share of the points' spread that deviations leave."""
        return float(np.median(self.distance_m)) / self.spread_m

    def in_words(self) -> str:
        """Before any deviation."""
        share = 100.0 * self.nominal_m / self.spread_m
        return f"{1e3 * self.nominal_m:.3g} mm from them (median), {share:.3g} % of their spread"

    def cost(self, scale_m: float, size: float) -> float:
        """At errors and deviations of these sizes."""
        errors = np.log1p(self.distance_m**2 / (NU * scale_m**2))
        counts = min(1.0, SCALE_m / scale_m) ** 2
        return counts * (NU + 3.0) * float(np.sum(errors)) + self.square / size**2


def doubts_of_arm(arm: Arm, points: Points, choice: Choice | None = None) -> tuple[Doubt, ...]:
    """The arm that the points fit with smaller deviations than `arm`, and that leaves no more of the points' spread.

    UnusablePointsError where that arm, as drawn, explains nearly all of it and this one does not, unless the points are to be
    taken at their word.
    """
    if len(points) < FEWEST:
        return ()
    some = points.chosen(range(0, len(points), -(-len(points) // ROWS_LIMIT)))
    candidates = [_Candidate(arm, "", ""), *_alternatives(arm, (choice or Choice()).bounds)]
    problems = [problem_of(one.arm, some, choice) for one in candidates]
    size = min(_fitted(one, LARGEST).size for one in problems)
    own, *others = [_fitted(one, size) for one in problems]
    rivals = [
        (c, fit) for c, fit in zip(candidates[1:], others, strict=True) if fit.left <= AS_GOOD * own.left
    ]
    if not rivals:
        return ()
    scale_m = max(SCALE_m, min(_scale_m(fit) for fit in (own, *others)))
    other, fit = min(rivals, key=lambda rival: rival[1].cost(scale_m, size))
    excess = own.cost(scale_m, size) - fit.cost(scale_m, size)
    if excess <= LIKELY:
        return ()
    is_sure = excess > SURE and fit.nominal_m < own.nominal_m / NEARER
    found = Doubt(
        f"these points fit {other.name} {'far ' if is_sure else ''}better than arm {arm.name}",
        f"as drawn it is {fit.in_words()}, and smaller deviations explain them",
        f"{arm.name} is {own.in_words()}",
        other.advice,
    )
    if is_sure and not points.is_as_given:
        raise found.refusal()
    return (found,)


def _alternatives(arm: Arm, bounds: Bounds) -> Iterator[_Candidate]:
    """Arms of the same kind with another geometry: the supplied ones, and this one with offsets of opposite sign.

    An offset that a deviation within its bound turns round makes no other arm.
    """
    for name, other in _supplied():
        if _is_of_kind(other, arm) and not np.allclose(other.dh, arm.dh):
            yield _Candidate(
                arm.with_dh(other.dh),
                f"the arm {name}",
                f"if they are of {name}, give its file with --arm",
            )
    yield from _a_tooth_off(arm)
    within_m = [one.bound for one in dh_parameters(arm.dh, bounds)[::4]]
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
                "its servo's horn is on another tooth: turn it by one, or set its zero_count to"
                f" {zero_count}; then record again",
            )


def _is_of_kind(other: Arm, arm: Arm) -> bool:
    """Whether one arm's geometry can replace the other's."""
    kinds = [[link.joint for link in one.links] for one in (other, arm)]
    return kinds[0] == kinds[1] and other.dh_convention == arm.dh_convention


def _subsets(links: list[int]) -> Iterator[tuple[int, ...]]:
    """Sets of offsets that change sign: all combinations of a few, else one at a time and all together."""
    if len(links) <= MIRRORED_LIMIT:
        return chain.from_iterable(combinations(links, count + 1) for count in range(len(links)))
    return chain(((k,) for k in links), (tuple(links),))


def _fitted(own: ArmProblem, size: float) -> _Fit:
    """The most probable deviations of an arm: Gauss-Newton's steps with Student's weights."""
    has_bound = np.array([one.has_bound for one in own.parameters])
    prior = np.diag(np.where(has_bound, size**-2, UNBOUNDED))
    x, scale_m, normal = np.zeros(len(prior)), np.inf, prior
    for _ in range(STEPS):
        residual, jacobian = own.residuals_and_jacobian(x)
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
    square = float(np.sum(x[has_bound] ** 2))
    return _Fit(
        float(np.median(norms(own.residuals(np.zeros(len(x)))))),
        float(np.sqrt(np.mean(norms(own.references_m - own.references_m.mean(axis=0)) ** 2))),
        norms(own.residuals(x)),
        square,
        float(np.clip(np.sqrt(square / max(shown, 1.0)), SMALLEST, LARGEST)),
    )


def _scale_m(fit: _Fit) -> float:
    return float(np.median(fit.distance_m)) / MEDIAN_LENGTH
