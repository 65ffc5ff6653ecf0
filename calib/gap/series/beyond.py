"""What comes round with a motor faster than the equations are looked at: it is said, with how to record it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.effects.cogging import ORDERS
from calib.gap.posterior.constants import REMAINS
from calib.gap.signals.recording import EvenRun, RunSet

SAMPLES_LEAST = 200  # in each half
SAMPLES_MOST = 8000  # that are looked at; more tell nothing else
FASTEST = 0.4  # of the sampling rate
CLEAR = 1.2  # times the band: within, the rows show it themselves


@dataclass(frozen=True, slots=True)
class Ripple:
    """A current that follows its motor `order` times a turn, at `rate_Hz` in the middle of these runs; below `slow_rad_s` of the
    joint it is within `band_Hz`, where the equations are looked at. `share`: of what is above the band.
    """

    joint: int
    order: float
    amplitude_A: float
    rate_Hz: float
    share: float
    band_Hz: float
    slow_rad_s: float

    def __str__(self) -> str:
        """For the user."""
        return (
            f"the current of joint {self.joint} follows its motor {self.order:g} times a turn by {self.amplitude_A:.2g} A, at"
            f" {self.rate_Hz:.0f} Hz. So does cogging, but the equations are looked at up to {self.band_Hz:.0f} Hz: record the"
            f" joint slower than {self.slow_rad_s:.2g} rad/s, every sample of the controller, and it can be named"
        )


def ripples(recording: RunSet, gear_ratios: Sequence[float]) -> Iterator[Ripple]:
    """The largest of each joint, if it predicts recordings that it was not fitted to."""
    if not recording.has_current:
        return
    for j, gear_ratio in enumerate(gear_ratios):
        if (found := _ripple(recording, j, gear_ratio)) is not None:
            yield found


def _ripple(recording: RunSet, j: int, gear_ratio: float) -> Ripple | None:
    """The order that explains most of what the half of the recording that it was not fitted to has above the band."""
    parts = [_above_the_band(recording, run, j) for run in recording.runs]
    angle, speed, current = (np.concatenate([part[k] for part in parts]) for k in range(3))
    band_Hz, fastest_Hz = recording.filters.row_Hz, FASTEST * recording.filters.rate_Hz
    step = max(1, len(angle) // SAMPLES_MOST)
    motor, rate_Hz = gear_ratio * angle[::step], np.abs(gear_ratio * speed[::step]) / (2.0 * np.pi)
    high = current[::step]
    is_fitted = np.arange(len(high)) < len(high) // 2
    best: Ripple | None = None
    whole = float(high[~is_fitted] @ high[~is_fitted])
    for order in ORDERS:
        seen = (order * rate_Hz > CLEAR * band_Hz) & (order * rate_Hz < fastest_Hz)
        if min(np.sum(seen & is_fitted), np.sum(seen & ~is_fitted)) < SAMPLES_LEAST:
            continue
        waves = np.column_stack((np.sin(order * motor), np.cos(order * motor)))
        size = np.linalg.lstsq(waves[seen & is_fitted], high[seen & is_fitted], rcond=None)[0]
        other = high[seen & ~is_fitted]
        left = other - waves[seen & ~is_fitted] @ size
        share = float(other @ other - left @ left) / whole if whole > 0.0 else 0.0
        if share > REMAINS and (best is None or share > best.share):
            middle = float(np.median(order * rate_Hz[seen]))
            slow = 2.0 * np.pi * band_Hz / (CLEAR * order * gear_ratio)
            best = Ripple(j + 1, order, float(np.hypot(*size)), middle, share, band_Hz, slow)
    return best


def _above_the_band(recording: RunSet, run: EvenRun, j: int) -> tuple[Array, Array, Array]:
    """Angle, speed and what the measured current has beyond the rows' band, of the samples that count."""
    filters = recording.filters
    if len(run) <= 2 * filters.reach:  # shorter than the filter of a row
        return (np.zeros(0),) * 3
    inner = slice(filters.reach, len(run) - filters.reach)
    raw = run.current_raw_A[:, j]
    high = raw[inner] - np.convolve(raw, filters.row, "valid")
    usable = run.usable[inner, j]
    return run.q_raw[inner, j][usable], run.speed[inner, j][usable], high[usable]
