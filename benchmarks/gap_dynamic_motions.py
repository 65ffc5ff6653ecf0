"""What the recordings of a scored case are asked to do: slow, creeping, free, a sweep, small and fast, ramps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MIDDLE_rad = (0.0, -0.6, 0.1)
LOADED = (6, 9)  # runs with 0.5 kg
RUNS = 11


def set_points(rng: np.random.Generator, rate_Hz: int, seconds: float) -> list[Array]:
    """Eleven runs (samples, 3); three of them repeat another, two are meant for a payload (`LOADED`)."""
    t = np.arange(int(seconds * rate_Hz)) / rate_Hz
    ease = _eased(np.clip(t, 0.0, 1.0))[:, None]
    middle = np.array(MIDDLE_rad)

    def waves(amplitude: float, low: float, high: float, count: int) -> Array:
        out = np.zeros((len(t), 3))
        for j in range(3):
            for f in rng.uniform(low, high, count):
                out[:, j] += np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) / count
        return np.asarray(middle + amplitude * (out - out[0]) * ease)

    phase = 2 * np.pi * (0.2 * t + 0.5 * (2.6 - 0.2) / seconds * t**2)
    sweep = middle + 0.12 * np.sin(phase)[:, None] * ease * np.array([1.0, 0.8, 1.0])
    swing = np.stack([0.24 * np.sin(0.8 * t), 0.35 * (np.cos(1.1 * t) - 1), 0.5 * np.sin(1.9 * t)], 1)
    slow = middle + swing * ease
    creep = middle + 0.055 * np.stack([np.sin(1.2 * t), np.sin(1.0 * t), np.sin(1.4 * t)], 1) * ease
    free, other, third = (waves(0.75, 0.1, 0.7, 4) for _ in range(3))
    fast, up = waves(0.03, 2.0, 7.0, 5), _ramps(t)
    return [slow, creep, free, sweep, fast, up, other, slow, third, up, free]


def _eased(x: Array) -> Array:
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


def _ramps(t: Array) -> Array:
    s = (t % 4.0) / 2.0
    out = _eased(np.where(s < 1, s, 2 - s))[:, None]
    return np.asarray(np.array(MIDDLE_rad) + out * np.array([0.6, -0.9, 0.9]) + np.array([0.0, 0.3, -0.3]))
