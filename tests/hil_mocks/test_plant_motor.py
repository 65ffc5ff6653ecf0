"""The motor, its winding and its bridge against the equations of a DC motor."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from tests.hil_mocks.pendulum import (
    L_H,
    R_OHM,
    SUPPLY_V,
    WEIGHTLESS,
    K_Nm_A,
    REFLECTED_kg_m2,
    TOTAL_kg_m2,
    gravity_torque_Nm,
    plant,
    run,
)

HEAVY = 1e3  # a rotor that does not turn


def test_a_current_accelerates_motor_and_link_by_torque_over_inertia() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS)
    subject.drive_current(0, 0.5)
    run(subject, 0.1)
    lag_s = 5e-4  # the current's own, which costs speed for that long
    expected = K_Nm_A * 0.5 / TOTAL_kg_m2 * (0.1 - lag_s)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(expected, rel=2e-3)


def test_back_emf_ends_the_acceleration_at_voltage_over_constant() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS)
    subject.drive_voltage(0, 6.0)
    run(subject, 0.4)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(6.0 / K_Nm_A, rel=1e-6)
    assert subject.current_A(0) == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("timestep_s", [1e-3, 5e-4, 2.5e-4])
def test_angle_and_current_after_a_voltage_step_are_those_of_one_moment(timestep_s: float) -> None:
    """An angle that were a step ahead of the current would look like a command that takes effect before it is given."""
    subject = plant(gravity_m_s2=WEIGHTLESS, timestep_s=timestep_s)
    subject.drive_voltage(0, 6.0)
    subject.step(round(0.008 / timestep_s))
    rates = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, K_Nm_A / TOTAL_kg_m2], [0.0, -K_Nm_A / L_H, -R_OHM / L_H]])
    state = np.array(expm(np.block([[rates, np.array([[0.0], [0.0], [6.0 / L_H]])], [np.zeros((1, 4))]]) * 0.008))
    angle_rad, speed_rad_s, current_A = state[:3, 3]
    # Nearly second order: 0.17 of a step of 1 ms, 0.05 of one of 0.25 ms.
    order = (timestep_s / 1e-3) ** 2
    assert subject.motor_rad(0) == pytest.approx(angle_rad, abs=0.17e-3 * order**0.9 * speed_rad_s)
    assert subject.current_A(0) == pytest.approx(current_A, rel=0.034 * order**0.9)


def test_stall_current_rises_with_the_electrical_time_constant() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS, rotor_inertia_kg_m2=HEAVY, timestep_s=5e-5)
    subject.drive_voltage(0, 3.0)
    for k in range(1, 21):
        subject.step(1)
        expected = 3.0 / R_OHM * (1.0 - math.exp(-k * 5e-5 * R_OHM / L_H))
        assert subject.current_A(0) == pytest.approx(expected, rel=1e-6)


def test_an_open_circuit_carries_no_current_and_does_not_brake() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS)
    subject.drive_voltage(0, 6.0)
    run(subject, 0.3)
    subject.drive_voltage(0, 0.0)
    subject.step(4)
    assert abs(subject.current_A(0)) > 1.0
    subject.drive_open(0)
    subject.step(1)
    assert subject.current_A(0) == pytest.approx(0.0, abs=1e-9)
    before = subject.joint_speed_rad_s()[0]
    run(subject, 0.5)
    assert subject.current_A(0) == pytest.approx(0.0, abs=1e-9)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(before, rel=1e-6)


def test_shorted_windings_let_the_arm_sink_slowly() -> None:
    free, braked = plant(), plant()
    free.drive_open(0)
    braked.drive_voltage(0, 0.0)
    run(free, 0.2)
    run(braked, 0.2)
    sink_rad_s = gravity_torque_Nm(0.0) / (K_Nm_A**2 / R_OHM)  # 30 Nm s/rad of damping
    assert braked.joint_speed_rad_s()[0] == pytest.approx(-sink_rad_s, rel=0.01)
    assert free.joint_speed_rad_s()[0] < 15.0 * braked.joint_speed_rad_s()[0]


def test_a_current_source_follows_with_half_a_millisecond_of_lag() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS, rotor_inertia_kg_m2=HEAVY)
    subject.drive_current(0, 2.0)
    for k in range(1, 9):
        subject.step(1)
        assert subject.current_A(0) == pytest.approx(2.0 * (1.0 - math.exp(-k * 0.5)), rel=1e-4)


def test_a_current_source_cannot_push_beyond_the_supply() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS)
    subject.drive_current(0, 5.0)
    run(subject, 1.0)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(SUPPLY_V / K_Nm_A, rel=1e-3)
    assert subject.bridges.is_clamped[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_current_limit_holds_in_voltage_mode(sign: float) -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS, rotor_inertia_kg_m2=HEAVY)
    subject.bridges.limit_current(0, 8.0)
    subject.drive_voltage(0, sign * 24.0)
    run(subject, 0.02)
    assert subject.current_A(0) == pytest.approx(sign * 8.0, rel=1e-6)


def test_modes_change_without_a_jump_of_the_current() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS, rotor_inertia_kg_m2=HEAVY)
    subject.drive_voltage(0, 0.6)
    run(subject, 0.01)
    subject.drive_current(0, 0.6 / R_OHM)
    subject.step(1)
    assert subject.current_A(0) == pytest.approx(0.6 / R_OHM, rel=1e-5)


def test_a_torque_constant_off_nominal_scales_torque_and_back_emf() -> None:
    subject = plant(("torque_constant", 1, {"scale": 0.8}), gravity_m_s2=WEIGHTLESS)
    subject.drive_voltage(0, 6.0)
    run(subject, 0.5)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(6.0 / (0.8 * K_Nm_A), rel=1e-5)


def test_magnets_pull_against_what_cogging_says_that_the_motor_adds() -> None:
    cogging = {"amplitude_Nm": 0.4, "order": 12.0, "phase_rad": 0.3}
    for q_rad in (0.0, 0.0007, 0.0012, 0.0031):
        subject = plant(("cogging", 1, cogging), start_rad=(q_rad,), gravity_m_s2=WEIGHTLESS)
        subject.drive_open(0)
        subject.step(1)
        torque_Nm = subject.joint_speed_rad_s()[0] / subject.timestep_s * TOTAL_kg_m2
        assert torque_Nm == pytest.approx(-0.4 * math.sin(12.0 * 100.0 * q_rad + 0.3), abs=1e-4)


def test_a_command_takes_effect_after_the_command_delay() -> None:
    subject = plant(("command_delay", 0, {"delay_s": 0.0075}), gravity_m_s2=WEIGHTLESS)
    subject.drive_voltage(0, 6.0)
    run(subject, 0.007)
    assert subject.joint_speed_rad_s()[0] == 0.0
    subject.step(2)
    assert subject.current_A(0) == 0.0
    subject.step(1)
    assert subject.current_A(0) > 1.0


def test_motors_that_share_a_supply_resistance_pull_each_other_down() -> None:
    sag = ("supply_sag", 0, {"resistance_ohm": 0.1})
    subject = plant(sag, start_rad=(0.0, 0.0), gravity_m_s2=WEIGHTLESS, rotor_inertia_kg_m2=HEAVY)
    subject.drive_voltage(0, 2.4)
    subject.drive_voltage(1, 4.8)
    run(subject, 0.05)
    # A bridge draws duty x motor current: 0.1 i1 + 0.2 i2 from a supply of 24 V - 0.1 ohm times that.
    drawn_A = 0.1 * subject.current_A(0) + 0.2 * subject.current_A(1)
    assert subject.bridges.supply_V[0] == pytest.approx(24.0 - 0.1 * drawn_A, abs=1e-3)
    assert subject.current_A(1) == pytest.approx(0.2 * subject.bridges.supply_V[1] / R_OHM, rel=1e-3)


def test_the_rotor_weighs_on_the_joint_by_the_ratio_squared() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS)
    subject.drive_open(0)
    subject.push(0, 1.0)
    run(subject, 0.05)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(0.05 / TOTAL_kg_m2, rel=1e-6)
    assert REFLECTED_kg_m2 == pytest.approx(0.142)
