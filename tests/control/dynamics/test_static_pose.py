"""Dry friction from poses of which most were led by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from control.dynamics.static_pose import friction_Nm, gravity_Nm, resting, torque_per_A
from control.model.description import load_arm

RIGHT = load_arm("right")
FRICTION = np.array([1.5, 1.8, 1.0])


def poses(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """24 driven poses and 99 that a hand seated: angles, directions, motor torques."""
    driven = rng.uniform((-1.0, -1.6, -0.8), (1.0, 0.6, 1.2), (24, 3))
    ways = np.where(rng.random((24, 3)) < 0.5, 1.0, -1.0)
    led = rng.uniform((-0.2, -1.1, -0.3), (0.2, -0.8, 0.3), (99, 3))
    down = np.tile((1.0, -1.0, 1.0), (99, 1))
    torque = np.vstack((gravity_Nm(RIGHT, driven) + FRICTION * ways, gravity_Nm(RIGHT, led)))
    return np.vstack((driven, led)), np.vstack((ways, down)), torque


def test_motors_that_stand_in_their_play_while_a_hand_holds_the_link_show_no_friction() -> None:
    q, way, torque = poses(np.random.default_rng(5))
    torque[24:, 1] = -0.9  # what its own side's friction holds; gravity asks for 4 Nm there
    gravity = gravity_Nm(RIGHT, q)
    held = torque - gravity
    level, is_known = friction_Nm(RIGHT, held, gravity)
    assert is_known.all()
    assert level == pytest.approx(FRICTION, rel=0.02)
    assert friction_Nm(RIGHT, held)[0][1] > 4.0  # what it looked like
    found = resting(RIGHT, q[:24], way[:24], torque[:24] / torque_per_A(RIGHT))
    assert not found.is_led.any()


def test_poses_that_all_look_unloaded_still_count() -> None:
    q = np.tile((0.1, -0.6, 0.2), (5, 1))
    gravity = gravity_Nm(RIGHT, q)
    level, _ = friction_Nm(RIGHT, -1.5 * gravity, gravity)
    assert level[1] == pytest.approx(1.5 * abs(gravity[0, 1]))


def test_without_drives_gravity_alone_says_what_gears_carry() -> None:
    arm = load_arm("right")
    q = np.array([[0.2, -0.6, 0.4], [0.5, 0.3, -0.2]])
    last = np.ones_like(q)
    bare = resting(replace(arm, drives=()), q, last, np.full_like(q, 0.5))
    np.testing.assert_allclose(bare.gravity_Nm, gravity_Nm(arm, q))
    np.testing.assert_array_equal(bare.held_Nm, 0.0)  # currents say nothing without a motor's constant
    np.testing.assert_array_equal(bare.flank[:, 1:], np.sign(gravity_Nm(arm, q))[:, 1:])
