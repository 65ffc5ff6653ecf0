"""Between joints and encoders: the rigid part both ways, gears that never jump, and ranges that hold on both sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib.arm_problem.joint_effects import known_corrections
from calib.points.points import make_points
from control.dynamics.feedforward import torque_model
from control.dynamics.joint_side import EncoderChain, Gear, GearLaw, JointSide, link_torque, usable_range_rad
from control.errors import ArmError
from control.model.arm import Arm, Effect
from control.model.description import load_arm

RIGHT = load_arm("right")
STILL = (0.0, 0.0, 0.0)
T_S = 0.002
RIGID = (
    Effect("encoder_scale", 1, {"scale": 0.01}),
    Effect("encoder_eccentricity", 2, {"amplitude_rad": 0.008, "phase_rad": 0.7}),
    Effect("encoder_eccentricity", 3, {"amplitude_rad": 0.005, "phase_rad": -2.0}),
    Effect("encoder_scale", 3, {"scale": -0.004}),
    Effect("belt_coupling", None, {"ratio": 0.012}),
)
GEARS = (
    Effect("backlash", 1, {"width_rad": 0.006}),
    Effect("backlash", 2, {"width_rad": 0.004}),
    Effect("joint_compliance", 2, {"stiffness_Nm_rad": 2500.0}),
    Effect("joint_compliance", 3, {"stiffness_Nm_rad": 1500.0}),
    Effect("coulomb_friction", 1, {"torque_Nm": 1.0}),
    Effect("coulomb_friction", 2, {"torque_Nm": 1.2}),
)


def knowing(*effects: Effect) -> Arm:
    return replace(RIGHT, effects=effects)


def side_of(*effects: Effect) -> JointSide:
    side = JointSide.of(knowing(*effects))
    assert side is not None
    return side


def test_an_arm_whose_encoders_are_right_has_no_joint_side() -> None:
    friction = Effect("coulomb_friction", 1, {"torque_Nm": 1.0})
    assert JointSide.of(RIGHT) is None
    assert JointSide.of(knowing(friction, Effect("payload", None, {"mass_kg": 0.2}))) is None


def test_encoders_and_back_are_the_same_joints_with_speeds_and_accelerations() -> None:
    chain = EncoderChain(knowing(*RIGID))
    rng = np.random.default_rng(0)
    h = 1e-4

    def q(t: float) -> list[float]:
        return [0.5 * np.sin(t), -0.8 + 0.3 * np.cos(2.0 * t), 0.4 * np.sin(3.0 * t)]

    def encoders(t: float) -> tuple[tuple[float, ...], ...]:
        steps = [np.array(q(t + k * h)) for k in (-1, 0, 1)]
        speed, acceleration = (steps[2] - steps[0]) / (2 * h), (steps[0] - 2 * steps[1] + steps[2]) / h**2
        return chain.encoders(*(chain.unbelted(part.tolist()) for part in (steps[1], speed, acceleration)))

    for t in rng.uniform(0.0, 6.0, 20):
        e, speed, acceleration = map(np.array, encoders(t))
        assert chain.joints(e.tolist(), STILL) == pytest.approx(q(t), abs=1e-13)
        before, after = (np.array(encoders(t + k * h)[0]) for k in (-1, 1))
        assert speed == pytest.approx((after - before) / (2 * h), abs=1e-6)
        # Second differences over 0.1 ms of angles that round at 1e-16.
        assert acceleration == pytest.approx((before - 2 * e + after) / h**2, abs=1e-5)


def test_joints_at_rest_are_where_an_identification_puts_them() -> None:
    """The laws that were identified and the ones that correct are two programs: here they meet, where every flank is clear."""
    arm = knowing(*RIGID, *GEARS[1:4])
    e = np.array([[0.4, -0.7, 0.3], [-1.0, -1.2, 0.8], [0.9, 0.5, 0.6]])
    points = make_points(["free"] * 3, list("abc"), [1] * 3, e, np.full((3, 3), np.nan))
    expected = e + known_corrections(arm, points)
    for row, wanted in zip(e, expected, strict=True):
        joints = JointSide(arm).stand(row.tolist())
        # Identification takes joint 2's encoder for what the belt passes on, and gravity at the encoders' angles.
        assert joints == pytest.approx(wanted, abs=1.5e-4)


def test_an_arm_that_stands_is_told_to_stay_where_it_is() -> None:
    for start in ((0.4, -0.7, 0.3), (-1.0, 0.15, 0.75), (2.0, -1.5, -0.9)):
        side = side_of(*RIGID, *GEARS)
        joints = side.stand(start, payload_kg=0.3)
        for _ in range(50):
            q, speed, acceleration = side.aim((joints, STILL, STILL), T_S, payload_kg=0.3)
            assert q == pytest.approx(start, abs=1e-7)
            assert np.abs(speed).max() < 1e-3
            assert np.isfinite(acceleration).all()


def test_the_same_motion_both_ways_differs_by_the_play_and_by_friction_in_the_spring() -> None:
    side = side_of(*GEARS)
    side.stand((0.0, -0.6, 0.2))
    found = []
    for way in (1.0, -1.0):
        speed = (0.2 * way, 0.0, 0.0)
        for k in range(100):
            aim, *_ = side.aim(((0.4 * k * T_S * way, -0.6, 0.2), speed, STILL), T_S)
        found.append(aim[0] - 0.4 * 99 * T_S * way)
    assert found == pytest.approx([0.003, -0.003], abs=1e-6)


# ---- one gear

LAW = GearLaw(0.006, 1.0 / 2000.0, 0.5, 0.0, 0.5, 5.0)


def test_a_gear_follows_whatever_torque_comes_within_its_speed_and_acceleration() -> None:
    rng = np.random.default_rng(3)
    gear, before = Gear(LAW), 0.0
    gear.rest(4.0)
    for k in range(4000):
        if k % 40 == 0:
            torque, speed = rng.uniform(-10.0, 10.0), rng.choice([-0.3, 0.0, 0.3])
        elapsed_s = T_S * (1 + 20 * (k % 97 == 0))  # the host pauses now and then
        offset = gear.offset_rad
        gear.follow(torque, speed, 0.0, elapsed_s)
        assert abs(gear.speed_rad_s) <= LAW.speed_rad_s * 1.001
        assert abs(gear.speed_rad_s - before) <= LAW.acceleration_rad_s2 * elapsed_s * 1.001
        assert abs(gear.offset_rad - offset) <= LAW.speed_rad_s * elapsed_s * 1.001
        assert abs(gear.offset_rad) < 0.003 + 10.5 / 2000.0 + 1e-4
        before = gear.speed_rad_s


@pytest.mark.parametrize("width_rad", [0.0005, 0.006, 0.03])
def test_a_gear_crosses_its_play_without_overshoot_and_soon(width_rad: float) -> None:
    gear = Gear(replace(LAW, width_rad=width_rad, compliance_rad_Nm=0.0))
    gear.rest(4.0)
    track = []
    for _ in range(250):
        gear.follow(-4.0, 0.0, 0.0, T_S)
        track.append(gear.offset_rad)
    assert min(track) >= -0.5 * width_rad - 1e-7
    assert track[-1] == pytest.approx(-0.5 * width_rad, abs=1e-6)
    assert np.argmax(np.array(track) < -0.45 * width_rad) < 120  # a quarter of a second, for 1.7 deg of play


def test_a_gear_near_zero_torque_keeps_its_flank() -> None:
    gear = Gear(LAW)
    gear.rest(4.0)
    for torque in (0.02, -0.02, 0.4, -0.4, 0.0, -0.45):
        gear.follow(torque, 0.0, 0.0, T_S)  # at rest: friction holds more than that
        assert gear.flank == 1
    gear.follow(-0.6, 0.0, 0.0, T_S)
    assert gear.flank == -1
    for torque in (-0.51, -0.49, -0.5, -0.49):  # driven: friction of 0.5 Nm just about balances it
        gear.follow(torque, 0.1, 0.0, T_S)
        assert gear.flank == -1
    gear.follow(-0.3, 0.1, 0.0, T_S)
    assert gear.flank == 1


def test_a_gear_of_which_nothing_is_known_yet_stands_in_the_middle_of_its_play() -> None:
    gear = Gear(replace(LAW, compliance_rad_Nm=0.0))
    gear.rest(0.1)
    assert (gear.flank, gear.offset_rad) == (0, 0.0)
    gear.follow(0.1, -0.2, 0.0, T_S)
    assert gear.flank == -1


def test_load_friction_holds_a_gear_too() -> None:
    gear = Gear(replace(LAW, friction_Nm=0.0, load_fraction=0.5))
    gear.rest(2.0)
    gear.follow(-1.0, 0.0, 0.0, T_S)
    assert gear.flank == -1  # a fraction below 1 of the torque cannot hold it


# ---- torque and range


def test_gears_transmit_what_the_links_need_and_no_rotors() -> None:
    q, speed, acceleration = (0.3, -0.6, 0.5), (0.4, -0.2, 0.6), (3.0, -2.0, 5.0)
    rotors = [d.gear_ratio**2 * d.rotor_inertia_kg_m2 * a for d, a in zip(RIGHT.drives, acceleration, strict=True)]
    whole = torque_model(RIGHT, 0.4)(q, speed, acceleration)
    assert link_torque(RIGHT)(q, speed, acceleration, 0.4) == pytest.approx(np.subtract(whole, rotors), abs=1e-12)


def test_payload_and_link_inertia_are_carried() -> None:
    heavier = knowing(
        Effect("payload", None, {"mass_kg": 0.3}),
        Effect("link_inertia", 2, {"mass_kg": 0.5}),
        Effect("link_inertia", 3, {"inertia_kg_m2": 0.02}),
    )
    links = list(RIGHT.links)
    links[1] = replace(links[1], mass_kg=1.6)
    links[2] = replace(links[2], inertia_kg_m2=(0.028, 0.028, 0.0206))
    by_hand = torque_model(replace(RIGHT, links=tuple(links)), 0.3)
    state = (0.3, -0.6, 0.5), (0.4, -0.2, 0.6), (3.0, -2.0, 5.0)
    assert torque_model(heavier)(*state) == pytest.approx(by_hand(*state), rel=1e-12)
    assert link_torque(heavier)(*state, 0.0) == pytest.approx(link_torque(replace(RIGHT, links=tuple(links)))(*state, 0.3))


def test_the_range_of_joints_keeps_their_encoders_within_theirs() -> None:
    arm = knowing(*RIGID, *GEARS)
    room = usable_range_rad(arm)
    rng = np.random.default_rng(1)
    ends = np.array(room)
    assert usable_range_rad(RIGHT) == RIGHT.limits_rad
    side = JointSide(arm)
    for _ in range(20):
        q = np.where(rng.random(3) < 0.5, ends[:, 0], ends[:, 1])
        side.stand((0.0, -0.6, 0.2))
        for _ in range(200):
            aim, *_ = side.aim((tuple(q.tolist()), (0.1, -0.1, 0.1), STILL), T_S, 0.2)
        for e, at, (lower, upper) in zip(aim, q, RIGHT.limits_rad, strict=True):
            assert lower <= e <= upper
            assert lower <= at <= upper


def test_effects_that_leave_no_range_are_refused() -> None:
    with pytest.raises(ArmError, match="joint 2 has no range left"):
        usable_range_rad(knowing(Effect("backlash", 2, {"width_rad": 3.0})))
