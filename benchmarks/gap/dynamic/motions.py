"""Motions of the recordings of a scored case: slow, creeping, free, a sweep, small and fast, ramps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MIDDLE_rad = (0.0, -0.6, 0.1)
LOADED = (6, 9)  # runs with 0.5 kg
RUNS = 11


def set_points(rng: np.random.Generator, rate_Hz: int, seconds: float, joints: int = 3) -> list[Array]:
    """Eleven runs (samples, joints); three of them are repeats, two are for a payload (`LOADED`)."""
    t = np.arange(int(seconds * rate_Hz)) / rate_Hz
    ease = _eased(np.clip(t, 0.0, 1.0))[:, None]
    middle = np.resize(MIDDLE_rad, joints)

    def waves(amplitude: float, low: float, high: float, count: int) -> Array:
        out = np.zeros((len(t), joints))
        for j in range(joints):
            for f in rng.uniform(low, high, count):
                out[:, j] += np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) / count
        return np.asarray(middle + amplitude * (out - out[0]) * ease)

    phase = 2 * np.pi * (0.2 * t + 0.5 * (2.6 - 0.2) / seconds * t**2)
    sweep = middle + 0.12 * np.sin(phase)[:, None] * ease * np.resize([1.0, 0.8, 1.0], joints)
    swing = _of_joints([0.24 * np.sin(0.8 * t), 0.35 * (np.cos(1.1 * t) - 1), 0.5 * np.sin(1.9 * t)], joints)
    slow = middle + swing * ease
    creep = middle + 0.055 * _of_joints([np.sin(1.2 * t), np.sin(1.0 * t), np.sin(1.4 * t)], joints) * ease
    free, other, third = (waves(0.75, 0.1, 0.7, 4) for _ in range(3))
    fast, up = waves(0.03, 2.0, 7.0, 5), _ramps(t, joints)
    return [slow, creep, free, sweep, fast, up, other, slow, third, up, free]


def _eased(x: Array) -> Array:
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


def _of_joints(three: list[Array], joints: int) -> Array:
    return np.stack([three[j % 3] for j in range(joints)], axis=1)


def _ramps(t: Array, joints: int) -> Array:
    s = (t % 4.0) / 2.0
    out = _eased(np.where(s < 1, s, 2 - s))[:, None]
    start = np.resize(MIDDLE_rad, joints) + np.resize([0.0, 0.3, -0.3], joints)
    return np.asarray(start + out * np.resize([0.6, -0.9, 0.9], joints))
