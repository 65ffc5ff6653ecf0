"""The noise floor of static poses: what one measurement of tip and orientation scatters by, and who says so."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calib.arrays import Array, Mask
from calib.gap.finding import EffectName
from calib.gap.poses.linear import Linear, Measured, Residuals
from calib.gap.poses.recordings import in_turn
from calib.gap.posterior.constants import AGREE, FAR, OUTLIERS_MOST, CHECKED_sd
from calib.gap.posterior.term import Term
from calib.points.points import Points, matrices_of
from calib.validation.verdict import REPEATS_FREEDOM
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm

SAME_POSE_rad = 0.03
QUARTILE = 1.212533  # of chi-square with three degrees of freedom
QUARTILE_CHANCE = 3.0 * 0.745  # three standard deviations of its root, as a share, times the root of the count
FINEST_rad = 1e-7  # the same of orientations and angles
FINEST_m = 1e-7  # repeats that are closer are copies of each other: no camera or tracker measures finer
SHEET_WORTH = 200  # pairs that a data sheet counts for, where repeats bear it out


@dataclass(frozen=True, slots=True)
class Floor:
    """Standard deviation of one axis of the tip, and where the figure comes from; NaN where nothing tells it.

    `doubt`: the figure's own standard deviation, as a share of it, as far as it rests on repeats. `turn_rad`: of a measured
    orientation about one axis.
    """

    tip_m: float
    source: str
    doubt: float = 0.0
    turn_rad: float = math.nan

    @property
    def sizes(self) -> dict[str, float]:
        """By channel, of those whose noise is known."""
        return {"tip_m": self.tip_m} | ({"turn_rad": self.turn_rad} if math.isfinite(self.turn_rad) else {})

    @property
    def lever_m(self) -> float:
        """Noise of a tip over that of an orientation; 0 where nothing tells the latter, so that orientations are not used."""
        return self.tip_m / self.turn_rad if math.isfinite(self.turn_rad) else 0.0


def noise_floor(arm: Arm, points: Points, residual: Residuals, out: Mask | None = None) -> Floor:
    """From repeats: poses of one point with the same payload and approach; else from the camera's data sheet.

    `residual` of any fitted model: what it lacks is the same for all repeats of a point, and drops out. `out` (m,): poses that do
    not count.
    """
    pairs = _pairs(points, out)
    tips, turn_rad = _of_tips(arm, points, residual.tip_m, pairs), _of_turns(arm, points, residual.turn_rad, pairs)
    of_counts = _of_counts(arm, points)
    return replace(tips, tip_m=math.hypot(tips.tip_m, of_counts.tip_m), turn_rad=math.hypot(turn_rad, of_counts.turn_rad))


def counted_rad(arm: Arm, points: Points) -> Array:
    """The standard deviation of each joint's angle within the encoder's count that it was read in, step / sqrt(12), (n,).

    Angles that lie closer together than a step were not read in whole counts.
    """
    step_rad = np.zeros(arm.joint_count)
    for drive in arm.drives:
        apart = np.diff(np.unique(points.q_rad[:, drive.joint - 1]))
        stated = 2.0 * np.pi / drive.counts_per_joint_turn
        step_rad[drive.joint - 1] = apart[apart > FINEST_rad].min(initial=stated)
    return np.asarray(step_rad / np.sqrt(12.0))


def _of_counts(arm: Arm, points: Points) -> Floor:
    """What the encoders' steps leave of one axis: repeats end within the same counts, and never show it. Tip and last link follow
    all joints.
    """
    sd_rad = counted_rad(arm, points)
    moved_m = ForwardKinematics(arm).jacobians(points.q_rad) * sd_rad
    tip_m = math.sqrt(float(np.mean(np.sum(moved_m**2, axis=(1, 2)))) / 3.0)
    return Floor(tip_m, "the encoders' steps", turn_rad=float(np.linalg.norm(sd_rad)) / math.sqrt(3.0))


def _pairs(points: Points, out: Mask | None) -> list[tuple[int, int]]:
    """Repeats of one pose that follow each other."""
    groups: dict[tuple[object, ...], list[int]] = {}
    for k in in_turn(points).tolist():
        if out is not None and out[k]:
            continue
        key = (
            points.setup[k],
            points.point[k],
            float(points.payload_kg[k]) if math.isfinite(points.payload_kg[k]) else None,
            *points.direction[k].tolist(),
        )
        groups.setdefault(key, []).append(k)
    return [pair for rows in groups.values() for pair in pairwise(rows) if _is_same_pose(points, *pair)]


def _of_turns(arm: Arm, points: Points, turn_rad: Array, pairs: Sequence[tuple[int, int]]) -> float:
    """Of orientations [rad]: their repeats, else the points' covariances or the data sheet; NaN where nothing tells it."""
    first, second = (turn_rad[[pair[k] for pair in pairs]] for k in (0, 1))
    apart = (first - second)[np.isfinite(first - second).all(axis=1)] if pairs else np.zeros((0, 3))
    if 3 * len(apart) >= REPEATS_FREEDOM and (scatter := _scatter_m(apart)) > FINEST_rad:
        return scatter
    stated = points.covariance[np.isfinite(points.covariance[:, 6:]).all(axis=1), 6:]
    if len(stated):
        return float(np.median(np.sqrt(np.trace(matrices_of(stated), axis1=1, axis2=2) / 3.0)))
    sheet = arm.camera.orientation_noise_rad if arm.camera is not None else 0.0
    return sheet if sheet > 0.0 else math.nan


def _of_tips(arm: Arm, points: Points, residual_m: Array, pairs: Sequence[tuple[int, int]]) -> Floor:
    sheet_m = arm.camera.position_noise_m if arm.camera is not None else 0.0
    if 3 * len(pairs) < REPEATS_FREEDOM:
        if sheet_m > 0.0:
            return Floor(sheet_m, "the camera's data sheet in arm.toml; there are too few repeats")
        return Floor(math.nan, "nothing: too few repeats, and no camera noise in arm.toml")
    if sheet_m > 0.0 and not points.direction.any():
        return Floor(sheet_m, "the camera's data sheet in arm.toml; repeats whose approach is unknown may hold play")
    apart = residual_m[[a for a, _ in pairs]] - residual_m[[b for _, b in pairs]]
    scatter_m = _scatter_m(apart)
    if scatter_m < FINEST_m:
        copies = f"the {len(pairs)} repeats are copies of each other"
        if sheet_m > 0.0:
            return Floor(sheet_m, f"the camera's data sheet in arm.toml; {copies}")
        return Floor(math.nan, f"nothing: {copies}, and there is no camera noise in arm.toml")
    return _with_sheet(scatter_m, len(pairs), sheet_m)


def _is_same_pose(points: Points, a: int, b: int) -> bool:
    """One place in another posture is no repeat: what the model lacks differs there."""
    return float(np.abs(points.q_rad[a] - points.q_rad[b]).max()) < SAME_POSE_rad


def _with_sheet(scatter_m: float, pairs_count: int, sheet_m: float) -> Floor:
    """The repeats' scatter; where the data sheet agrees with it, as well as so many pairs know it, both."""
    source, doubt = (f"{pairs_count} repeats", 1.0 / math.sqrt(6.0 * pairs_count))  # of a root of 3 squares a pair
    if not abs(scatter_m - sheet_m) <= max(AGREE, CHECKED_sd * doubt) * sheet_m:
        return Floor(scatter_m, source, doubt)
    weight = pairs_count / (pairs_count + SHEET_WORTH)
    both = math.sqrt(weight * scatter_m**2 + (1.0 - weight) * sheet_m**2)
    return Floor(both, f"{source} and the camera's data sheet, which agree", weight * doubt)


def _scatter_m(apart_m: Array) -> float:
    """Standard deviation of one axis, from differences (pairs, 3) between two measurements of the same.

    Root mean square, unless the lower quartile says that most of it is not noise: a joint that slips in a session parts half
    of the pairs and must not pass for the floor.
    """
    square = np.einsum("ij,ij->i", apart_m, apart_m) / 2.0
    rms, chance = math.sqrt(float(square.mean()) / 3.0), QUARTILE_CHANCE / math.sqrt(len(square))
    quartile = math.sqrt(float(np.quantile(square, 0.25)) / QUARTILE)
    return rms if rms <= (1.0 + max(AGREE, chance)) * quartile else quartile


# Poses that no model explains and that are few: swapped rows, a marker that was lost. They are left out, and said.
#
# Looked for beside everything that the list knows, fitted at once, so that a joint's play is no outlier; and only where the rest
# agrees, so that an effect that nobody knows is none either. Which flank a loose gear lies on is not known at a few poses: of all
# its variants the one counts that leaves the fewest poses out.
LOOKS = 8
MEDIAN = 1.5382  # of the length of three unit normals


def outlying(linear: Linear, variants: Sequence[Sequence[Term]], noise_m: float) -> Mask:
    """The poses (m,) that are to be left out; none where many or none are far off.

    `variants` of each term of `linear`, which has the middle ones; noise_m: a first idea of the noise.
    """
    terms, columns = [middle(same) for same in variants], linear.columns
    out = _far(linear, columns, terms, noise_m)
    if not 0.0 < out.mean() <= OUTLIERS_MOST:
        return np.zeros_like(out)
    for number, same in enumerate(variants):
        for variant in same if len(same) > 1 else ():
            tried, others = columns.copy(), [*terms[:number], variant, *terms[number + 1 :]]
            tried[:, linear.places[number]] = linear.measured.moved_by(variant).reshape(variant.count, -1).T
            far = _far(linear, tried, others, noise_m)
            if far.sum() < out.sum():
                out, columns, terms = far, tried, others
    return out


def middle(variants: Sequence[Term]) -> Term:
    """The variant that is tried first."""
    return variants[len(variants) // 2]


def _far(linear: Linear, columns: Array, terms: Sequence[Term], noise_m: float) -> Mask:
    """Poses (m,) that columns (3R, p) beside the geometry leave far off, both fitted to the other poses."""
    whole, y, pose = np.hstack((linear.base, columns)) / noise_m, linear.y / noise_m, linear.measured.pose
    out = np.zeros(int(pose.max()) + 1, dtype=bool)
    kinds = np.arange(len(pose)) < len(out)  # of tips; the other rows are orientations
    for _ in range(LOOKS):
        keep = np.repeat(~out[pose], 3)
        size = _fitted(whole[keep], y[keep])
        residual = (y - whole @ size).reshape(-1, 3)
        flanks = _uncertain(linear, terms, size[linear.base.shape[1] :], noise_m)
        far = np.sqrt(np.einsum("mi,mij,mj->m", residual, np.linalg.inv(np.eye(3) + flanks), residual))
        now = np.zeros_like(out)
        for kind in (kinds, ~kinds) if not kinds.all() else (kinds,):
            scatter = float(np.median(far[kind])) / MEDIAN
            now[pose[kind][far[kind] > FAR * max(scatter, 1.0)]] = True  # few poses are fitted too well
        if (now == out).all():
            break
        out = now
    return out


def _uncertain(linear: Linear, terms: Sequence[Term], size: Array, noise_m: float) -> Array:
    """Covariance (R, 3, 3) of the rows, in variances of the noise, from gears that may lie on the other flank."""
    measured = linear.measured
    total = np.zeros((len(measured.pose), 3, 3))
    for term, place in zip(terms, linear.places, strict=True):
        total += flank_covariance(measured, term, float(size[place.start]) / noise_m)
    return total


def flank_covariance(measured: Measured, term: Term, coefficient: float) -> Array:
    """Covariance (R, 3, 3) of rows whose joint may lie on the other flank; 0 where nothing is uncertain."""
    if term.doubt is None or not isinstance(term.key, EffectName) or term.key.joint is None:
        return np.zeros((1, 3, 3))
    lever = measured.by_joint[:, :, term.key.joint - 1] * (term.size * coefficient)
    return np.asarray(term.doubt[measured.pose, None, None] * lever[:, :, None] * lever[:, None, :])


def _fitted(columns: Array, y: Array) -> Array:
    """Coefficients of a ridge."""
    return np.asarray(np.linalg.solve(columns.T @ columns + np.eye(columns.shape[1]), columns.T @ y))
