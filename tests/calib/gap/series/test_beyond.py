"""What comes round with a motor too fast for the equations is said, and nothing else is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.series.find import Ripple, ripples
from calib.gap.signals.filters import filters_for
from control.model.description import load_arm

RATE_Hz = 500.0
ARM = load_arm("right")
ARM_RATIOS = [drive.gear_ratio for drive in ARM.drives]
RATIO = ARM_RATIOS[0]


class Run(SimpleNamespace):
    """What is read of a Motion."""

    def __len__(self) -> int:
        return len(self.q_raw)


def said(turns_a_second: float, *waves: Array, order: float = 7.0) -> list[Ripple]:
    """Of runs at this speed of the motor, in each the current of joint 1 follows its angle by a wave (sine, cosine)."""
    rng, runs = np.random.default_rng(1), []
    for sine, cosine in waves:
        motor = 2.0 * np.pi * turns_a_second * np.arange(1500) / RATE_Hz
        q = np.tile(motor[:, None] / RATIO, (1, 3))
        current = 0.02 * rng.normal(size=(len(q), 3)) + np.sin(0.3 * motor)[:, None]
        current[:, 0] += sine * np.sin(order * motor) + cosine * np.cos(order * motor)
        speed = np.full_like(q, 2.0 * np.pi * turns_a_second / RATIO)
        runs.append(Run(q_raw=q, speed=speed, current_raw_A=current, usable=np.ones_like(q, dtype=bool)))
    recording: Any = SimpleNamespace(runs=tuple(runs), filters=filters_for(RATE_Hz), has_current=True)
    return list(ripples(recording, ARM_RATIOS))


def test_a_ripple_above_the_band_is_said_with_how_to_record_it() -> None:
    (found,) = said(8.0, (0.1, 0.05), (0.1, 0.05))
    assert (found.joint, found.order) == (1, 7.0)
    assert found.amplitude_A == pytest.approx(np.hypot(0.1, 0.05), rel=0.05)
    assert found.rate_Hz == pytest.approx(56.0)
    slow = float(str(found).split("slower than ")[1].split(" ")[0])
    assert 7.0 * slow * RATIO / (2.0 * np.pi) < 25.0


@pytest.mark.parametrize(
    ("speed", "waves"),
    [
        (8.0, [(0.0, 0.0), (0.0, 0.0)]),  # noise
        (2.0, [(0.1, 0.0), (0.1, 0.0)]),  # within the band: the rows show it
        (8.0, [(0.1, 0.0), (-0.1, 0.0)]),  # of another phase in the other run: it follows no angle
    ],
)
def test_noise_slow_ripple_and_what_follows_no_angle_are_not(speed: float, waves: list[Any]) -> None:
    assert said(speed, *waves) == []


def test_nothing_is_said_of_recordings_without_currents() -> None:
    recording: Any = SimpleNamespace(runs=(), has_current=False)
    assert list(ripples(recording, ARM_RATIOS)) == []


def test_slow_logs_have_a_narrower_band_and_short_runs_say_nothing() -> None:
    assert filters_for(100.0).row_Hz == pytest.approx(10.0)
    short = Run(q_raw=np.zeros((5, 3)), speed=np.zeros((5, 3)), current_raw_A=np.ones((5, 3)), usable=np.ones((5, 3), dtype=bool))
    recording: Any = SimpleNamespace(runs=(short,), filters=filters_for(RATE_Hz), has_current=True)
    assert list(ripples(recording, ARM_RATIOS)) == []
