"""Columns have no measurement noise: what is drawn to the residual's own noise would explain it away, and motion with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.arrays import Array
from calib.gap.log import Log
from calib.gap.residuals.scene import without_noise
from calib.gap.signals.recording import RunSet, prepare
from tests.calib.gap.series.prescribed import arm_with_friction, log_of

ARM = arm_with_friction()


def recorded(noise_rad: float) -> RunSet:
    log = log_of(ARM)
    rng = np.random.default_rng(1)
    runs = [replace(run, q_rad=run.q_rad + rng.normal(0.0, noise_rad, run.q_rad.shape)) for run in log.runs]
    return prepare(ARM, Log(tuple(runs)))


def of_all(recording: RunSet) -> Array:
    return np.concatenate([run.acceleration[run.usable.all(axis=1)] for run in recording.runs])


def test_accelerations_lose_the_noise_of_the_angles_and_keep_the_motion() -> None:
    true, noisy = recorded(0.0), recorded(3e-5)
    missed = of_all(noisy) - of_all(true)
    left = of_all(without_noise(noisy)) - of_all(true)
    assert np.std(left) < 0.35 * np.std(missed)
    assert abs(np.sum(left * missed)) < 0.15 * np.sum(missed**2)  # what is left is not the noise that the residual has


def test_motions_that_only_an_encoders_steps_blur_are_as_they_were() -> None:
    true = recorded(0.0)
    assert np.std(of_all(without_noise(true)) - of_all(true)) < 0.05 * np.std(of_all(true))
