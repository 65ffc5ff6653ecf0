"""Multisine excitation, and the frequency response from it.

It is applied while the joint moves at constant speed, back and forth: then friction is constant and not part of the response.
The signal has odd harmonics of one period with random phases; some odd ones are omitted. A linear joint has no output there,
but friction and backlash do, so these lines measure the nonlinear share. Periods are averaged coherently (the signal is
the same in each); differences between them are noise. See Pintelon and Schoukens, System Identification: A Frequency Domain
Approach.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from control.dynamics.tuning import Response
from control.errors import ArmError

Real = NDArray[np.float64]
PERIOD_S = 2.0
PASSES = 4
BEYOND = 50  # samples of the next period, to separate steady motion from the response
LOWEST_Hz, HIGHEST_Hz = 2.0, 80.0  # below, the loop holds the joint, and the mean motion interferes
LINES = 48
LOW_Hz, HIGH_Hz = 2.0, 20.0  # range of usual crossover frequencies
LEAST_SHARE = 0.7  # share of the frequencies there that must be good
_TRIALS = 60  # trials of random phases, for a low crest factor


class PoorResponse(ArmError):
    """The measurement is not good enough for a design."""


@dataclass(frozen=True, slots=True)
class Multisine:
    """One period, peak 1; `lines` are its harmonics, `silent` odd ones between them."""

    samples: Real
    lines: NDArray[np.int64]
    silent: NDArray[np.int64]
    rate_Hz: float


def multisine(period_s: float, rate_Hz: float, seed: int = 0) -> Multisine:
    """A signal with odd lines, about as many in every octave, up to a fifth of the sampling rate."""
    count = round(period_s * rate_Hz)
    highest = min(HIGHEST_Hz, 0.2 * rate_Hz) * period_s
    wanted = np.geomspace(max(1.0, LOWEST_Hz * period_s), highest, LINES)
    odd = np.unique(2 * np.floor(wanted / 2.0).astype(np.int64) + 1)
    lines = np.array([k for n, k in enumerate(odd) if k < 7 or n % 4 != 2], dtype=np.int64)
    silent = np.setdiff1d(odd, lines)
    random = np.random.default_rng(seed)
    t = np.arange(count) / count
    best: Real | None = None
    for _ in range(_TRIALS):
        phases = random.uniform(0.0, 2.0 * np.pi, len(lines))
        wave = np.cos(2.0 * np.pi * np.outer(t, lines) + phases).sum(axis=1)
        if best is None or np.abs(wave).max() < np.abs(best).max():
            best = wave
    if best is None:
        raise ArmError("tuning: no excitation signal was found")
    return Multisine(best / np.abs(best).max(), lines, silent, rate_Hz)


@dataclass(frozen=True, slots=True)
class MeasuredResponse:
    """A response, the loop in which it was measured (L = added / output - 1, by the loop's own output), and its quality."""

    response: Response
    loop: NDArray[np.complex128]
    distortion: float
    """Nonlinear share: the angle's amplitude at unexcited lines over that at excited lines."""
    noise: float
    """Relative noise of the response, from period to period."""
    span_rad: float


def evaluate(wave: Multisine, angle_rad: Real, output: Real, added: Real) -> MeasuredResponse:
    """Evaluate arrays (periods, samples); each row is a period and the start of the next. The joint may be in motion."""
    count = len(wave.samples)
    y, u, d = (np.fft.rfft(_level(rows, count), axis=1) for rows in (angle_rad, output, added))
    at = wave.lines
    y_mean, u_mean, d_mean = (spectrum.mean(axis=0) for spectrum in (y, u, d))
    plant = y_mean[at] / u_mean[at]
    omega = 2.0 * np.pi * at * wave.rate_Hz / count
    # The part of this period's angle that its output does not explain.
    unexplained = y[:, at] - plant * u[:, at]
    noise = np.sqrt((np.abs(unexplained) ** 2).mean(axis=0)) / np.abs(y_mean[at])
    odd = wave.silent
    between = _interpolated(omega, plant, 2.0 * np.pi * odd * wave.rate_Hz / count)
    stray = np.abs(y_mean[odd] - between * u_mean[odd])
    level = np.interp(at, odd, stray / np.abs(np.interp(odd, at, np.abs(y_mean[at]))))
    coherence = 1.0 / (1.0 + noise**2 / len(y) + level**2)
    return MeasuredResponse(
        Response(omega, plant, coherence),
        d_mean[at] / u_mean[at] - 1.0,
        float(np.sqrt(np.mean(level**2))),
        float(np.sqrt(np.mean(noise**2 / len(y)))),
        float(np.ptp(angle_rad)),
    )


def _level(rows: Real, count: int) -> Real:
    """Remove mean and steady motion from each period, the latter by the difference to the same sample one period later.

    A straight line by least squares would remove part of the response and leave a saw-tooth.
    """
    beyond = rows.shape[1] - count
    slope = (rows[:, count:].mean(axis=1) - rows[:, :beyond].mean(axis=1)) / count
    t = np.arange(count) - 0.5 * (count - 1)
    period = rows[:, :count]
    return np.asarray(period - period.mean(axis=1, keepdims=True) - slope[:, None] * t)


def _interpolated(omega: Real, plant: NDArray[np.complex128], wanted: Real) -> NDArray[np.complex128]:
    magnitude = np.interp(np.log(wanted), np.log(omega), np.log(np.abs(plant)))
    phase = np.interp(np.log(wanted), np.log(omega), np.unwrap(np.angle(plant)))
    return np.asarray(np.exp(magnitude + 1j * phase), dtype=np.complex128)


def usable(measured: MeasuredResponse, least_coherence: float) -> MeasuredResponse:
    """The measurement without frequencies of poor coherence. Raises PoorResponse if too few remain around crossover."""
    keep = measured.response.coherence >= least_coherence
    response = measured.response
    low, high = 2.0 * math.pi * LOW_Hz, 2.0 * math.pi * HIGH_Hz
    inside = (response.omega_rad_s >= low) & (response.omega_rad_s <= high)
    good = int((keep & inside).sum())
    if good < LEAST_SHARE * int(inside.sum()):
        raise PoorResponse(
            f"the response is poor: coherence reaches {least_coherence:g} at only {good} of {int(inside.sum())}"
            f" frequencies from {LOW_Hz:g} to {HIGH_Hz:g} Hz (noise {measured.noise:.1%}, nonlinear"
            f" {measured.distortion:.1%}): friction or backlash absorbs the signal, or somebody touches the arm; give"
            " a larger --amplitude, check for backlash"
        )
    return MeasuredResponse(
        Response(response.omega_rad_s[keep], response.plant[keep], response.coherence[keep]),
        measured.loop[keep], measured.distortion, measured.noise, measured.span_rad,
    )  # fmt: skip
