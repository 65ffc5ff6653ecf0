"""Slow loops, and boards that read angles and currents at another moment: sampling is no effect of the arm."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.gap.dynamic.cases import Asked, Conditions, made
from benchmarks.gap.dynamic.score import arm_of, log_of
from calib.gap.effects.catalogue import known_laws
from calib.gap.log import Log
from calib.gap.residuals.rows import ResidualRows
from calib.gap.series.find import examine
from calib.gap.series.outcome import gap
from calib.gap.series.plausible import plausible
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import prepare
from calib.gap.signals.staircase import Windings, response
from control.model.arm import Arm

pytestmark = pytest.mark.usefixtures("without_motion")

SLOW = Conditions(rate_Hz=250, seconds=3.0, sampled_late=15)  # 1.5 ms after the voltage has changed


@pytest.fixture(scope="module")
def nothing_hidden() -> tuple[Arm, Log]:
    case = next(iter(made([Asked(31, "none")], SLOW)))
    return arm_of(case.arm_toml), log_of(case)


def test_when_currents_are_read_is_said_and_nothing_is_named(nothing_hidden: tuple[Arm, Log]) -> None:
    outcome = examine(*nothing_hidden)
    found = outcome.finding
    assert not found.effects
    assert not found.ambiguous
    assert found.unknown is None
    assert found.gap_after < 1.2 < found.gap_before
    assert any(re.search(r"are read 1\.[456]", text) for text in outcome.warnings), outcome.warnings


def test_without_currents_a_slow_loop_is_at_its_floor(nothing_hidden: tuple[Arm, Log]) -> None:
    arm, log = nothing_hidden
    runs = tuple(replace(run, current_A=np.full_like(run.current_A, np.nan)) for run in log.runs)
    found = examine(arm, Log(runs, log.sources)).finding
    assert not found.effects
    assert found.gap_after < 1.3


def test_joints_that_turn_each_other_within_a_slow_sample_are_no_effect() -> None:
    """100 samples a second: a voltage is held longer than a motor takes to turn away under it."""
    case = next(iter(made([Asked(300_001, "none")], Conditions(rate_Hz=100, seconds=1.0))))
    arm = arm_of(case.arm_toml)
    recording = plausible(arm, prepare(arm, log_of(case)))
    rows = ResidualRows(Physics(arm, recording), known_laws(arm))
    left = rows.residual(known_laws(arm))
    assert recording.has_voltage
    assert gap(left, rows.table, np.ones(len(left), dtype=bool)) < 1.3


def test_samples_of_a_held_voltage_are_those_of_small_steps() -> None:
    """The response in z is that of the winding and inertia stepped finely, at the frequency of a sine."""
    J, K, R, lag = np.array([[0.2, 0.06], [0.06, 0.1]]), np.array([2.7, 2.1]), np.array([1.2, 0.9]), 3e-4
    period_s, delay_s, frequency_Hz, fine = 0.004, 0.0053, 11.0, 400
    found = response(Windings(J, K, R, np.full(2, lag)), period_s, delay_s, np.array([frequency_Hz]))
    h, L = period_s / fine, R * lag
    omega, late = 2.0 * np.pi * frequency_Hz, round(delay_s / h)
    pushed = np.array([1.0, -0.5])  # of the two joints' voltages
    held = [np.exp(1j * omega * period_s * k) for k in range(150)]
    speed, current, angle, samples = *(np.zeros(2, dtype=complex) for _ in range(3)), []
    for step in range(len(held) * fine):
        if step % fine == 0:
            samples.append((angle, current))
        volt = pushed * held[(step - late) // fine] if step >= late else 0j * pushed
        middle = speed + 0.5 * h * np.linalg.solve(J, K * current)
        current = current + h * (volt - R * current - K * middle) / L
        speed = middle + 0.5 * h * np.linalg.solve(J, K * current)
        angle = angle + h * speed
    at = held[len(samples) - 1]
    wanted, smooth = found.current[0] @ pushed, found.speed[0] @ pushed
    np.testing.assert_allclose(samples[-1][1] / at, wanted, atol=2e-3 * np.abs(wanted).max())
    swing = (samples[-1][0] - samples[-2][0]) / (at * (1.0 - np.exp(-1j * omega * period_s)))  # free of the start's offset
    np.testing.assert_allclose(1j * omega * swing, smooth, atol=2e-3 * np.abs(smooth).max())
