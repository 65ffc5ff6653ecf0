"""Default gains hold the joint stably in every pose; gains of the file are taken as they are."""

import dataclasses

import numpy as np
import pytest

from control.dynamics.dynamics import Dynamics
from control.dynamics.gains import Gains, POLE_rad_s, controller, gains_of, margins, placed_gains, volt_gains_of
from control.errors import MissingModel
from control.model.arm import Arm, Drive, DrivePid
from control.model.description import load_arm

RIGHT = load_arm("right")
PERIOD_S = 0.002


def _with_pid(pid: DrivePid) -> Arm:
    return dataclasses.replace(RIGHT, drives=tuple(dataclasses.replace(d, pid=pid) for d in RIGHT.drives))


def _phase_margin_deg(drive: Drive, inertia: float, gains: Gains) -> float:
    """Of the sampled loop: motor with inductance, one and a half cycles of delay, filtered derivative."""
    omega = np.logspace(0, 3.3, 4000)
    s = 1j * omega
    constant = drive.gear_ratio * drive.torque_constant_Nm_A
    motor = constant / ((drive.inductance_H * s + drive.resistance_ohm) * inertia * s + constant**2) / s
    pid = gains.kp + gains.ki / s + gains.kd * s / (gains.derivative_filter_s * s + 1)
    loop = motor * np.exp(-1.5 * PERIOD_S * s) * pid
    crossover = np.flatnonzero(np.abs(loop) > 1)[-1]
    return 180.0 + float(np.degrees(np.angle(loop[crossover])))


@pytest.mark.parametrize("joint", [1, 2, 3])
@pytest.mark.parametrize(("payload_kg", "margin_deg"), [(0.0, 48.0), (0.5, 40.0)])
def test_default_gains_keep_their_phase_margin_in_every_pose(joint: int, payload_kg: float, margin_deg: float) -> None:
    lower, upper = np.array(RIGHT.limits_rad).T
    poses = np.random.default_rng(1).uniform(lower, upper, (300, 3))
    inertias = Dynamics(RIGHT, payload_kg).mass_matrices(poses)[:, joint - 1, joint - 1]
    gains = gains_of(RIGHT, joint)
    for inertia in (inertias.min(), inertias.max()):
        assert _phase_margin_deg(RIGHT.drive(joint), inertia, gains) >= margin_deg - 0.5


def test_default_gains_bear_a_pose_in_which_a_joint_has_a_fraction_of_its_inertia() -> None:
    weak = dataclasses.replace(RIGHT.drives[0], rotor_inertia_kg_m2=4e-6, resistance_ohm=4.0)  # its back-EMF hardly damps
    arm = dataclasses.replace(RIGHT, drives=(weak, *RIGHT.drives[1:]))
    lower, upper = np.array(RIGHT.limits_rad).T
    poses = np.random.default_rng(1).uniform(lower, upper, (300, 3))
    inertias = Dynamics(arm).mass_matrices(poses)[:, 0, 0]
    assert inertias.max() > 4.0 * inertias.min()
    gains, drive = gains_of(arm, 1), arm.drive(1)
    constant, omega = drive.gear_ratio * drive.torque_constant_Nm_A, np.geomspace(1.0, 1500.0, 600)
    for inertia in (inertias.min(), inertias.max()):
        b, s = constant / (drive.resistance_ohm * inertia), 1j * omega
        plant = b * np.exp(-2.0 * PERIOD_S * s) / (s * (s + constant * b))
        found = margins(omega, controller(gains, PERIOD_S, omega) * plant)
        assert found.meet(8.0, 45.0)


@pytest.mark.parametrize("mode", ["voltage", "current", "position"])
def test_the_poles_are_where_they_were_asked_for(mode: str) -> None:
    drive = dataclasses.replace(RIGHT.drive(2), pid=DrivePid(mode))  # type: ignore[arg-type]
    inertia = 2.0
    gains = placed_gains(drive, inertia, 0.0)
    constant = drive.gear_ratio * drive.torque_constant_Nm_A
    gain = constant / inertia / (1.0 if mode == "current" else drive.resistance_ohm)
    damping = 0.0 if mode == "current" else constant * gain
    poles = np.roots([1.0, damping + gain * gains.kd, gain * gains.kp, gain * gains.ki])
    assert poles == pytest.approx([-POLE_rad_s] * 3, rel=1e-4)


def _share_of_play(b: float, a: float, gains: Gains) -> float:
    """Amplitude of the joint over half the play, in the cycle that L N(A) = -1 foretells; N by simulating a hysteresis."""
    omega = np.geomspace(0.05, 200.0, 4000)
    s = 1j * omega
    loop = (gains.kp + gains.ki / s + gains.kd * s) * b / (s * (s + a)) * np.exp(-2.0 * PERIOD_S * s)
    amplitudes = 1.0 + np.geomspace(1e-4, 30.0, 300)  # of the motor, over half the play
    turn = np.linspace(0.0, 4.0 * np.pi, 4001)
    motor = np.outer(amplitudes, np.sin(turn))
    joint = np.zeros_like(motor)
    for k in range(1, len(turn)):
        joint[:, k] = np.clip(joint[:, k - 1], motor[:, k] - 1.0, motor[:, k] + 1.0)
    gain = (2j * joint[:, 2000:-1] * np.exp(-1j * turn[2000:-1])).mean(axis=1) / amplitudes
    off = np.abs(1.0 + np.outer(gain, loop))
    best = np.unravel_index(off.argmin(), off.shape)
    assert off[best] < 0.02
    return float(amplitudes[best[0]] * abs(gain[best[0]]))


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_cycle_in_play_moves_a_joint_by_little_of_it_with_the_gains_for_an_encoder_behind(joint: int) -> None:
    drive = dataclasses.replace(RIGHT.drive(joint), encoder_on="joint")
    inertia, constant = 0.5, drive.gear_ratio * drive.torque_constant_Nm_A
    b = constant / (drive.resistance_ohm * inertia)
    behind = placed_gains(drive, inertia, 0.001)
    before = placed_gains(RIGHT.drive(joint), inertia, 0.001)
    assert behind.kd == 0.0
    assert _share_of_play(b, constant * b, behind) < 0.2
    assert _share_of_play(b, constant * b, before) > 0.3


def test_a_board_that_holds_by_the_encoder_on_the_motor_has_the_gains_for_that() -> None:
    both = dataclasses.replace(RIGHT.drive(2), encoder_on="joint", motor_counts_per_rev=2048)
    arm = dataclasses.replace(RIGHT, drives=(RIGHT.drives[0], both, RIGHT.drives[2]))
    assert volt_gains_of(arm, 2) == gains_of(RIGHT, 2) != gains_of(arm, 2)


def test_gains_of_the_file_win_and_the_rest_is_derived() -> None:
    derived = gains_of(RIGHT, 1)
    assert gains_of(_with_pid(DrivePid(kp=1.0, ki=2.0, kd=3.0, derivative_filter_s=0.0)), 1) == Gains(1, 2, 3, 0)
    assert gains_of(_with_pid(DrivePid(kp=7.0)), 1) == dataclasses.replace(derived, kp=7.0)


def test_without_masses_gains_must_be_given() -> None:
    links = tuple(dataclasses.replace(k, mass_kg=None, com_m=None, inertia_kg_m2=None) for k in RIGHT.links)
    with pytest.raises(MissingModel, match=r"no kp, ki, kd, and they cannot be derived.*\[\[link\]\] 1"):
        gains_of(dataclasses.replace(RIGHT, links=links), 1)
    given = dataclasses.replace(_with_pid(DrivePid(kp=1.0, ki=2.0, kd=3.0)), links=links)
    assert gains_of(given, 1).kp == 1.0
    with pytest.raises(MissingModel, match="joint 4 has no"):
        gains_of(RIGHT, 4)


def test_a_joint_without_inertia_is_named() -> None:
    nothing = (0.0, 0.0, 0.0)
    links = tuple(dataclasses.replace(k, mass_kg=0.0, com_m=nothing, inertia_kg_m2=nothing) for k in RIGHT.links)
    drives = tuple(dataclasses.replace(d, rotor_inertia_kg_m2=0.0) for d in RIGHT.drives)
    weightless = dataclasses.replace(RIGHT, links=links, drives=drives)
    with pytest.raises(MissingModel, match="its inertia is zero"):
        gains_of(weightless, 1)
