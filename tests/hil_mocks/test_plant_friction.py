"""Friction laws against what they say: thresholds, slopes, stick-slip, direction and load."""

from __future__ import annotations

import pytest

from tests.hil_mocks.pendulum import WEIGHTLESS, K_Nm_A, gravity_torque_Nm, plant, run

PLAY = ("backlash", 1, {"width_rad": 1e-4})
Entry = tuple[str, int, dict[str, float]]


def coulomb(torque_Nm: float) -> Entry:
    return ("coulomb_friction", 1, {"torque_Nm": torque_Nm})


def terminal_speed(*entries: Entry, torque_Nm: float) -> float:
    """Speed under a constant torque, with 5 Nm s/rad to end the acceleration."""
    viscous: Entry = ("viscous_friction", 1, {"coefficient_Nm_s_rad": 5.0})
    subject = plant(*entries, viscous, gravity_m_s2=WEIGHTLESS)
    subject.drive_current(0, torque_Nm / K_Nm_A)
    run(subject, 0.8)
    return subject.joint_speed_rad_s()[0]


@pytest.mark.parametrize("gear", [(), (PLAY,)], ids=["rigid", "two masses"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_coulomb_friction_sticks_below_its_torque_and_slips_above(gear: tuple[Entry, ...], sign: float) -> None:
    for torque_Nm, moves in ((1.9, False), (2.1, True)):
        subject = plant(coulomb(2.0), *gear, gravity_m_s2=WEIGHTLESS)
        subject.drive_current(0, sign * torque_Nm / K_Nm_A)
        run(subject, 0.5)
        travelled = sign * subject.joint_rad()[0]
        assert (travelled > 0.01) is moves
        if not moves:
            # The motor, freer than the link, knocks on it once on its way through the play.
            assert abs(travelled) < 3e-4


def test_what_sticks_does_not_creep() -> None:
    subject = plant(coulomb(5.0), start_rad=(0.0,))
    subject.drive_open(0)
    run(subject, 0.1)
    before = subject.joint_rad()[0]
    run(subject, 2.0)
    assert abs(subject.joint_rad()[0] - before) < 2e-6
    assert gravity_torque_Nm(0.0) > 3.0


def test_coulomb_and_viscous_friction_take_their_part_of_the_torque() -> None:
    assert terminal_speed(coulomb(1.0), torque_Nm=4.0) == pytest.approx((4.0 - 1.0) / 5.0, rel=1e-3)
    assert terminal_speed(coulomb(1.0), PLAY, torque_Nm=4.0) == pytest.approx((4.0 - 1.0) / 5.0, rel=1e-3)


def test_asymmetric_friction_is_larger_in_the_positive_direction() -> None:
    lopsided: Entry = ("asymmetric_friction", 1, {"torque_Nm": 0.4})
    forward = terminal_speed(coulomb(1.0), lopsided, torque_Nm=4.0)
    backward = terminal_speed(coulomb(1.0), lopsided, torque_Nm=-4.0)
    assert forward == pytest.approx((4.0 - 1.4) / 5.0, rel=1e-3)
    assert backward == pytest.approx(-(4.0 - 0.6) / 5.0, rel=1e-3)


def test_stribeck_friction_breaks_away_late_and_then_falls() -> None:
    stribeck: Entry = ("stribeck_friction", 1, {"torque_Nm": 1.0, "speed_rad_s": 0.05})
    for torque_Nm, moves in ((1.9, False), (2.2, True)):
        subject = plant(coulomb(1.0), stribeck, gravity_m_s2=WEIGHTLESS)
        subject.drive_current(0, torque_Nm / K_Nm_A)
        run(subject, 0.5)
        assert (subject.joint_rad()[0] > 0.01) is moves
    # Far above the Stribeck speed only the Coulomb level is left.
    for gear in ((), (PLAY,)):
        speed = terminal_speed(coulomb(1.0), stribeck, *gear, torque_Nm=4.0)
        assert speed == pytest.approx(3.0 / 5.0, rel=2e-2)


def test_a_slow_pull_through_a_spring_sticks_and_slips_with_stribeck_friction_only() -> None:
    spring: Entry = ("joint_compliance", 1, {"stiffness_Nm_rad": 200.0, "damping_Nm_s_rad": 0.2})

    def speed_changes(*entries: Entry) -> int:
        """How often the pulled link starts: 1 for smooth sliding."""
        subject = plant(spring, *entries, gravity_m_s2=WEIGHTLESS, rotor_inertia_kg_m2=1e-3, link_share=1.0)
        subject.drive_voltage(0, 0.4)  # 0.05 to 0.13 rad/s by load, below the Stribeck speed
        starts, was_moving = 0, False
        for _ in range(3000):
            run(subject, 1e-3)
            speed = subject.joint_speed_rad_s()[0]
            is_moving = speed > 0.1 if not was_moving else speed > 0.01
            starts += is_moving and not was_moving
            was_moving = is_moving
        return starts

    stribeck: Entry = ("stribeck_friction", 1, {"torque_Nm": 1.5, "speed_rad_s": 0.3})
    assert speed_changes(coulomb(1.0), stribeck) >= 3
    assert speed_changes(coulomb(1.0)) == 1


@pytest.mark.parametrize("gear", [(), (PLAY,)], ids=["rigid", "two masses"])
def test_load_friction_grows_with_the_torque_that_the_gear_passes_on(gear: tuple[Entry, ...]) -> None:
    load: Entry = ("load_friction", 1, {"fraction": 0.1})
    viscous: Entry = ("viscous_friction", 1, {"coefficient_Nm_s_rad": 20.0})
    torque_Nm = 6.0
    subject = plant(load, viscous, *gear)
    subject.drive_current(0, torque_Nm / K_Nm_A)
    run(subject, 0.25)
    speed, q = subject.joint_speed_rad_s()[0], subject.joint_rad()[0]
    weight_Nm = gravity_torque_Nm(q)
    # Moving steadily, the gear passes on the weight (inertia and half the friction are small beside it).
    lost_Nm = torque_Nm - 20.0 * speed - weight_Nm
    assert lost_Nm == pytest.approx(0.1 * weight_Nm, abs=0.12)
