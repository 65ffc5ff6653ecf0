"""The second opinions, on numbers: a motor and an encoder that agree, and every way in which they do not."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from control.dynamics.feedforward import Motor
from control.safety.motor_checks import SHARE, Lasting, SpeedCheck, TorqueCheck

R, K, T = 0.3, 3.0, 0.002
MOTOR = Motor(amperes_per_Nm=1.0 / K, resistance_ohm=R, volts_per_rad_s=K, supply_V=24.0, current_limit_A=8.0)
BASE_rad_s = 0.02


def first_doubt_s(
    speed_rad_s: float = 0.0, said_rad_s: float = 0.0, current_A: float = 0.0, off_R: float = 1.0, off_K: float = 1.0
) -> float:
    """When a motor of R off_R and K off_K that turns at one speed while its encoder says another is doubted; inf: never."""
    check = SpeedCheck(MOTOR, BASE_rad_s)
    volts = R * off_R * current_A + K * off_K * speed_rad_s
    for cycle in range(500):
        if not check.update(T, volts, current_A, said_rad_s, 0.0):
            return cycle * T
    return math.inf


@pytest.mark.parametrize("off_R", [0.82, 1.0, 1.2])
@pytest.mark.parametrize("off_K", [0.82, 1.0, 1.2])
@pytest.mark.parametrize("speed_rad_s", [-2.0, 0.0, 0.3, 2.0])
@pytest.mark.parametrize("current_A", [-8.0, -0.5, 8.0])
def test_parts_that_are_a_fifth_off_are_never_doubted(off_R: float, off_K: float, speed_rad_s: float, current_A: float) -> None:
    assert first_doubt_s(speed_rad_s, speed_rad_s, current_A, off_R, off_K) == math.inf


@pytest.mark.parametrize(
    ("speed_rad_s", "said_rad_s", "within_s"),
    [
        (0.061, 0.0, 0.02),  # the arm drifts while its counts stand: 2,000 counts/s
        (0.6, 0.0, 0.01),
        (2.0, 0.0, 0.01),  # frozen at full speed
        (0.0, 2.0, 0.1),
        (-1.0, 1.0, 0.02),  # backwards
        (2.0, 1.0, 0.1),
    ],
)
def test_an_encoder_that_says_something_else_is_doubted_in_time(speed_rad_s: float, said_rad_s: float, within_s: float) -> None:
    assert first_doubt_s(speed_rad_s, said_rad_s) <= within_s
    assert first_doubt_s(-speed_rad_s, -said_rad_s) <= within_s


def test_counts_that_stand_are_doubted_while_the_voltage_changes_in_every_cycle() -> None:
    check = SpeedCheck(MOTOR, BASE_rad_s)
    answers = [check.update(T, 6.0 + 0.01 * (-1) ** cycle, 0.0, 0.0, 0.0) for cycle in range(10)]
    assert not answers[-1]


def test_a_motor_at_rest_is_not_doubted_even_where_nothing_is_allowed() -> None:
    check = SpeedCheck(MOTOR, 0.0)
    assert all(check.update(T, 0.0, 0.0, 0.0, 0.0) for _ in range(5))
    assert TorqueCheck(0.0).update(T, 0.0, 0.0)


def test_what_is_allowed_is_said_in_the_units_of_the_joint() -> None:
    check = SpeedCheck(MOTOR, BASE_rad_s)
    assert check.allowed_rad_s == pytest.approx(BASE_rad_s)
    for _ in range(1000):
        check.update(T, 2.0 * K, 0.0, 2.0, 0.0)
    assert check.allowed_rad_s == pytest.approx(BASE_rad_s + SHARE * 2.0, rel=1e-3)


def test_a_difference_below_the_limit_is_none() -> None:
    assert first_doubt_s(0.99 * BASE_rad_s, 0.0) == math.inf
    assert first_doubt_s(1.01 * BASE_rad_s, 0.0) < 0.3
    assert first_doubt_s(1.0, 1.0, off_K=1.0 + 0.99 * SHARE) == math.inf


def test_voltage_steps_of_a_busy_controller_are_not_doubted() -> None:
    source = random.Random(1)
    check = SpeedCheck(MOTOR, BASE_rad_s)
    sent = [0.0, 0.0, 0.0]
    for _ in range(2000):
        sent = [*sent[1:], source.gauss(0.0, 2.0)]
        acted_V = source.choice(sent[:2])  # one cycle early or late
        assert check.update(T, sent[-1], acted_V / R, 0.0, 0.0)


def test_a_step_that_the_current_already_shows_is_not_doubted_but_a_current_that_no_command_explains_is() -> None:
    for is_newest in (True, False):
        check = SpeedCheck(replace(MOTOR, current_is_newest=is_newest), BASE_rad_s)
        for _ in range(100):
            assert check.update(T, 0.0, 0.0, 0.0, 0.0)
        steps = [check.update(0.005, 1.3, 1.3 / R, 0.0, 0.0) for _ in range(3)]
        assert all(steps) is is_newest
        if is_newest:
            assert check.update(0.005, 0.0, 1.3 / R, 0.0, 0.0)  # a step down that it does not show yet
        assert not all(check.update(T, 1.3, -1.3 / R, 0.0, 0.0) for _ in range(100))


def test_a_board_may_round_its_current_by_half_a_step() -> None:
    for rounded_A, is_well in ((0.049, True), (0.07, False)):
        check = SpeedCheck(replace(MOTOR, resistance_ohm=4.8, volts_per_rad_s=1.9, current_step_A=0.1), BASE_rad_s)
        assert all(check.update(T, 4.8 * rounded_A, 0.0, 0.0, 0.0) for _ in range(500)) is is_well


def test_a_voltage_that_is_not_known_says_nothing_and_starts_anew() -> None:
    check = SpeedCheck(MOTOR, BASE_rad_s)
    for _ in range(100):
        assert check.update(T, math.nan, 5.0, 3.0, 0.0)
    answers = [check.update(T, 0.0, 0.0, 3.0, 0.0) for _ in range(10)]
    assert answers[:2] == [True, True]
    assert not answers[-1]


def test_a_current_that_is_already_of_the_command_after_the_last_voltage_is_not_doubted() -> None:
    check = SpeedCheck(MOTOR, BASE_rad_s)
    for _ in range(100):
        assert check.update(0.01, 0.43, 0.43 / R, 0.0, 0.0)
    assert check.update(0.01, math.nan, 0.0, 0.0, 0.0)


def test_a_board_that_sends_a_duty_cycle_is_not_doubted_when_the_supply_sags() -> None:
    for volts in (6.0, -6.0):
        check = SpeedCheck(MOTOR, BASE_rad_s)
        for _ in range(500):
            assert check.update(T, volts, 0.0, 0.6 * volts / K, supply_off=0.3)


def test_the_model_explains_a_torque_within_its_share_and_the_base() -> None:
    for sign in (-1.0, 1.0):
        for extra_A, is_well in ((0.99, True), (1.01, False)):
            check = TorqueCheck(base_A=3.0)
            model_A = sign * 2.0
            measured_A = model_A + sign * extra_A * (3.0 + 0.3 * 2.0)
            assert all(check.update(T, measured_A, model_A) for _ in range(1000)) is is_well
            assert check.allowed_A == pytest.approx(3.6, rel=5e-3)


def test_an_impact_that_is_over_is_no_unexplained_torque() -> None:
    check = TorqueCheck(base_A=3.0)
    assert all(check.update(T, 8.0, 0.0) for _ in range(20))
    assert all(check.update(T, 0.0, 0.0) for _ in range(100))


def test_a_collision_that_takes_twice_what_is_allowed_is_told_within_a_tenth_of_a_second() -> None:
    check = TorqueCheck(base_A=3.0)
    assert not all(check.update(T, 6.0, 0.0) for _ in range(50))


@pytest.mark.parametrize("value", [-1.1, 2.1, math.nan, math.inf])
def test_a_value_must_be_outside_for_a_while(value: float) -> None:
    limit = Lasting(-1.0, 2.0, 0.02)
    assert all(limit.update(T, value) for _ in range(9))
    assert limit.update(T, 2.0)
    assert all(limit.update(T, value) for _ in range(9))
    assert not limit.update(T, value)
    assert limit.update(T, -1.0)


def test_a_value_outside_is_pending_until_it_has_lasted_exactly_so_long() -> None:
    limit = Lasting(-1.0, 2.0, 1.0)
    said = [(limit.update(0.25, value), limit.is_pending) for value in (0.0, 3.0, 3.0, 3.0, 3.0, 0.0)]
    assert said == [(True, False), (True, True), (True, True), (True, True), (False, True), (True, False)]
