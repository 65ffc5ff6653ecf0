"""Settling at a pose: ISO 9283:1998 clauses 7.4 (stabilization), 7.5 (overshoot) and 9 (posing time).

A recording is times (k,) [s] and positions (k, 3) [m] of one approach, long enough that its end is at rest. The limit
band is a sphere of radius `band_m` about the attained pose: the pose repeatability in the standard, or the user's
value.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, norms
from calib.iso9283.criteria.checks import Iso9283Error, above_zero, position, track


def rest_position(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, rest_s: float) -> Array:
    """The attained pose (3,): the mean over the last `rest_s` of a recording."""
    times, tips = track(time_s, tip_m, "position at rest")
    return np.asarray(tips[times >= times[-1] - above_zero(rest_s, "position at rest, time")].mean(axis=0))


def stabilization_time(
    time_s: npt.ArrayLike, tip_m: npt.ArrayLike, attained_m: npt.ArrayLike, band_m: float
) -> float:
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


def posing_time(
    time_s: npt.ArrayLike,
    tip_m: npt.ArrayLike,
    started_s: float,
    attained_m: npt.ArrayLike,
    band_m: float,
) -> float:
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
