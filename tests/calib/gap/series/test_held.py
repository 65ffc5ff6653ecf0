"""Voltages that were not what drove the windings are recognised: a log of which every second sample is missing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.log import Log, LoggedRun
from calib.gap.series.plausible import not_held
from calib.gap.signals.recording import prepare
from tests.calib.gap.series.prescribed import arm_with_friction

ARM = arm_with_friction()
FIELDS = ("t_s", "q_rad", "q_set_rad", "current_A", "voltage_V", "payload_kg", "tip_m")
TIME_s = 0.0005  # L/R of the windings


def rough(late_samples: float = 0.0, noise_A: float = 0.01) -> Log:
    """Voltages as a controller's that differentiates a coarse encoder; each held over its sample, as windings answer."""
    rng = np.random.default_rng(5)
    count, period = 4000, 0.002
    t = period * np.arange(count)
    q = np.stack([0.3 * np.sin(2.0 * t + j) for j in range(3)], axis=1) + np.array([0.0, -0.6, 0.1])
    voltage = 2.0 * np.cos(2.0 * t)[:, None] + rng.normal(0.0, 0.5, (count, 3))
    current = np.zeros_like(voltage)
    left = np.exp(-period * (1.0 - late_samples) / TIME_s)
    R = np.array([drive.resistance_ohm for drive in ARM.drives])
    for k in range(2, count):
        early = voltage[k - 2] / R + (current[k - 1] - voltage[k - 2] / R) * np.exp(-period * late_samples / TIME_s)
        current[k] = voltage[k - 1] / R + (early - voltage[k - 1] / R) * left
    current += rng.normal(0.0, noise_A, current.shape)
    tip = np.full((count, 3), np.nan)
    return Log((LoggedRun("1", t, q, q, current, voltage, np.zeros(count), tip),))


def thinned(log: Log, every: int) -> Log:
    def some(values: Array) -> Array:
        return values[::every]

    return Log(tuple(replace(run, **{name: some(getattr(run, name)) for name in FIELDS}) for run in log.runs))


@pytest.mark.parametrize("every", [2, 3, 5])
def test_a_log_that_was_thinned_out_holds_other_voltages(every: int) -> None:
    said = not_held(ARM, prepare(ARM, thinned(rough(), every)))
    assert "thinned out" in said
    assert "voltages are not used" in said


@pytest.mark.parametrize("late", [0.0, 0.3, 0.7])
def test_voltages_that_were_held_are_believed_late_or_not(late: float) -> None:
    assert not not_held(ARM, prepare(ARM, rough(late)))


def test_joints_whose_voltages_are_smooth_do_not_outvote_one_that_shows() -> None:
    """Their noise tells little: two shares that are too low beside one that is known ten times as well."""
    (run,) = rough().runs
    voltage, current = run.voltage_V.copy(), run.current_A.copy()
    rng = np.random.default_rng(6)
    for column in (1, 2):
        small = rng.normal(0.0, 0.02, len(run))
        voltage[:, column] = 2.0 * np.cos(2.0 * run.t_s) + small
        answer = 0.1 * np.roll(small, 1)  # the motors are free, and turn away under the voltage
        current[:, column] = (2.0 * np.cos(2.0 * run.t_s) + answer) / ARM.drives[column].resistance_ohm
        current[:, column] += rng.normal(0.0, 0.03, len(run))
    assert not not_held(ARM, prepare(ARM, Log((replace(run, voltage_V=voltage, current_A=current),))))


def test_nothing_is_said_where_the_sensors_noise_hides_it() -> None:
    assert not not_held(ARM, prepare(ARM, thinned(rough(noise_A=30.0), 2)))
