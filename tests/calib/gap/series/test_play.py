"""A link behind a spring or in a gear with play does what mechanics says of it."""

from __future__ import annotations

import numpy as np
import pytest

from calib.arrays import Array
from calib.gap.signals.play import LinkDrive, elastic, elastics, loose

PERIOD_s = 0.002


def follower(torque: Array, inertia: float = 0.05) -> LinkDrive:
    """One run with this torque over time, without gravity's slope."""
    column = torque[:, None]
    return LinkDrive(column, np.full_like(column, inertia), np.zeros_like(column), PERIOD_s)


def test_a_spring_at_rest_gives_way_by_torque_over_stiffness() -> None:
    found = elastic(follower(np.full(100, 3.0)), 600.0, 0.5)
    np.testing.assert_allclose(found.delta_rad, -3.0 / 600.0, rtol=1e-9)
    np.testing.assert_allclose(found.transmitted_Nm, 3.0, rtol=1e-9)


def test_a_link_that_is_let_go_swings_at_its_own_frequency_and_keeps_its_energy() -> None:
    """200 N m/rad and 0.05 kg m^2: 10.07 Hz; the trapezoidal rule is 0.2 % slow at this step."""
    torque = np.zeros(2000)
    torque[0] = 1.0
    delta = elastic(follower(torque), 200.0, 0.0).delta_rad[:, 0]
    crossings = np.flatnonzero((delta[1:] > 0) & (delta[:-1] <= 0))
    period = np.diff(crossings).mean() * PERIOD_s
    assert 1.0 / period == pytest.approx(np.sqrt(200.0 / 0.05) / (2 * np.pi), rel=0.005)
    assert np.abs(delta[-200:]).max() == pytest.approx(np.abs(delta[200:400]).max(), rel=0.01)


def test_a_loose_link_lies_on_the_flank_that_its_torque_needs() -> None:
    torque = np.concatenate([np.full(500, 2.0), np.full(500, -2.0)])
    found = loose(follower(torque), 0.01)
    np.testing.assert_allclose(found.delta_rad[:500, 0], -0.005)
    np.testing.assert_allclose(found.delta_rad[-300:, 0], 0.005)
    np.testing.assert_allclose(found.transmitted_Nm[-300:, 0], -2.0)


def test_nothing_is_transmitted_while_the_link_falls_from_flank_to_flank() -> None:
    """0.01 rad at 40 rad/s^2 take 22 ms."""
    torque = np.concatenate([np.full(100, 2.0), np.full(100, -2.0)])
    found = loose(follower(torque), 0.01)
    np.testing.assert_allclose(found.transmitted_Nm[102:108, 0], 0.0, atol=1e-9)
    arrived = int(np.flatnonzero(found.delta_rad[:, 0] >= 0.005)[0])
    assert (arrived - 100) * PERIOD_s == pytest.approx(np.sqrt(2 * 0.01 / 40.0), abs=0.003)


def test_an_impact_passes_on_the_momentum_of_the_link() -> None:
    torque = np.concatenate([np.full(100, 2.0), np.full(200, -2.0)])
    found = loose(follower(torque), 0.01)
    pushed = float(np.sum(found.transmitted_Nm[101:150, 0]) * PERIOD_s)
    free = np.sum(torque[101:150]) * PERIOD_s
    assert pushed == pytest.approx(free, abs=0.02)


def test_friction_behind_a_spring_is_transmitted_by_it() -> None:
    """A link that its motor turns steadily: what the spring carries is the torque and the link's own friction."""
    torque = np.full((2000, 1), 1.0)
    drive = LinkDrive(torque, np.full_like(torque, 0.05), 0.0 * torque, PERIOD_s, np.full_like(torque, 0.5), 0.4, 0.2)
    found = elastic(drive, 600.0, 2.0, share=0.5)
    assert found.transmitted_Nm[-1, 0] == pytest.approx(1.0 + 0.5 * (0.4 + 0.2 * 0.5), rel=1e-3)
    assert elastic(drive, 600.0, 2.0).transmitted_Nm[-1, 0] == pytest.approx(1.0, rel=1e-3)


def test_friction_on_a_loose_link_decides_its_flank() -> None:
    """Without a load of its own a link with friction drags behind its motor."""
    still = np.zeros((1000, 1))
    drive = LinkDrive(still, still + 0.05, still, PERIOD_s, still + 0.3, 0.4, 0.0)
    found = loose(drive, 0.01, share=1.0)
    assert found.delta_rad[-1, 0] == pytest.approx(-0.005)
    assert found.transmitted_Nm[-1, 0] == pytest.approx(0.4, rel=1e-3)


def test_friction_on_a_link_is_that_of_a_slowly_turning_motor_too() -> None:
    """At 10 mrad/s, where rows begin to count, the whole of it acts: a wider transition would look like Stribeck's law."""
    still = np.zeros((1000, 1))
    drive = LinkDrive(still, still + 0.05, still, PERIOD_s, still + 0.01, 0.4, 0.0)
    assert loose(drive, 0.01, share=1.0).transmitted_Nm[-1, 0] == pytest.approx(0.4, rel=0.01)
    assert elastic(drive, 600.0, 2.0, share=1.0).transmitted_Nm[-1, 0] == pytest.approx(0.4, rel=0.01)


@pytest.mark.parametrize("damping", [2.0, 8.0])
def test_a_soft_gear_with_play_obeys_its_equation_from_flank_to_flank(damping: float) -> None:
    """Against the equation in steps of 5 us; its spring begins at the flanks and only pushes."""
    stiffness, width, inertia = 600.0, 0.01, 0.05
    torque = 2.0 * np.cos(2.0 * np.pi * 1.5 * PERIOD_s * np.arange(600))
    found = elastics(follower(torque), [(stiffness, damping, 0.0, width)])[0]
    step_s, per_sample = 5e-6, round(PERIOD_s / 5e-6)
    pulls = np.interp(np.arange(600 * per_sample) / per_sample, np.arange(600), torque).tolist()
    delta, speed, expected = -0.5 * width - torque[0] / stiffness, 0.0, []
    for k, pull in enumerate(pulls):
        if k % per_sample == 0:
            expected.append(delta)
        into = delta - min(max(delta, -0.5 * width), 0.5 * width)
        spring = stiffness * into + damping * speed
        speed -= step_s * (pull + (spring if into * spring > 0.0 else 0.0)) / inertia
        delta += step_s * speed
    assert np.ptp(expected) > 1.5 * width
    assert np.abs(found.delta_rad[:, 0] - expected).max() < 0.03 * width
    between = np.abs(found.delta_rad[:, 0]) < 0.5 * width
    assert between.sum() > 10
    np.testing.assert_array_equal(found.transmitted_Nm[between], 0.0)
    at_rest = elastics(follower(np.full(100, 3.0)), [(stiffness, damping, 0.0, width)])[0]
    np.testing.assert_allclose(at_rest.delta_rad, -0.5 * width - 3.0 / stiffness, rtol=1e-9)


def test_a_soft_gear_without_play_is_a_spring_and_a_hard_one_with_play_is_loose() -> None:
    torque = 2.0 * np.cos(2.0 * np.pi * 1.5 * PERIOD_s * np.arange(600))
    spring, none = (elastics(follower(torque), [(600.0, 4.0, 0.0, *w)])[0] for w in ((), (0.0,)))
    np.testing.assert_array_equal(spring.delta_rad, none.delta_rad)
    hard = elastics(follower(torque), [(2e4, 50.0, 0.0, 0.01)])[0]
    assert np.abs(hard.delta_rad - loose(follower(torque), 0.01).delta_rad).max() < 0.1 * 0.01
