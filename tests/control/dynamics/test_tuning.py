"""Gains from a frequency response: the fit, the loop's own controller, margins against closed forms, and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest

from control.dynamics.gains import (
    Gains,
    Margins,
    MarginsUnmet,
    MotorFit,
    Response,
    Tuner,
    controller,
    fit_motor,
    margins,
    pole_gains,
)
from control.errors import ArmError
from control.hardware.measurement import Measurement
from control.servo import Pid

OMEGA = 2.0 * np.pi * np.geomspace(2.0, 80.0, 24)
MOTOR = MotorFit(40.0, 120.0, 0.003, 0.0)
T = 0.002


def measured(fit: MotorFit = MOTOR, noise: float = 0.0, seed: int = 1) -> Response:
    random = np.random.default_rng(seed)
    error = random.normal(size=(2, len(OMEGA))) * noise / math.sqrt(2.0)
    return Response(OMEGA, fit.response(OMEGA) * (1.0 + error[0] + 1j * error[1]), np.ones(len(OMEGA)))


def test_the_fit_recovers_what_was_put_in() -> None:
    fit = fit_motor(measured())
    assert (fit.b, fit.a_1_s) == pytest.approx((40.0, 120.0), rel=1e-6)
    assert fit.delay_s == pytest.approx(0.003, abs=1e-9)  # a point of the grid of delays
    assert fit.residual < 1e-6


def test_the_fit_stands_noise_and_says_how_much_there_is() -> None:
    fit = fit_motor(measured(noise=0.05))
    # 24 frequencies of 5 %: some 2 % of b and a, a few tenths of a millisecond.
    assert (fit.b, fit.a_1_s) == pytest.approx((40.0, 120.0), rel=0.1)
    assert fit.delay_s == pytest.approx(0.003, abs=0.0005)
    assert fit.residual == pytest.approx(0.05, abs=0.02)


def test_frequencies_without_coherence_do_not_count() -> None:
    response = measured()
    plant, coherence = response.plant.copy(), response.coherence.copy()
    plant[3:6] *= -5.0
    coherence[3:6] = 0.0
    assert fit_motor(Response(OMEGA, plant, coherence)).b == pytest.approx(40.0, rel=1e-6)


def test_what_does_not_fall_like_a_motor_is_refused() -> None:
    with pytest.raises(ArmError, match="does not fall"):
        fit_motor(Response(OMEGA, OMEGA.astype(np.complex128) ** 2, np.ones(len(OMEGA))))


def test_an_integrator_with_delay_has_the_margins_of_the_closed_form() -> None:
    # L = k exp(-s d)/s: crossover k, phase margin 90 deg - k d, -180 deg at pi/(2 d), so gain margin pi/(2 d k).
    k, d = 60.0, 0.008
    least = margins(OMEGA, k * np.exp(-1j * OMEGA * d) / (1j * OMEGA))
    assert least.crossover_rad_s == pytest.approx(k, rel=0.01)
    assert least.phase_deg == pytest.approx(90.0 - math.degrees(k * d), abs=0.5)
    assert least.gain_dB == pytest.approx(20.0 * math.log10(math.pi / (2.0 * d * k)), abs=0.2)


def test_a_loop_that_is_unstable_has_no_gain_margin() -> None:
    least = margins(OMEGA, 300.0 * np.exp(-1j * OMEGA * 0.008) / (1j * OMEGA))
    assert least.gain_dB == -math.inf
    assert least.phase_deg < 0.0
    assert not least.meet(0.0, 0.0)


@pytest.mark.parametrize(("gain", "crossover"), [(1e-3, 0.0), (1e5, math.inf)])
def test_a_crossover_beyond_the_measurement_is_said_to_be_there(gain: float, crossover: float) -> None:
    least = margins(OMEGA, gain / (1j * OMEGA))
    assert least.crossover_rad_s == crossover
    assert not least.meet(0.0, 0.0)


def test_margins_that_are_not_numbers_are_not_kept() -> None:
    assert not Margins(math.nan, 50.0, 1.0, 1.0).meet(6.0, 45.0)
    assert Margins(math.inf, 45.0, 1.0, 1.0).meet(6.0, 45.0)
    assert not Margins(5.999, 45.0, 1.0, 1.0).meet(6.0, 45.0)


class Radians:
    def radians(self, count: int) -> float:
        return 1e-7 * count


@pytest.mark.parametrize("frequency_Hz", [3.0, 20.0, 70.0])
def test_the_controller_is_that_of_the_loop(frequency_Hz: float) -> None:
    """Pid and Measurement themselves, driven by a sine, against C: amplitude and phase."""
    gains = Gains(200.0, 3000.0, 2.0, 0.001)
    pid, measurement = Pid(gains, 1e9, T), Measurement([Radians()], [32])
    omega = 2.0 * math.pi * frequency_Hz
    cycles = 4000
    angle, output = np.empty(cycles), np.empty(cycles)
    for k in range(cycles):
        measurement.update([round(1e5 * math.sin(omega * k * T))], [0], [k * T])
        angle[k] = measurement.q_rad[0]
        output[k] = pid.update(-angle[k], -measurement.speed_rad_s[0])
    late = slice(cycles // 2, None)
    wave = np.exp(-1j * omega * T * np.arange(cycles))[late]
    output_level = output[late] - output[late].mean()
    ratio = -(output_level * wave).sum() / ((angle[late] - angle[late].mean()) * wave).sum()
    assert ratio == pytest.approx(complex(controller(gains, T, np.array([omega]))[0]), rel=0.01)


def test_gains_put_the_poles_where_they_were_wanted() -> None:
    w, r = 50.0, 0.3
    gains = pole_gains(MotorFit(40.0, 30.0, 0.0, 0.0), 1.0, 0.0, w)
    roots = np.roots([1.0, 30.0 + 40.0 * gains.kd, 40.0 * gains.kp, 40.0 * gains.ki])
    assert sorted(roots.real) == pytest.approx([-w, -w, -r * w], rel=1e-4)


def test_the_fastest_design_keeps_its_margins_at_every_inertia_and_hardly_more() -> None:
    tuner = Tuner(measured(), MOTOR, T, 0.001, (0.5, 1.0, 3.0))
    design = tuner.fastest(8.0, 55.0)
    assert design.worst.meet(8.0, 55.0)
    for ratio in (0.5, 1.0, 3.0):
        assert tuner.margins_of(design.gains, ratio).meet(8.0, 55.0)
    assert not tuner.design_at(1.1 * design.pole_rad_s).worst.meet(8.0, 55.0)


def test_a_bandwidth_is_reached_or_refused_with_the_one_that_could_be() -> None:
    tuner = Tuner(measured(), MOTOR, T, 0.001)
    design = tuner.at_bandwidth(2.0 * math.pi * 6.0, 6.0, 45.0)
    assert design.here.crossover_rad_s == pytest.approx(2.0 * math.pi * 6.0, rel=0.05)
    with pytest.raises(MarginsUnmet, match="6 dB and 45 deg are met up to"):
        tuner.at_bandwidth(2.0 * math.pi * 60.0, 6.0, 45.0)


def test_a_loop_with_too_much_delay_gets_no_gains() -> None:
    slow = MotorFit(40.0, 0.0, 0.25, 0.0)
    with pytest.raises(MarginsUnmet, match="the largest phase margin"):
        Tuner(measured(slow), slow, T, 0.001).fastest(6.0, 45.0)
