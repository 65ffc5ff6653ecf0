"""Weaving deviations, ISO 9283:1998 clause 11: stroke and frequency of a path that weaves about a line."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.iso9283.criteria.checks import Iso9283Error, above_zero, direction, track


@dataclass(frozen=True, slots=True)
class Weave:
    """A recorded weave: `stroke_m` from crest to crest across the line, `frequency_Hz`."""

    stroke_m: float
    frequency_Hz: float


def weaving_deviations(commanded: Weave, attained: Weave) -> tuple[float, float]:
    """WS and WF (clause 11) in %: WS = 100 |s_a - s_c| / s_c, WF = 100 (f_a - f_c) / f_c.

    s: stroke, f: frequency; index a attained, c commanded.
    """
    stroke = above_zero(commanded.stroke_m, "weaving, commanded stroke")
    frequency = above_zero(commanded.frequency_Hz, "weaving, commanded frequency")
    return (
        100.0 * abs(attained.stroke_m - stroke) / stroke,
        100.0 * (attained.frequency_Hz - frequency) / frequency,
    )


def weave_of(time_s: npt.ArrayLike, tip_m: npt.ArrayLike, across: npt.ArrayLike) -> Weave:
    """Stroke and frequency of a recorded weave; `across` (3,) is the direction across the line.

    Crests are the extremes between crossings of the middle; the stroke is the mean distance from crest to crest, the
    frequency that of the crossings. The first and last half weaves, where the arm starts and stops, do not
    count.
    """
    times, tips = track(time_s, tip_m, "weaving")
    swing = (tips - tips.mean(axis=0)) @ direction(across, "direction across the weave")
    y = swing - np.polyval(np.polyfit(times - times[0], swing, 1), times - times[0])  # tilt of the line
    y = y - 0.5 * (y.max() + y.min())
    at = _crossings(y, 0.1 * float(y.max() - y.min()))
    if len(at) < 4:
        raise Iso9283Error(f"weaving: needs at least four crossings of the middle line, got {len(at)}")
    # Crest to crest on the measured values: the tilt of the line cancels between up and down.
    crests = np.array(
        [swing[a + 1 + int(np.argmax(np.abs(y[a + 1 : b + 1])))] for a, b in itertools.pairwise(at)]
    )
    strokes = np.abs(np.diff(crests))
    share = y[at] / (y[at] - y[at + 1])
    crossed_s = times[at] + share * (times[at + 1] - times[at])
    half_waves = len(at) - 1
    frequency = 0.5 * half_waves / float(crossed_s[-1] - crossed_s[0])
    return Weave(
        0.5 * float(strokes[::2].mean() + strokes[1::2].mean()) if len(strokes) > 1 else float(strokes[0]),
        frequency,
    )


def _crossings(y: Array, least: float) -> npt.NDArray[np.intp]:
    """Sample before each zero crossing that reaches at least `least`, to ignore noise."""
    found: list[int] = []
    side = 0.0
    last = 0
    for k, value in enumerate(y):
        if abs(value) < least:
            continue
        if side and np.sign(value) != side:
            between = y[last : k + 1]
            found.append(last + int(np.flatnonzero(np.sign(between[:-1]) != np.sign(between[1:]))[0]))
        side, last = float(np.sign(value)), k
    return np.array(found, dtype=np.intp)
