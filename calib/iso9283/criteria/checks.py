"""Input checks of the criteria, and their error."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
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
        raise Iso9283Error(
            f"{what}: measurement {bad[0] + 1} of {len(array)} is not finite: remove rows that were not measured"
        )
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
        raise Iso9283Error(
            f"{what}: time does not increase at sample {at}: sort it, and give one recording at a time"
        )
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
