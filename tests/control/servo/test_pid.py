"""The joint controller: its arithmetic at the boundaries, and a motor model against the analytic solution."""

import math
import random

import pytest

from control.dynamics.gains import Gains
from control.errors import ArmError
from control.servo import NonFiniteInput, Pid

PERIOD_S = 0.002


def _pid(kp=10.0, ki=0.0, kd=0.0, derivative_filter_s=0.0, output_limit=24.0):
    return Pid(Gains(kp, ki, kd, derivative_filter_s), output_limit, PERIOD_S)


def test_proportional_integral_and_derivative_terms_add_to_the_feed_forward():
    pid = _pid(kp=2.0, ki=5.0, kd=0.5)
    assert pid.update(1.0, 3.0, 0.25) == pytest.approx(0.25 + 2.0 + 5.0 * PERIOD_S + 1.5)
    assert pid.update(1.0, 3.0, 0.25) == pytest.approx(0.25 + 2.0 + 10.0 * PERIOD_S + 1.5)


def test_filtered_derivative_follows_the_backward_euler_step_response():
    pid = _pid(kp=0.0, kd=1.0, derivative_filter_s=0.01)
    pole = 0.01 / (0.01 + PERIOD_S)
    for cycle in range(1, 50):
        assert pid.update(0.0, 1.0) == pytest.approx(1.0 - pole**cycle, abs=1e-12)


def test_without_a_rate_the_error_is_differenced_and_the_first_cycle_has_none():
    pid = _pid(kp=0.0, kd=1.0)
    assert pid.update(5.0) == 0.0
    assert pid.update(5.0 + 0.003) == pytest.approx(1.5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_output_meets_its_limit_exactly_and_never_passes_it(sign):
    pid = _pid(kp=1.0, output_limit=2.0)
    below, above = math.nextafter(2.0, 0.0), math.nextafter(2.0, 3.0)
    assert pid.update(sign * below) == sign * below
    assert not pid.is_saturated
    assert pid.update(sign * 2.0) == sign * 2.0
    assert not pid.is_saturated
    assert pid.update(sign * above) == sign * 2.0
    assert pid.is_saturated


def test_integral_stands_still_in_saturation_and_leaves_it_in_the_cycle_the_error_turns():
    pid = _pid(kp=1.0, ki=100.0, output_limit=1.0)
    for _ in range(10_000):
        assert pid.update(0.5) <= 1.0
    assert 0.0 < pid.integral <= 1.0
    held = pid.integral
    assert pid.update(-0.5) == pytest.approx(held - 0.5 - 100.0 * 0.5 * PERIOD_S)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_integral_unwinds_while_still_saturated(sign):
    pid = _pid(kp=0.0, ki=10.0, kd=1.0, output_limit=1.0)
    pid.integral = sign * 0.9
    assert pid.update(sign * -0.1, sign * 5.0) == sign * 1.0
    assert pid.integral == pytest.approx(sign * (0.9 - 10.0 * 0.1 * PERIOD_S))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_integral_does_not_wind_further_into_the_limit(sign):
    pid = _pid(kp=0.0, ki=10.0, kd=1.0, output_limit=1.0)
    pid.integral = sign * 0.5
    pid.update(sign * 0.1, sign * 5.0)
    assert pid.integral == sign * 0.5


def test_narrowed_limits_take_the_integral_with_them():
    pid = _pid(kp=0.0, ki=1.0, output_limit=24.0)
    pid.reset(20.0)
    assert pid.update(0.0, 0.0, 1.0, lower=-6.0, upper=6.0) == 6.0
    assert pid.integral == 5.0
    assert pid.update(0.0, 0.0, 0.0) == 5.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_integral_keeps_to_what_the_limit_leaves_beside_the_feed_forward(sign):
    pid = _pid(kp=0.0, ki=1.0, output_limit=24.0)
    pid.reset(sign * 20.0)
    assert pid.update(0.0, 0.0, sign * 2.0, lower=-6.0, upper=6.0) == sign * 6.0
    assert pid.integral == sign * 4.0
    pid.reset(sign * 20.0)
    pid.update(0.0, 0.0, sign * 9.0, lower=-6.0, upper=6.0)
    assert pid.integral == 0.0


def test_a_plain_reset_starts_from_zero_and_is_not_saturated():
    pid = _pid(kp=1.0, ki=1.0, output_limit=0.5)
    pid.update(9.0)
    assert pid.is_saturated
    pid.reset()
    assert (pid.integral, pid.is_saturated) == (0.0, False)
    assert pid.update(0.0) == 0.0


def test_limits_may_be_asymmetric_and_change_every_cycle():
    pid = _pid(kp=100.0)
    for lower, upper in [(-1.0, 3.0), (0.5, 0.75), (-9.0, -8.0), (2.0, 2.0)]:
        assert pid.update(1.0, lower=lower, upper=upper) == upper
        assert pid.update(-1.0, lower=lower, upper=upper) == lower


def test_feed_forward_beyond_the_limit_does_not_charge_the_integral():
    pid = _pid(kp=0.0, ki=10.0, output_limit=1.0)
    for _ in range(100):
        assert pid.update(0.001, 0.0, 5.0) == 1.0
    assert pid.integral == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("position", range(5))
def test_a_non_finite_input_raises_and_changes_nothing(bad, position):
    pid, untouched = (_pid(ki=3.0, kd=0.1, derivative_filter_s=0.01) for _ in range(2))
    for one in (pid, untouched):
        one.update(0.1, 0.2, 0.3)
    inputs = [0.1, 0.2, 0.3, -24.0, 24.0]
    inputs[position] = bad
    with pytest.raises(NonFiniteInput, match="expected finite inputs"):
        pid.update(*inputs)
    assert (pid.integral, pid.is_saturated) == (untouched.integral, untouched.is_saturated)
    for error in (0.3, -0.2):  # with a derivative by differences: it depends on the error and the rate before
        assert pid.update(error) == untouched.update(error)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_rate_that_is_not_finite_is_refused_even_without_derivative_gain(bad):
    pid = _pid(kd=0.0)
    with pytest.raises(NonFiniteInput):
        pid.update(0.0, bad)
    assert pid.update(0.0, 0.0) == 0.0


def test_crossed_limits_are_refused():
    with pytest.raises(NonFiniteInput):
        _pid().update(0.0, 0.0, 0.0, 1.0, 0.5)


def test_reset_makes_the_next_output_continue_where_the_last_one_was():
    pid = _pid(kp=30.0, ki=1e-6, kd=0.4, derivative_filter_s=0.01)
    pid.reset(7.5, error=0.02, feedforward=1.5, error_rate=-0.3)
    assert pid.update(0.02, -0.3, 1.5) == pytest.approx(7.5, abs=1e-9)


def test_reset_without_integral_action_leaves_no_bias():
    pid = _pid(kp=30.0)
    pid.reset(7.5)
    assert pid.update(0.0, 0.0) == 0.0


def test_reset_refuses_a_non_finite_output():
    with pytest.raises(NonFiniteInput):
        _pid(ki=1.0).reset(math.nan)


@pytest.mark.parametrize("position", range(6))
@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf])
def test_impossible_parameters_are_refused(position, bad):
    parameters = [1.0, 1.0, 1.0, 0.01, 24.0, PERIOD_S]
    parameters[position] = bad
    with pytest.raises(ArmError, match="PID"):
        Pid(Gains(*parameters[:4]), *parameters[4:])


def test_a_period_of_zero_is_refused_while_zero_gains_are_not():
    with pytest.raises(ArmError, match="period_s"):
        Pid(Gains(0.0, 0.0, 0.0, 0.0), 0.0, 0.0)
    assert Pid(Gains(0.0, 0.0, 0.0, 0.0), 0.0, 1.0).update(1.0) == 0.0


def test_proportional_control_of_an_integrator_is_the_analytic_exponential():
    # A motor whose speed is proportional to voltage: q' = u, u = kp (1 - q): q near 1 - exp(-kp t).
    pid = _pid(kp=5.0)
    q = 0.0
    for cycle in range(1, 1001):
        q += pid.update(1.0 - q) * PERIOD_S
        assert q == pytest.approx(1.0 - math.exp(-5.0 * cycle * PERIOD_S), abs=2e-3)


def test_pd_control_of_a_motor_model_is_the_analytic_second_order_response():
    # q'' = 8 u, u = kp (1 - q) - kd q': wn = sqrt(8 kp), zeta = 8 kd / (2 wn).
    # The short period keeps the integration error below the tolerance.
    kp, kd = 12.5, 1.25
    pid = Pid(Gains(kp, 0.0, kd, 0.0), 1e3, 1e-4)
    wn = math.sqrt(8.0 * kp)
    zeta = 8.0 * kd / (2.0 * wn)
    damped = wn * math.sqrt(1.0 - zeta * zeta)
    q = speed = 0.0
    for cycle in range(1, 20_001):
        speed += 8.0 * pid.update(1.0 - q, -speed) * 1e-4
        q += speed * 1e-4
        t = cycle * 1e-4
        envelope = math.exp(-zeta * wn * t)
        analytic = 1.0 - envelope * (math.cos(damped * t) + zeta * wn / damped * math.sin(damped * t))
        assert q == pytest.approx(analytic, abs=2e-3)


def test_integral_removes_a_constant_load_and_a_long_saturation_leaves_little_overshoot():
    # First-order motor (time constant 0.1 s, gain 1), load -2; the output saturates at first.
    pid = _pid(kp=4.0, ki=20.0, output_limit=3.0)
    speed, largest = 0.0, 0.0
    for _ in range(3000):
        output = pid.update(0.9 - speed)
        speed += (output - 2.0 - speed) / 0.1 * PERIOD_S
        largest = max(largest, speed)
    assert speed == pytest.approx(0.9, abs=1e-6)
    assert largest < 0.9 * 1.05


def test_output_stays_in_its_limits_and_finite_for_any_finite_history():
    random_numbers = random.Random(7)
    pid = _pid(kp=3.0, ki=50.0, kd=0.2, derivative_filter_s=0.005)
    for _ in range(20_000):
        upper = random_numbers.uniform(0.0, 24.0)
        error = random_numbers.choice([0.0, 1e-300, 1e6, -1e6, random_numbers.gauss(0.0, 1.0)])
        output = pid.update(error, random_numbers.gauss(0, 100.0), random_numbers.gauss(0, 10.0), -upper, upper)
        assert -upper <= output <= upper
