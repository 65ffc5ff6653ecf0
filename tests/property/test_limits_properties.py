"""The set-point limiter for any history, and the controller's integral for any limits."""

from hypothesis import given, settings
from hypothesis import strategies as st

from control.dynamics.gains import Gains
from control.safety.limits import SetPointLimits, limit_set_point, stopping_speed
from control.servo import Pid

T = 0.002
LIMIT = SetPointLimits(-1.0, 1.0, 2.0, 10.0)
wanted = st.one_of(st.floats(-1e6, 1e6), st.floats(-1.1, 1.1), st.sampled_from([-1.0, 1.0, 0.0]))


@settings(max_examples=150, deadline=None)
@given(st.lists(wanted, min_size=1, max_size=200))
def test_whatever_is_wanted_the_set_point_keeps_range_speed_and_acceleration(sequence):
    q = speed = 0.0
    for target in sequence:
        for _ in range(3):
            allowed = limit_set_point((target,), (q,), (speed,), (LIMIT,), T)
            (new,), (new_speed,) = allowed.q_rad, allowed.speed_rad_s
            assert -1.0 <= new <= 1.0
            assert abs(new_speed) <= 2.0 + 1e-8
            assert abs(new_speed - speed) <= 10.0 * T + 1e-7
            assert allowed.reasons or abs(new - target) <= 1e-9
            q, speed = new, new_speed


@settings(max_examples=200, deadline=None)
@given(st.floats(1e-9, 10.0), st.floats(0.1, 100.0), st.floats(1e-4, 0.1))
def test_braking_from_the_stopping_speed_covers_exactly_the_distance(distance, acceleration, period):
    speed = stopping_speed(distance, acceleration, period)
    covered, cycles = 0.0, 0
    while speed > 0.0 and cycles < 200_000:
        covered += speed * period
        speed -= acceleration * period
        cycles += 1
    assert abs(covered - distance) <= 1e-6 * distance + 1e-12


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-50, 50), st.floats(0.0, 24.0)), max_size=100))
def test_the_controller_stays_in_limits_that_change_every_cycle_and_recovers_when_the_error_is_gone(history):
    pid = Pid(Gains(3.0, 20.0, 0.1, 0.01), 24.0, T)
    for error, rate, feedforward, limit in history:
        assert -limit <= pid.update(error, rate, feedforward, -limit, limit) <= limit
    for _ in range(100):
        output = pid.update(0.0, 0.0)
    assert abs(output) <= 24.0
    assert abs(pid.integral - output) <= 1e-6 or pid.is_saturated
