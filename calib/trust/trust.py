"""How far an arm can be trusted: from its file and recorded points to the tip's predicted error over the workspace."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.checks import require_usable
from calib.arm_problem.problem import ArmProblem
from calib.arrays import Array
from calib.design.candidates import workspace_poses
from calib.points.points import Points
from calib.trust.discrepancy import Conditions, Discrepancy
from calib.trust.prediction import Posterior, Predictor, TipError, linearised, loose_play_m2, posterior_of
from calib.validation.verdict import NoiseFloor, noise_floor
from control.model.arm import Arm
from control.plain_text import Advance, silent

POSES: Final = 1500  # drawn over the joints' ranges, before those that collide are left out
SURE: Final = 0.95  # that scatter beyond the measuring noise is no chance
MANY: Final = 1e6  # degrees of freedom of a noise that is known
DRAWS: Final = 400  # of each pose's error, for its 95 % distance
DIRECTIONS: Final = (1.0, -1.0)


@dataclass(frozen=True, slots=True)
class MapRequest:
    """What the map is made for: masses at the tip [kg], the wanted accuracy [m] or None, and poses drawn.

    is_checked: points are left out in turn and predicted, which takes most of the time.
    """

    payloads_kg: tuple[float, ...] = (0.0,)
    tolerance_m: float | None = None
    poses_count: int = POSES
    is_checked: bool = True
    choice: Choice = field(default_factory=Choice)


@dataclass(frozen=True, slots=True)
class TrustSheet:
    """The map for one payload and one direction of approach: errors at the map's poses.

    within_95_m (m,): the distance that one visit keeps in 95 % of cases.
    """

    payload_kg: float
    direction: float
    error: TipError
    within_95_m: Array


@dataclass(frozen=True, slots=True)
class Trust:
    """The result. q_rad (m, n): the map's poses; `coverage` is None if too few poses can be left out."""

    arm: Arm
    points: Points
    request: MapRequest
    posterior: Posterior
    predictor: Predictor
    discrepancy: Discrepancy
    q_rad: Array
    sheets: tuple[TrustSheet, ...]
    coverage: Coverage | None
    importances: tuple[Importance, ...]
    measuring_noise_m: float | None
    warnings: tuple[str, ...]

    @property
    def within_95_m(self) -> Array:
        """The largest of both directions without payload, (m,)."""
        return np.asarray(np.max([one.within_95_m for one in self.of_payload(self.sheets[0].payload_kg)], axis=0))

    def of_payload(self, payload_kg: float) -> tuple[TrustSheet, ...]:
        """The sheets of one payload."""
        return tuple(one for one in self.sheets if one.payload_kg == payload_kg)


def trust_in(arm: Arm, points: Points, request: MapRequest, advance: Advance = silent) -> Trust:
    """The error map of `arm` (any file of it: nominal, calibrated, with effects) from points of the real one."""
    advance("checking the points", 0.0)
    choice = request.choice.for_points(arm, points)
    problem = problem_of(arm, points, choice)
    warnings = require_usable(arm, points, problem, choice)
    at = Conditions.recorded(arm, points)
    advance("identifying, with what the geometry lacks", 0.1)
    unknown = Discrepancy(arm)
    posterior = posterior_of(problem, at, unknown)
    discrepancy = unknown.knowing(posterior.odds)
    floor, freedom = noise_floor(arm, points, problem, posterior.x), 3 * len(problem) - posterior.x_count
    measuring_m, repeat_m = _noises_m(floor, posterior.noise_m, freedom)
    poses = workspace_poses(arm, (), request.poses_count)
    predictor = Predictor(arm, problem, discrepancy, posterior, repeat_m, poses[:: max(1, len(poses) // 200)])
    advance("predicting errors over the workspace", 0.4)
    sheets = tuple(
        _sheet(predictor, poses, direction, payload_kg) for payload_kg in request.payloads_kg for direction in DIRECTIONS
    )
    coverage = None
    if request.is_checked:
        advance("predicting poses that are left out", 0.6)
        coverage = coverage_of(problem, at, unknown)
    groups = importances(predictor, problem, discrepancy, Conditions.of(poses, 1.0, request.payloads_kg[0]))
    return Trust(
        arm, points, request, posterior, predictor, discrepancy, poses, sheets, coverage, groups, measuring_m, tuple(warnings)
    )


def _noises_m(floor: NoiseFloor | None, noise_m: float, freedom: int) -> tuple[float | None, float]:
    """The measurement's noise, if it is known, and what the arm itself scatters beside it; of one axis [m].

    Both are estimates: of an excess that chance explains (an F test) nothing is the arm's.
    """
    from scipy.special import fdtri

    if floor is None:
        return None, noise_m
    limit = float(fdtri(max(1, freedom), min(floor.freedom, MANY), SURE))
    excess_m2 = noise_m**2 - floor.axis_m**2
    return floor.axis_m, math.sqrt(excess_m2) if noise_m**2 > limit * floor.axis_m**2 else 0.0


def _sheet(predictor: Predictor, q_rad: Array, direction: float, payload_kg: float) -> TrustSheet:
    error = predictor.at(Conditions.of(q_rad, direction, payload_kg))
    return TrustSheet(payload_kg, direction, error, within_95_m(error))


def within_95_m(error: TipError) -> Array:
    """The distance (m,) that one visit keeps in 95 % of cases, by draws of a normal error."""
    normal = np.random.default_rng(0).standard_normal((DRAWS, 3))
    root = np.linalg.cholesky(error.total_m2 + 1e-18 * np.eye(3))
    drawn = error.expected_m[:, None, :] + np.einsum("mij,dj->mdi", root, normal)
    return np.asarray(np.quantile(np.linalg.norm(drawn, axis=2), 0.95, axis=1))


def share_within(distances_m: Sequence[float] | Array, tolerance_m: float) -> float:
    """The share of distances up to a tolerance."""
    return float(np.mean(np.asarray(distances_m) <= tolerance_m))


# Is the prediction right on poses that it has not seen? A fifth of them is left out in turn, and predicted with its interval.
FOLDS: Final = 5
LEAST: Final = 10  # poses, below which nothing is left out
ELLIPSOID_95: Final = 7.815  # 95 % of chi-squared with three degrees of freedom


@dataclass(frozen=True, slots=True)
class Coverage:
    """How many of `count` poses lay inside their 95 % ellipsoids, and their root mean square distances [m].

    without_m: from the arm's own model; left_m: from the predicted error; predicted_m: what the ellipsoids promise.
    """

    count: int
    inside: int
    without_m: float
    left_m: float
    predicted_m: float

    @property
    def share(self) -> float:
        """Of the poses inside."""
        return self.inside / self.count


def coverage_of(problem: ArmProblem, at: Conditions, discrepancy: Discrepancy) -> Coverage | None:
    """Of the recorded poses, noise included; None with fewer than LEAST poses."""
    count = len(problem)
    if count < LEAST:
        return None
    fold = np.random.default_rng(0).permutation(count) % FOLDS
    squares, residuals_m, promised = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
    for k in range(FOLDS):
        held = fold == k
        residuals_m[held], covariance = _predicted(problem, at, discrepancy, held)
        squares[held] = np.einsum(
            "mi,mi->m", residuals_m[held], np.linalg.solve(covariance, residuals_m[held][:, :, None])[:, :, 0]
        )
        promised[held] = np.trace(covariance, axis1=1, axis2=2)
    before = problem.residuals(np.zeros(len(problem.parameters)))
    return Coverage(
        count,
        int((squares < ELLIPSOID_95).sum()),
        float(np.sqrt(np.mean(np.sum(before**2, axis=1)))),
        float(np.sqrt(np.mean(np.sum(residuals_m**2, axis=1)))),
        float(np.sqrt(np.mean(promised))),
    )


def _predicted(problem: ArmProblem, at: Conditions, discrepancy: Discrepancy, held: np.ndarray) -> tuple[Array, Array]:
    """What is left at the poses `held` (h, 3), and its predicted covariance (h, 3, 3)."""
    posterior = posterior_of(problem, at, discrepancy, ~held)
    discrepancy = discrepancy.knowing(posterior.odds)
    design, wanted = linearised(problem, at, discrepancy, posterior.x)
    rows = design[held]
    loose = loose_play_m2(discrepancy, at, problem.solution(posterior.x), posterior)[held]
    spread = np.einsum("mik,kl,mjl->mij", rows, posterior.covariance, rows, optimize=True)
    return wanted[held] - rows @ posterior.mean, spread + loose + posterior.noise_m**2 * np.eye(3)


# Which cause costs most: by how much the tip's error would fall if one were known exactly.
_NUMBER = re.compile(r"\d+$")  # of the link, at the end of theta2


@dataclass(frozen=True, slots=True)
class Importance:
    """A cause, what is expected of it, and its part in what is not known; root mean squares over the poses [m].

    expected_m: displacement by its mean, which the arm's file does not correct. uncertain_m: by its own variance.
    without_m: what would be uncertain in all if this cause were known exactly.
    """

    name: str
    expected_m: float
    uncertain_m: float
    without_m: float


def importances(predictor: Predictor, problem: ArmProblem, discrepancy: Discrepancy, at: Conditions) -> tuple[Importance, ...]:
    """Of every link's geometry, the tool, and every source, the costliest first."""
    columns = predictor.columns(at).reshape(-1, len(predictor.posterior.mean))
    gram = columns.T @ columns / len(at)
    groups = _groups([parameter.name for parameter in problem.parameters], discrepancy, predictor)
    found = [_importance(name, rows, predictor, gram) for name, rows in groups]
    return tuple(sorted(found, key=lambda one: -(one.expected_m**2 + one.uncertain_m**2)))


def _groups(names: Sequence[str], discrepancy: Discrepancy, predictor: Predictor) -> list[tuple[str, list[int]]]:
    groups: dict[str, list[int]] = {}
    for k in predictor.own_places:
        name = names[k]
        kind = "the tool" if name.startswith("tool") else f"link {_link(name)}: geometry"
        groups.setdefault(kind, []).append(k)
    start = predictor.posterior.x_count
    for source, part in zip(discrepancy.sources, discrepancy.slices, strict=True):
        groups[source.name] = list(range(start + part.start, start + part.stop))
    return list(groups.items())


def _importance(name: str, rows: list[int], predictor: Predictor, gram: Array) -> Importance:
    mean, covariance = predictor.posterior.mean[rows], predictor.posterior.covariance
    marginal, mixed = covariance[np.ix_(rows, rows)], covariance[:, rows]
    here = gram[np.ix_(rows, rows)]
    conditional = covariance - mixed @ np.linalg.solve(marginal + 1e-15 * np.eye(len(rows)) * np.trace(marginal), mixed.T)
    return Importance(
        name,
        float(np.sqrt(max(0.0, float(mean @ here @ mean)))),
        float(np.sqrt(max(0.0, np.sum(here * marginal)))),
        float(np.sqrt(max(0.0, np.sum(gram * conditional)))),
    )


def _link(parameter: str) -> str:
    """The link's number in theta2."""
    found = _NUMBER.search(parameter)
    return found[0] if found else parameter
