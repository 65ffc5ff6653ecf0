"""What stands between motor and joint: rigid, compliant, with play, coupled by a belt; and what hangs at the end."""

from __future__ import annotations

import math

import pytest

from hil_mocks.plant.build import PlantOptions
from hil_mocks.plant.plant import Plant, Point
from tests.hil_mocks.pendulum import (
    COM_M,
    LENGTH_M,
    MASS_KG,
    WEIGHTLESS,
    G_m_s2,
    K_Nm_A,
    TOTAL_kg_m2,
    arm,
    effects,
    gravity_torque_Nm,
    plant,
    run,
)

VISCOUS = ("viscous_friction", 1, {"coefficient_Nm_s_rad": 2.0})


def test_a_free_pendulum_keeps_its_energy() -> None:
    subject = plant(start_rad=(0.3,))
    subject.drive_open(0)
    before = sum(subject.energy_J())
    run(subject, 2.0)
    assert sum(subject.energy_J()) == pytest.approx(before, abs=2e-3)


def test_a_small_pendulum_swings_with_the_period_of_its_inertia() -> None:
    subject = plant(start_rad=(-math.pi / 2 + 0.02,))
    subject.drive_open(0)
    crossings = []
    for k in range(12_000):
        before = subject.joint_rad()[0] + math.pi / 2
        subject.step(1)
        after = subject.joint_rad()[0] + math.pi / 2
        if before > 0.0 >= after:
            crossings.append((k + before / (before - after)) * subject.timestep_s)
    period_s = (crossings[-1] - crossings[0]) / (len(crossings) - 1)
    expected = 2.0 * math.pi * math.sqrt(TOTAL_kg_m2 / (MASS_KG * G_m_s2 * COM_M))
    assert period_s == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("q_rad", [0.0, 0.7, -1.2])
def test_the_holding_current_carries_the_gravity_torque(q_rad: float) -> None:
    subject = plant(VISCOUS, start_rad=(q_rad,))
    subject.drive_current(0, gravity_torque_Nm(q_rad) / K_Nm_A)
    run(subject, 0.2)
    # Half a millisecond of falling before the current is there leaves some 1e-4 rad.
    assert subject.joint_rad()[0] == pytest.approx(q_rad, abs=5e-3)
    assert abs(subject.joint_speed_rad_s()[0]) < 2e-2


def test_compliance_deflects_by_torque_over_stiffness() -> None:
    spring = ("joint_compliance", 1, {"stiffness_Nm_rad": 3000.0, "damping_Nm_s_rad": 5.0})
    sag = plant(spring, rotor_inertia_kg_m2=1e3)
    sag.drive_voltage(0, 0.0)
    run(sag, 1.5)
    assert sag.motor_rad(0) == pytest.approx(0.0, abs=1e-5)
    deflection = sag.motor_rad(0) - sag.joint_rad()[0]
    assert deflection == pytest.approx(gravity_torque_Nm(sag.joint_rad()[0]) / 3000.0, rel=1e-3)


def test_play_shows_its_full_width_when_the_motor_reverses_under_a_held_link() -> None:
    subject = plant(("backlash", 1, {"width_rad": 0.004}), gravity_m_s2=WEIGHTLESS)
    subject.hand.seat((LENGTH_M, 0.0, 0.0))
    run(subject, 0.2)
    angles = []
    for current_A in (0.3, -0.3):
        subject.drive_current(0, current_A)
        run(subject, 0.3)
        angles.append(subject.motor_rad(0))
    assert angles[0] - angles[1] == pytest.approx(0.004, rel=2e-3)


def test_hard_flanks_give_less_than_ten_microradians_at_full_gravity() -> None:
    subject = plant(("backlash", 1, {"width_rad": 0.001}), VISCOUS, timestep_s=5e-4)
    subject.drive_current(0, gravity_torque_Nm(0.0) / K_Nm_A)
    run(subject, 0.5)
    assert subject.motor_rad(0) - subject.joint_rad()[0] == pytest.approx(0.0005, abs=1e-6)


def test_play_and_compliance_add_up() -> None:
    spring = ("joint_compliance", 1, {"stiffness_Nm_rad": 3000.0, "damping_Nm_s_rad": 5.0})
    subject = plant(spring, ("backlash", 1, {"width_rad": 0.002}), rotor_inertia_kg_m2=1e3)
    subject.drive_voltage(0, 0.0)
    run(subject, 1.5)
    deflection = subject.motor_rad(0) - subject.joint_rad()[0]
    expected = 0.001 + gravity_torque_Nm(subject.joint_rad()[0]) / 3000.0
    assert deflection == pytest.approx(expected, rel=1e-3)


def test_the_belt_turns_joint_3_with_joint_2_unseen_by_its_encoder() -> None:
    belt = ("belt_coupling", 0, {"ratio": 0.1})
    subject = plant(belt, start_rad=(0.0, 0.2, 0.3), gravity_m_s2=WEIGHTLESS)
    assert subject.encoder_rad(2) == pytest.approx(0.3 - 0.1 * 0.2)
    subject.drive_voltage(0, 0.0)
    subject.drive_voltage(1, 0.6)
    subject.drive_voltage(2, 0.0)
    run(subject, 0.5)
    q = subject.joint_rad()
    assert q[1] > 0.25
    assert q[2] == pytest.approx(subject.encoder_rad(2) + 0.1 * q[1], abs=1e-6)


def test_a_payload_adds_its_weight_at_the_tip() -> None:
    subject = plant(("payload", 0, {"mass_kg": 0.5}), VISCOUS)
    holding_Nm = gravity_torque_Nm(0.0) + 0.5 * G_m_s2 * LENGTH_M
    subject.drive_current(0, holding_Nm / K_Nm_A)
    run(subject, 0.1)
    assert abs(subject.joint_speed_rad_s()[0]) < 2e-2
    subject.set_payload(0.0)
    run(subject, 0.1)
    assert subject.joint_speed_rad_s()[0] > 0.2


def test_a_payload_hung_on_later_counts_as_inertia_too() -> None:
    subject = plant(gravity_m_s2=WEIGHTLESS)
    subject.set_payload(2.0)
    subject.drive_open(0)
    subject.push(0, 1.0)
    run(subject, 0.05)
    expected = 0.05 / (TOTAL_kg_m2 + 2.0 * LENGTH_M**2)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(expected, rel=1e-6)


def test_link_inertia_beyond_nominal_is_there() -> None:
    subject = plant(("link_inertia", 1, {"inertia_kg_m2": 0.05}), gravity_m_s2=WEIGHTLESS)
    subject.drive_open(0)
    subject.push(0, 1.0)
    run(subject, 0.05)
    assert subject.joint_speed_rad_s()[0] == pytest.approx(0.05 / (TOTAL_kg_m2 + 0.05), rel=1e-6)


def test_encoder_scale_and_eccentricity_lie_about_the_joint() -> None:
    scaled = plant(("encoder_scale", 1, {"scale": 0.002}), start_rad=(0.5,))
    assert scaled.encoder_rad(0) * 1.002 == pytest.approx(0.5, abs=1e-12)
    off_centre = ("encoder_eccentricity", 1, {"amplitude_rad": 0.003, "phase_rad": 0.4})
    subject = plant(off_centre, start_rad=(0.5,))
    reading = subject.encoder_rad(0)
    assert reading + 0.003 * math.sin(reading + 0.4) == pytest.approx(0.5, abs=1e-9)


def test_a_drifting_joint_moves_away_from_its_encoder_with_its_time_constant() -> None:
    drift = {"final_rad": 0.002, "time_constant_s": 0.5}
    subject = plant(("thermal_drift", 1, drift), gravity_m_s2=WEIGHTLESS)
    run(subject, 0.5)
    expected = 0.002 * (1.0 - math.exp(-1.0))
    assert subject.joint_rad()[0] - subject.encoder_rad(0) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("share", [(), (("backlash", 1, {"width_rad": 0.002}),)])
def test_the_hand_drags_smoothly_holds_within_microns_and_lets_go(share: tuple[tuple[str, int, dict[str, float]], ...]) -> None:
    subject = plant(*share, ("coulomb_friction", 1, {"torque_Nm": 1.5}), timestep_s=5e-4)
    subject.drive_voltage(0, 0.0)
    goal: Point = (LENGTH_M * math.cos(0.4), LENGTH_M * math.sin(0.4), 0.0)
    duration_s = subject.hand.seat(goal)
    fastest, before = 0.0, subject.tip_m()
    for _ in range(round(duration_s * 1e3) + 50):
        run(subject, 1e-3)
        here = subject.tip_m()
        fastest, before = max(fastest, math.dist(here, before) / 1e-3), here
    assert subject.hand.state == "holding"
    assert math.dist(subject.tip_m(), goal) < 2e-5
    assert fastest < 0.32
    subject.hand.let_go()
    run(subject, 1.0)
    assert math.dist(subject.tip_m(), goal) > 0.01


def test_the_hand_gives_up_on_a_point_that_the_arm_cannot_reach() -> None:
    subject = plant(timestep_s=5e-4)
    subject.drive_voltage(0, 0.0)
    run(subject, subject.hand.seat((0.8, 0.0, 0.0)) + 0.5)
    assert subject.hand.state == "cannot reach"
    assert "cannot reach (0.800, 0.000, 0.000)" in subject.hand.problem


def test_seating_repeats_with_the_noise_asked_for() -> None:
    def seated(seed: int) -> Point:
        options = PlantOptions(seating_noise_m=1e-4, seed=seed, timestep_s=5e-4)
        subject = Plant(arm(3), effects(joints=3), (0.3, 0.5, -0.4), options)
        for j in range(3):
            subject.drive_voltage(j, 0.0)
        goal = subject.tip_m()
        run(subject, subject.hand.seat(goal) + 0.1)
        x, y, _ = (a - b for a, b in zip(subject.tip_m(), goal, strict=True))
        return x, y, 0.0

    assert seated(1) == seated(1)
    assert 1e-6 < math.dist(seated(1), seated(2)) < 6e-4
