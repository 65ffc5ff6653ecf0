"""Pose characteristics, ISO 9283:1998 clause 7: attained poses for repeated commands of the same pose.

Symbols: (x_c, y_c, z_c) the commanded position, (x_j, y_j, z_j) the j-th attained one of n, and
x_bar = 1/n sum x_j the barycentre of the attained. All positions are (n, 3) in one frame, in m; angles in rad.

Settling (clauses 7.4 stabilization, 7.5 overshoot, 9 posing time): a recording is times (k,) [s] and positions (k, 3) [m] of one
approach, long enough that its end is at rest. The limit band is a sphere of radius `band_m` about the attained pose: the pose
repeatability in the standard, or the user's value.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError


class Iso9283Error(CalibrationError):
    """A criterion cannot be evaluated from the input; the message says what it needs."""


def positions(values: npt.ArrayLike, what: str, least: int = 1) -> Array:
    """`values` as finite positions (n, 3); Iso9283Error for another shape, fewer than `least`, or non-finite numbers."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise Iso9283Error(f"{what}: expected positions (n, 3), got an array {array.shape}")
    if len(array) < least:
        raise Iso9283Error(f"{what}: needs at least {least} measurements, got {len(array)}")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if len(bad):
        raise Iso9283Error(f"{what}: measurement {bad[0] + 1} of {len(array)} is not finite: remove rows that were not measured")
    return array


def position(values: npt.ArrayLike, what: str) -> Array:
    """One finite position (3,)."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise Iso9283Error(f"{what}: expected a finite position (3,), got {array.tolist()}")
    return array


def track(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, what: str, least: int = 2) -> tuple[Array, Array]:
    """Increasing times (k,) and positions (k, 3) of one recording."""
    times, tips = np.asarray(time_s, dtype=np.float64), positions(tip_m, what, least)
    if times.shape != (len(tips),) or not np.isfinite(times).all():
        raise Iso9283Error(f"{what}: expected {len(tips)} finite times, got an array {times.shape}")
    if not (np.diff(times) > 0.0).all():
        at = int(np.argmax(np.diff(times) <= 0.0)) + 2
        raise Iso9283Error(f"{what}: time does not increase at sample {at}: sort it, and give one recording at a time")
    return times, tips


def above_zero(value: float, what: str) -> float:
    """A finite number above zero."""
    if not (np.isfinite(value) and value > 0.0):
        raise Iso9283Error(f"{what}: expected a number above zero, got {value:g}")
    return float(value)


def direction(values: npt.ArrayLike, what: str) -> Array:
    """A vector (3,) scaled to length one; Iso9283Error for a zero vector."""
    vector = position(values, what)
    if not np.linalg.norm(vector) > 0.0:
        raise Iso9283Error(f"{what}: expected a direction, got a vector of length zero")
    return np.asarray(vector / np.linalg.norm(vector))


SIGMAS = 3.0  # of the standard deviation, throughout the standard


@dataclass(frozen=True, slots=True)
class PoseAccuracy:
    """A deviation of a mean: `total` [m] and its components along x, y, z (3,) [m]."""

    total_m: float
    axes_m: Array


@dataclass(frozen=True, slots=True)
class Drift:
    """Change of pose accuracy and repeatability over a time, and motion of the barycentre, in m.

    `accuracy_m` is the standard's dAP, the change of a distance: a barycentre that moves around the commanded
    pose at constant distance leaves it at zero. `barycentre_m` (no figure of the standard) shows that too.
    `repeatability_m` is None where a set has fewer than two measurements.
    """

    accuracy_m: float
    repeatability_m: float | None
    barycentre_m: float


def pose_accuracy(commanded_m: npt.ArrayLike, attained_m: npt.ArrayLike) -> PoseAccuracy:
    """AP (clause 7.2): from the commanded pose to the barycentre of the attained ones.

    AP_p = sqrt((x_bar - x_c)^2 + (y_bar - y_c)^2 + (z_bar - z_c)^2), and AP_x = x_bar - x_c and so on.
    commanded_m (3,), attained_m (n, 3), n >= 1 (the standard: 30).
    """
    wanted = position(commanded_m, "pose accuracy, commanded")
    deviation = positions(attained_m, "pose accuracy").mean(axis=0) - wanted
    return PoseAccuracy(float(np.linalg.norm(deviation)), frozen(deviation))


def pose_repeatability(attained_m: npt.ArrayLike) -> float:
    """RP (clause 7.2): the radius about the barycentre within which the attained positions scatter.

    RP_l = l_bar + 3 S_l with l_j = |p_j - p_bar|, l_bar = 1/n sum l_j,
    S_l = sqrt(sum (l_j - l_bar)^2 / (n - 1)). attained_m (n, 3), n >= 2.
    """
    attained = positions(attained_m, "pose repeatability", least=2)
    lengths = norms(attained - attained.mean(axis=0))
    mean, sd = float(lengths.mean()), float(lengths.std(ddof=1))
    return mean + SIGMAS * sd


def orientation_accuracy(commanded_rad: npt.ArrayLike, attained_rad: npt.ArrayLike) -> Array:
    """AP_a, AP_b, AP_c (clause 7.2): mean attained minus commanded angle about each axis, (3,), within +-pi.

    AP_a = a_bar - a_c. commanded_rad (3,), attained_rad (n, 3): any three angles, measured the same way.
    """
    return frozen(_turned(commanded_rad, attained_rad, "orientation accuracy", 1).mean(axis=0))


def orientation_repeatability(attained_rad: npt.ArrayLike) -> Array:
    """RP_a, RP_b, RP_c (clause 7.2): +-3 S_a, S_a = sqrt(sum (a_j - a_bar)^2 / (n - 1)); (3,), n >= 2."""
    attained = positions(attained_rad, "orientation repeatability", least=2)
    return frozen(SIGMAS * _turned(attained[0], attained, "orientation repeatability", 2).std(axis=0, ddof=1))


def multidirectional_variation(attained_by_direction_m: Sequence[npt.ArrayLike]) -> float:
    """VAP (clause 7.2): the largest distance between barycentres attained from different directions.

    vAP_p = max over h, k of |p_bar_h - p_bar_k|, h, k = 1, 2, 3: three perpendicular approach directions, each
    attained (n, 3).
    """
    return _widest(attained_by_direction_m, "multi-directional pose accuracy variation", "approach directions")


def exchangeability(attained_by_robot_m: Sequence[npt.ArrayLike]) -> float:
    """E (clause 7.7): the largest distance between the barycentres of several robots sent to the same pose.

    E = max over h, k of |p_bar_h - p_bar_k|; five robots of one type in the standard, mounted in the same place,
    the same programme and frame, pose P1.
    """
    return _widest(attained_by_robot_m, "exchangeability", "robots")


def distance_accuracy(
    commanded_1_m: npt.ArrayLike, commanded_2_m: npt.ArrayLike, attained_1_m: npt.ArrayLike, attained_2_m: npt.ArrayLike
) -> PoseAccuracy:
    """AD (clause 7.3): mean attained distance minus commanded distance between two poses.

    AD = D_bar - D_c, D_c = |p_c1 - p_c2|, D_bar = 1/n sum |p_1j - p_2j|; total_m carries the sign. Along an axis
    AD_x = D_bar_x - D_cx with D_xj = |x_1j - x_2j|, D_cx = |x_c1 - x_c2|. attained (n, 3) each, taken in pairs.
    """
    wanted = position(commanded_1_m, "distance accuracy, commanded 1") - position(commanded_2_m, "distance accuracy, commanded 2")
    difference = _differences(attained_1_m, attained_2_m, "distance accuracy", 1)
    total = float(norms(difference).mean() - np.linalg.norm(wanted))
    return PoseAccuracy(total, frozen(np.abs(difference).mean(axis=0) - np.abs(wanted)))


def distance_repeatability(attained_1_m: npt.ArrayLike, attained_2_m: npt.ArrayLike) -> PoseAccuracy:
    """RD (clause 7.3): +-3 standard deviations of the attained distance, and of its components.

    RD = 3 sqrt(sum (D_j - D_bar)^2 / (n - 1)), D_j = |p_1j - p_2j|; n >= 2.
    """
    difference = _differences(attained_1_m, attained_2_m, "distance repeatability", 2)
    axes = SIGMAS * np.abs(difference).std(axis=0, ddof=1)
    return PoseAccuracy(float(SIGMAS * norms(difference).std(ddof=1)), frozen(axes))


def drift(commanded_m: npt.ArrayLike, first_m: npt.ArrayLike, last_m: npt.ArrayLike) -> Drift:
    """DAP and dRP (clause 7.6): how pose accuracy and repeatability change over a time T.

    dAP_p = |AP_p(t = 0) - AP_p(t = T)|, dRP_l = |RP_l(t = 0) - RP_l(t = T)|. first_m, last_m (n, 3): the set of
    measurements (ten cycles in the standard) at the beginning and at the end.
    """
    first, last = positions(first_m, "drift, first set"), positions(last_m, "drift, last set")
    before, after = pose_accuracy(commanded_m, first), pose_accuracy(commanded_m, last)
    repeatability = None
    if min(len(first), len(last)) >= 2:
        repeatability = abs(pose_repeatability(first) - pose_repeatability(last))
    moved = float(np.linalg.norm(after.axes_m - before.axes_m))
    return Drift(abs(after.total_m - before.total_m), repeatability, moved)


def _turned(reference_rad: npt.ArrayLike, attained_rad: npt.ArrayLike, what: str, least: int) -> Array:
    """Angles minus the reference, each turned into -pi .. pi."""
    difference = positions(attained_rad, what, least) - position(reference_rad, f"{what}, commanded")
    return np.asarray((difference + np.pi) % (2.0 * np.pi) - np.pi)


def _differences(first_m: npt.ArrayLike, second_m: npt.ArrayLike, what: str, least: int) -> Array:
    first, second = (positions(first_m, f"{what}, pose 1", least), positions(second_m, f"{what}, pose 2", least))
    if len(first) != len(second):
        raise Iso9283Error(f"{what}: expected pairs, got {len(first)} and {len(second)} measurements")
    return np.asarray(first - second)


def _widest(groups_m: Sequence[npt.ArrayLike], what: str, of: str) -> float:
    """Largest distance between the barycentres of groups of positions."""
    if len(groups_m) < 2:
        raise Iso9283Error(f"{what}: needs the attained positions of at least two {of}, got {len(groups_m)}")
    centres = [positions(group, f"{what}, group {k}").mean(axis=0) for k, group in enumerate(groups_m, start=1)]
    return max(float(np.linalg.norm(a - b)) for a, b in combinations(centres, 2))


# Static compliance, ISO 9283:1998 clause 10: displacement of the tip under a load, with the drives holding.
@dataclass(frozen=True, slots=True)
class Compliance:
    """Displacement per unit load (3, 3) [m/N]: column k is the tip's displacement by one newton along axis k.

    `sd_m_N` (3, 3): standard deviation of each, from the residuals of the fit; NaN without residuals.
    Columns of axes without loads are NaN.
    """

    m_N: Array
    sd_m_N: Array


def static_compliance(force_N: npt.ArrayLike, tip_m: npt.ArrayLike) -> Compliance:
    """The least-squares slope of displacement over force (clause 10).

    The standard loads the three base axes in both directions in steps of a tenth of the rated load, three times each.
    force_N (n, 3), tip_m (n, 3).
    """
    forces, tips = positions(force_N, "static compliance, force", 2), positions(tip_m, "static compliance", 2)
    if len(forces) != len(tips):
        raise Iso9283Error(f"static compliance: {len(forces)} forces for {len(tips)} positions")
    forces, tips = forces - forces.mean(axis=0), tips - tips.mean(axis=0)
    loaded = np.flatnonzero(np.abs(forces).max(axis=0) > 0.0)
    if not len(loaded):
        raise Iso9283Error("static compliance: needs at least two different loads, got one")
    slope, _, rank, _ = np.linalg.lstsq(forces[:, loaded], tips, rcond=None)
    if rank < len(loaded):
        raise Iso9283Error("static compliance: loads along different axes always changed together: load one axis at a time")
    compliance, sd = np.full((3, 3), np.nan), np.full((3, 3), np.nan)
    compliance[:, loaded] = slope.T
    freedom = len(tips) - 1 - len(loaded)
    if freedom > 0:
        residuals = tips - forces[:, loaded] @ slope
        per_force = np.diag(np.linalg.inv(forces[:, loaded].T @ forces[:, loaded]))
        sd[:, loaded] = np.sqrt(np.outer((residuals**2).sum(axis=0) / freedom, per_force))
    return Compliance(frozen(compliance), frozen(sd))


def rest_position(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, rest_s: float) -> Array:
    """The attained pose (3,): the mean over the last `rest_s` of a recording."""
    times, tips = track(time_s, tip_m, "position at rest")
    return np.asarray(tips[times >= times[-1] - above_zero(rest_s, "position at rest, time")].mean(axis=0))


def stabilization_time(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, attained_m: npt.ArrayLike, band_m: float) -> float:
    """T (clause 7.4): from the first crossing into the limit band until the arm stays within it, in s.

    Zero for an arm that enters the band and stays. The crossing is interpolated between samples.
    """
    times, distance = _distances(time_s, tip_m, attained_m, band_m, "stabilization time")
    return _last_entry(times, distance, band_m) - _first_entry(times, distance, band_m)


def overshoot(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, attained_m: npt.ArrayLike, band_m: float) -> float:
    """OV (clause 7.5): the largest distance from the attained pose after the first crossing into the limit band.

    OV = max_i |p_i - p|, i after the crossing; 0 if the arm does not leave the band again. Of several
    cycles (three in the standard) the largest counts.
    """
    _, distance = _distances(time_s, tip_m, attained_m, band_m, "overshoot")
    largest = float(distance[int(np.argmax(distance <= band_m)) :].max())
    return largest if largest > band_m else 0.0


def posing_time(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, started_s: float, attained_m: npt.ArrayLike, band_m: float) -> float:
    """Minimum posing time (clause 9): from departure from rest until the arm stays within the limit band, in s.

    It includes the stabilization. `started_s` is when the motion was started.
    """
    times, distance = _distances(time_s, tip_m, attained_m, band_m, "posing time")
    return _last_entry(times, distance, band_m) - float(started_s)


def mean_of_cycles(values: Sequence[float]) -> float:
    """The mean of repeated cycles; Iso9283Error for none."""
    if not len(values):
        raise Iso9283Error("mean over cycles: expected at least one cycle, got none")
    return float(np.mean(values))


def _distances(
    time_s: npt.ArrayLike, tip_m: npt.ArrayLike, attained_m: npt.ArrayLike, band_m: float, what: str
) -> tuple[Array, Array]:
    times, tips = track(time_s, tip_m, what)
    above_zero(band_m, f"{what}, limit band")
    distance = norms(tips - position(attained_m, f"{what}, attained pose"))
    if distance[-1] > band_m:
        raise Iso9283Error(
            f"{what}: the recording ends {1e3 * distance[-1]:.3f} mm from the attained pose, outside the limit band"
            f" of {1e3 * band_m:.3f} mm: record until the arm rests, or choose a wider band"
        )
    return times, distance


def _first_entry(times: Array, distance: Array, band_m: float) -> float:
    k = int(np.argmax(distance <= band_m))
    return _crossed_at(times, distance, k, band_m)


def _last_entry(times: Array, distance: Array, band_m: float) -> float:
    outside = np.flatnonzero(distance > band_m)
    return _crossed_at(times, distance, int(outside[-1]) + 1 if len(outside) else 0, band_m)


def _crossed_at(times: Array, distance: Array, k: int, band_m: float) -> float:
    """Time of the crossing into the band before sample k, which is inside."""
    if k == 0:
        return float(times[0])
    share = (distance[k - 1] - band_m) / (distance[k - 1] - distance[k])
    return float(times[k - 1] + share * (times[k] - times[k - 1]))
