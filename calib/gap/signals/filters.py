"""The two filters that every term of the equations goes through, so that none is biased against another.

The state filter is a windowed sinc whose derivatives are taken of the kernel itself. Speed and acceleration are thus the
exact derivatives of the filtered angle; central differences are 1.6 % short at 25 Hz and 500 samples a second.
The row filter is narrower and keeps one sample in `step`: rows that follow each other are nearly independent.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.arrays import Array

STATE_Hz = 60.0
STATE_HALF_s = 0.048
ROW_Hz = 25.0
ROW_HALF_s = 0.048
ROWS_PER_s = 62.5


@dataclass(frozen=True, slots=True)
class Filters:
    """Kernels for one sampling rate."""

    rate_Hz: float
    state: tuple[Array, Array, Array]  # value, first and second derivative by time
    row: Array
    step: int
    row_Hz: float  # the band of the rows

    @property
    def speed_gain(self) -> float:
        """Standard deviation of a speed for white noise of 1 rad in the angle."""
        return float(np.linalg.norm(self.state[1]))

    @property
    def row_gain(self) -> float:
        """Standard deviation of a row for white noise of 1 in a signal."""
        return float(np.linalg.norm(np.convolve(self.state[0], self.row)))

    @property
    def reach(self) -> int:
        """Samples that a row needs on either side."""
        return (len(self.row) - 1) // 2

    def states(self, values: Array) -> tuple[Array, Array, Array]:
        """Filtered values (m, n), their speed and acceleration; ends are continued by their end values."""
        half = (len(self.state[0]) - 1) // 2
        padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
        value, speed, acceleration = (np.asarray(windows @ kernel) for kernel in self.state)
        return value, speed, acceleration

    def places(self, count: int) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Samples at whose time a row stands, of `count` samples."""
        return np.arange(self.reach, count - self.reach, self.step)

    def rows(self, values: Array) -> Array:
        """Row-filtered values (m, ...) at `places`: (rows, ...)."""
        values, size = np.ascontiguousarray(values), len(self.row)
        count, (apart, *along) = (len(values) - size) // self.step + 1, values.strides
        # A view, as `sliding_window_view` gives it; that one takes longer than the product, ten thousands of times.
        windows: Array = np.ndarray((count, *values.shape[1:], size), values.dtype, values, 0, (self.step * apart, *along, apart))
        return np.asarray(windows @ self.row)


def filters_for(rate_Hz: float) -> Filters:
    """Kernels for a sampling rate; the bands shrink with rates below 400 Hz."""
    state_Hz, row_Hz = min(STATE_Hz, 0.2 * rate_Hz), min(ROW_Hz, 0.1 * rate_Hz)
    half = max(4, round(STATE_HALF_s * rate_Hz * STATE_Hz / state_Hz))
    row_half = max(4, round(ROW_HALF_s * rate_Hz * ROW_Hz / row_Hz))
    row = _sinc(row_Hz, row_half, rate_Hz)
    return Filters(
        rate_Hz,
        _with_derivatives(state_Hz, half, rate_Hz),
        row / row.sum(),
        max(1, round(rate_Hz / min(ROWS_PER_s, 2.5 * row_Hz))),
        row_Hz,
    )


def _kernel(t_s: Array, cut_Hz: float, half_s: float) -> Array:
    window = np.where(np.abs(t_s) < half_s, np.cos(0.5 * np.pi * t_s / half_s) ** 4, 0.0)
    return np.asarray(np.sinc(2.0 * cut_Hz * t_s) * window)


def _sinc(cut_Hz: float, half: int, rate_Hz: float) -> Array:
    return _kernel(np.arange(-half, half + 1) / rate_Hz, cut_Hz, (half + 1) / rate_Hz)


def _with_derivatives(cut_Hz: float, half: int, rate_Hz: float) -> tuple[Array, Array, Array]:
    """The kernel and its derivatives, without offset."""
    t, h = np.arange(-half, half + 1) / rate_Hz, 1e-5
    wide = (half + 1) / rate_Hz
    middle, ahead, behind = (_kernel(t + d, cut_Hz, wide) for d in (0.0, h, -h))
    first, second = (ahead - behind) / (2 * h), (ahead - 2 * middle + behind) / h**2
    scale = middle.sum()
    value, speed, acceleration = middle / scale, first / scale, second / scale
    # Applied as a correlation, y(t) = sum k(tau) x(t + tau), so the odd kernel turns round.
    speed = -speed
    speed /= speed @ t
    acceleration[half] -= acceleration.sum()
    return value, speed, acceleration
