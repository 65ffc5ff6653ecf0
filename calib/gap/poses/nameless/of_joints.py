"""Shapes of joints that have no name: with any angle, direction, time, load and current; those of the tip are `of_the_tip`."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np

from calib.arrays import Array
from calib.gap.effects.pose_scene import Scene
from calib.gap.poses.nameless.shape import edges, harmonic, of_joint
from calib.gap.posterior.term import Term
from calib.points.points import Points
from control.model.arm import Arm

PER_TURN = "times per turn"
HARMONICS = (4, 5, 6, 7, 8, 9, 10, 12)  # per turn, of a joint's own angle
MOTOR_HARMONICS = (1.0, 2.0, 0.5)  # per motor turn
TIME_PERIODS = (0.5, 1, 1.5, 2, 3, 4, 6, 8)  # of a session


def of_joints(scene: Scene) -> Iterator[Term]:
    """All of them for these poses, but those that are the law of an effect: what follows a law is that effect."""
    points, gravity = scene.points, scene.gravity_Nm
    held = None if scene.pose is None else scene.pose.held_Nm
    for j in range(points.joint_count):
        yield from _of_angles(points, j)
        yield from _of_the_motor(scene.arm, points, j)
        yield from _of_direction(points, gravity, held, j)
        yield from _of_time(points, j)
        yield from _of_load(points, gravity, j)


def _of_angles(points: Points, j: int) -> Iterator[Term]:
    """Powers and harmonics of every angle, steps in it, and products of two."""
    q, n = points.q_rad, points.joint_count
    for i in range(n):
        name, angle = f"q{i + 1}", q[:, i]
        variable = name if i == j else "other angles"
        if i != j:  # of its own angle that is an encoder's scale or eccentricity
            yield of_joint(n, j, variable, f"follows {name} (linearly)", angle)
            yield of_joint(n, j, variable, f"follows the sine of {name}", *harmonic(angle, 1))
        yield of_joint(n, j, variable, f"follows the square of {name}", angle**2)
        yield of_joint(n, j, variable, f"follows the cube of {name}", angle**3)
        yield of_joint(n, j, variable, f"follows {name} twice per turn", *harmonic(angle, 2))
        orders = (3, *HARMONICS) if i == j else (3,)
        for order in orders:
            words = f"follows {name} {'three' if order == 3 else order} times per turn"
            yield of_joint(n, j, variable, words, *harmonic(angle, order), manner=PER_TURN)
        for edge in edges(angle) if i == j else ():  # other angles have their smooth functions
            words = f"steps where {name} passes {edge:.2f} rad"
            yield of_joint(n, j, variable, words, np.sign(angle - edge), manner="steps")
    for i, k in combinations(range(n), 2):
        yield of_joint(n, j, "other angles", f"follows q{i + 1} times q{k + 1}", q[:, i] * q[:, k])


def _of_the_motor(arm: Arm, points: Points, j: int) -> Iterator[Term]:
    """What comes round with the motor's shaft."""
    for drive in arm.drives:
        if drive.joint == j + 1:
            for order in MOTOR_HARMONICS:
                courses = harmonic(points.q_rad[:, j], order * drive.gear_ratio)
                words = f"follows its motor's angle {order:g} times per turn"
                yield of_joint(points.joint_count, j, f"q{j + 1}", words, *courses, manner=PER_TURN)


def _of_direction(points: Points, gravity: Array | None, held: Array | None, j: int) -> Iterator[Term]:
    """Direction of the last motion of any joint, alone, with its own angle, and with its own load."""
    n = points.joint_count
    for i in range(n):
        words = f"follows the last direction of joint {i + 1}"
        yield of_joint(n, j, "direction", words, points.direction[:, i])
    own, variable = points.direction[:, j], "direction"
    yield of_joint(
        n, j, variable, "follows its last direction times its angle", own * points.q_rad[:, j], own
    )
    if gravity is not None:
        load = np.abs(gravity[:, j])
        yield of_joint(n, j, variable, "follows its last direction, more so under load", own * load, own)
    if held is not None:  # a soft gear that friction winds up: without gravity nobody can tell its stiffness
        yield of_joint(n, j, variable, "follows the friction that its motor holds", held[:, j])


def _of_time(points: Points, j: int) -> Iterator[Term]:
    """Drifts, periods and steps in time, and what adds up with the way that the joint goes."""
    if not np.isfinite(points.t_s).all() or np.ptp(points.t_s) == 0.0:
        return
    n = points.joint_count
    time = (points.t_s - points.t_s.min()) / np.ptp(points.t_s)
    yield of_joint(n, j, "time", "drifts with time", time)
    yield of_joint(n, j, "time", "drifts with time and its square", time, time**2)
    for periods in TIME_PERIODS:
        courses = harmonic(time, 2.0 * np.pi * periods)
        yield of_joint(n, j, "time", f"swings {periods:g} times in the session", *courses, manner="swings")
    yield of_joint(n, j, "time", "follows the way that it has gone", _way(points, j))
    for edge in edges(points.t_s):
        yield of_joint(n, j, "time", f"steps at {edge:.0f} s", np.sign(points.t_s - edge), manner="steps")


def _way(points: Points, j: int) -> Array:
    """How far joint j has gone in all before each pose, (m,)."""
    order = np.argsort(points.t_s, kind="stable")
    way = np.empty(len(points))
    way[order] = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(points.q_rad[order, j])))))
    return way


def _of_load(points: Points, gravity: Array | None, j: int) -> Iterator[Term]:
    """Stated payload, holding currents, and the load in other ways than in proportion, which is a soft gear."""
    n = points.joint_count
    if np.isfinite(points.payload_kg).all():
        yield of_joint(n, j, "payload", "follows the payload", points.payload_kg)
    for i in range(n):
        current = points.current_A[:, i]
        if np.isfinite(current).all():
            words = f"follows the square of the current of joint {i + 1}"
            yield of_joint(n, j, "currents", words, current**2)
    if gravity is None:
        return
    own = gravity[:, j]
    yield of_joint(n, j, "load", "follows its load's size, whatever its sign", np.abs(own))
    yield of_joint(n, j, "load", "follows its load, more than in proportion", own, own * np.abs(own))
    yield of_joint(n, j, "load", "follows its load and that cubed", own, own**3)
    root = np.sign(own) * np.sqrt(np.abs(own))
    yield of_joint(n, j, "load", "follows its load, less than in proportion", root)
    yield of_joint(n, j, "load", "follows its load, softer one way", np.maximum(own, 0), np.minimum(own, 0))
    for i in range(n):
        if i != j:
            yield of_joint(n, j, "other loads", f"follows the load of joint {i + 1}", gravity[:, i])
