"""Thinning of long recordings for drawing: envelopes that lose no peak, averaged spectra over time and over motor angle."""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from console.visualisation.series import Array

BUCKETS: Final = 2000  # about the width of a figure in pixels
SEGMENT: Final = 2048  # samples of one piece of a spectrum
SHORTEST: Final = 64  # shortest piece to transform
PER_TURN: Final = 64  # samples of a motor turn
GAP: Final = 10.0  # periods without a sample; a shorter delay is only lateness of the host
TURNS: Final = 8  # of one piece of a spectrum over angle


def envelope(t: Array, values: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """Minimum and maximum of each bucket of time, as one line (2 buckets,); short series unchanged.

    Returns t, values; NaN where a bucket has no other values. No peak is lost, whatever its width.
    """
    if len(t) <= 4 * buckets:
        return t, values
    starts = np.linspace(0, len(t), buckets, endpoint=False).astype(np.int64)
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return np.repeat(t[starts], 2), np.stack([low, high], axis=1).ravel()


def with_gaps(t: Array, values: Array, period_s: float) -> tuple[Array, Array]:
    """Insert a NaN in each gap of time, so that lines do not bridge gaps."""
    if len(t) < 2:
        return t, values
    after = np.flatnonzero(np.diff(t) > GAP * max(period_s, 1e-9)) + 1
    return np.insert(t, after, t[after]), np.insert(values, after, np.nan)


def spectrum(t: Array, values: Array, period_s: float) -> tuple[Array, Array]:
    """Amplitude spectral density of the pieces without gaps: frequency [Hz], value/sqrt(Hz).

    Welch's method on each piece, linear trend removed, averaged by length; samples count as equally spaced. Both empty where
    no piece is long enough.
    """
    from scipy.signal import detrend, welch

    pieces = [piece for piece in _pieces(t, values, period_s) if piece.stop - piece.start >= SHORTEST]
    if not pieces:
        return np.empty(0), np.empty(0)
    length = min(SEGMENT, max(piece.stop - piece.start for piece in pieces))
    total, weight, frequency = np.zeros(length // 2 + 1), 0, np.empty(0)
    for piece in pieces:
        count = piece.stop - piece.start
        if count >= length:
            frequency, power = welch(values[piece], 1.0 / period_s, nperseg=length, detrend=detrend)
            total, weight = total + count * power, weight + count
    return frequency[1:], np.sqrt(total[1:] / weight)


def _pieces(t: Array, values: Array, period_s: float) -> list[slice]:
    """Longest runs of samples that are finite and without a gap in time."""
    is_good = np.isfinite(values)
    breaks = np.flatnonzero((np.diff(t, prepend=t[:1]) > GAP * period_s) | ~is_good)
    ends = np.unique(np.concatenate([[0], breaks, breaks + 1, [len(t)]]))
    ends = ends[ends <= len(t)]
    return [slice(a, b) for a, b in itertools.pairwise(ends) if is_good[a:b].all()]


def orders(motor_turns: Array, values: Array) -> tuple[Array, Array]:
    """Amplitude over the motor's angle: order [per motor turn], amplitude of the value at it.

    Each stretch that turns one way for at least `TURNS` turns is sampled again at equal angles; pieces of `TURNS` turns are
    averaged. Both empty where there is no such stretch.
    """
    powers = [
        piece
        for stretch in _one_way(motor_turns)
        for piece in _turn_spectra(motor_turns[stretch], values[stretch])
    ]
    if not powers:
        return np.empty(0), np.empty(0)
    # a Hann window halves an amplitude, and one side of the spectrum has half of it: 4 / N together
    count = TURNS * PER_TURN
    amplitude = 4.0 / count * np.sqrt(np.mean(powers, axis=0))
    return np.arange(1, count // 2 + 1) / TURNS, amplitude[1:]


def _one_way(turns: Array) -> list[slice]:
    """Stretches in which the angle is finite and strictly rises or falls, `TURNS` turns at least."""
    direction = np.sign(np.diff(turns))
    direction[~np.isfinite(direction)] = 0.0
    changes = np.flatnonzero(np.diff(direction)) + 1
    ends = np.concatenate([[0], changes, [len(direction)]]).astype(np.int64)
    found = []
    for a, b in itertools.pairwise(ends):
        if b > a and direction[a] != 0.0 and abs(turns[b] - turns[a]) >= TURNS:
            found.append(slice(int(a), int(b) + 1))
    return found


def _turn_spectra(turns: Array, values: Array) -> list[Array]:
    if not np.isfinite(values).all():
        return []
    if turns[-1] < turns[0]:
        turns, values = turns[::-1], values[::-1]
    count, found = TURNS * PER_TURN, []
    window: NDArray[np.float64] = np.hanning(count)
    for k in range(int((turns[-1] - turns[0]) / TURNS)):
        grid = turns[0] + TURNS * k + np.arange(count) / PER_TURN
        inside = np.searchsorted(turns, [grid[0], grid[-1]])
        if inside[1] - inside[0] < count // 4:  # too fast for the sampling rate: higher orders would be wrong
            continue
        sampled = np.interp(grid, turns, values)
        line = np.polynomial.polynomial.polyfit(grid - grid[0], sampled, 1)
        sampled = sampled - line[0] - line[1] * (grid - grid[0])
        found.append(np.abs(np.fft.rfft(window * sampled)) ** 2)
    return found
