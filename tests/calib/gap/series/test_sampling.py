"""Slow loops, and boards that read angles and currents at another moment: sampling is no effect of the arm."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.gap.dynamic.cases import Asked, Conditions, made
from benchmarks.gap.dynamic.score import arm_of, log_of
from calib.gap.log import Log
from calib.gap.series.find import examine
from calib.gap.signals.staircase import Winding, response
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


def test_samples_of_a_held_voltage_are_those_of_small_steps() -> None:
    """The response in z is that of the winding and inertia stepped finely, at the frequency of a sine."""
    winding = Winding(0.2, 2.7, 1.2, 3e-4)
    period_s, delay_s, frequency_Hz, fine = 0.004, 0.0053, 11.0, 400
    found = response(winding, period_s, delay_s, np.array([frequency_Hz]))
    h, J, K, R, L = period_s / fine, 0.2, 2.7, 1.2, 1.2 * 3e-4
    omega, late = 2.0 * np.pi * frequency_Hz, round(delay_s / h)
    held = [np.exp(1j * omega * period_s * k) for k in range(150)]
    speed, current, angle, samples = 0j, 0j, 0j, []
    for step in range(len(held) * fine):
        if step % fine == 0:
            samples.append((angle, current))
        volt = held[(step - late) // fine] if step >= late else 0j
        middle = speed + 0.5 * h * K * current / J
        current += h * (volt - R * current - K * middle) / L
        angle += h * (speed := middle + 0.5 * h * K * current / J)
    at = held[len(samples) - 1]
    assert samples[-1][1] / at == pytest.approx(found.current[0], abs=2e-3 * abs(found.current[0]))
    swing = (samples[-1][0] - samples[-2][0]) / (
        at * (1.0 - np.exp(-1j * omega * period_s))
    )  # free of the start's offset
    assert 1j * omega * swing == pytest.approx(found.speed[0], abs=2e-3 * abs(found.speed[0]))
