"""Signals without their measurement noise, for the columns of what may be missing.

Measured accelerations stand in every residual with their noise. A column with the same noise is drawn to minus one times it, and
other columns then make up for what that takes off the motion. What a column is made of must therefore not have that noise
(instrumental variables: Janot, Vandanjon, Gautier, IEEE Trans. Control Systems Technology 22 (2014) 132): a Wiener filter
leaves of each frequency the share that is surely motion (or, of currents, current).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.arrays import Array
from calib.gap.signals.filters import Filters
from calib.gap.signals.recording import EvenRun, RunSet

SMOOTHED_Hz = 2.0  # of the spectrum
NOISE_FROM = 0.7  # of the highest frequency: no arm moves there, and what is there is the sensor's noise
SURELY = 3.0  # times the noise: what is less may be noise


def without_noise(recording: RunSet) -> RunSet:
    """The same with motions, currents and voltages as far as they are surely no noise."""
    return replace(recording, runs=tuple(_smooth(run, recording.filters) for run in recording.runs))


def _smooth(run: EvenRun, filters: Filters) -> EvenRun:
    beside = (len(filters.state[0]) - 1) // 2  # samples at the end that the filter knows half
    of_angle, of_current = (_shares(own, filters.rate_Hz) for own in (run.q_raw, run.current_raw_A))
    speed, acceleration = (_passed(own, of_angle, beside) for own in (run.speed, run.acceleration))
    current, slope = (_passed(own, of_current, beside) for own in (run.current_A, run.current_slope))
    voltage = _passed(run.voltage_V, of_angle, beside)  # the controller answers to the angles' noise, too
    return replace(
        run, speed=speed, acceleration=acceleration, current_A=current, current_slope=slope, voltage_V=voltage
    )


def _passed(values: Array, shares: Array, beside: int) -> Array:
    """Values (m, n) with shares (frequencies, n) of what they consist of."""
    count = len(values)
    held = values.copy()
    held[count - beside :] = values[count - beside - 1]
    doubled = np.concatenate((held, held[::-1]))  # no step at the ends
    at = np.linspace(0.0, len(shares) - 1.0, count + 1)
    own = np.stack([np.interp(at, np.arange(len(shares)), one) for one in shares.T], axis=1)
    return np.asarray(np.fft.irfft(np.fft.rfft(doubled, axis=0) * own, 2 * count, axis=0)[:count])


def _shares(measured: Array, rate_Hz: float) -> Array:
    """What of each frequency is no noise, (frequencies, n)."""
    count = len(measured)
    ramp = np.linspace(0.0, 1.0, count)[:, None]
    level = measured - measured[0] - ramp * (measured[-1] - measured[0])
    power = np.abs(np.fft.rfft(level * np.hanning(count)[:, None], axis=0)) ** 2
    width = max(1, round(SMOOTHED_Hz * count / rate_Hz))
    kernel = np.ones(2 * width + 1) / (2 * width + 1)
    smooth = [np.convolve(np.pad(own, width, mode="edge"), kernel, "valid") for own in power.T]
    # the median of an exponential distribution is ln 2 of its mean
    noise = np.median(power[int(NOISE_FROM * len(power)) :], axis=0) / np.log(2.0)
    return np.asarray(np.clip(1.0 - SURELY * noise / np.maximum(np.stack(smooth, axis=1), 1e-300), 0.0, 1.0))
