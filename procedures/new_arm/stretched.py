"""An arm from axes and lengths: at joint angles zero it stands stretched, its links along z."""

from __future__ import annotations

import math

import numpy as np

from calib.arm_import.dh_rows import Axis
from calib.arm_import.tree import Mass, SerialArm, TreeJoint
from procedures.new_arm.answers import Shape

DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
ALONG_LIMIT_rad, ACROSS_LIMIT_rad = 2.6, 1.9  # cables; and a link that does not fold into the one before
LEAST_LINK_m = 0.07  # as which a shorter link weighs
RADIUS_m = 0.03  # of a link as a rod


def stretched_arm(shape: Shape) -> SerialArm:
    """Axes, estimated masses and the tip of an arm that stands upright."""
    heights = [0.0]
    for length in shape.lengths_m:
        heights.append(heights[-1] + length)
    joints, axes, masses = [], [], []
    for number, (letter, length) in enumerate(zip(shape.axes, shape.lengths_m, strict=True), start=1):
        axis = np.array(DIRECTIONS[letter])
        place = np.array([0.0, 0.0, heights[number - 1]])
        limit = ALONG_LIMIT_rad if letter == "z" else ACROSS_LIMIT_rad
        joints.append(TreeJoint(f"joint{number}", "revolute", "revolute", axis, np.zeros(3), -limit, limit))
        axes.append(Axis(place, axis))
        tube_kg = shape.tube_kg_m * max(length, LEAST_LINK_m)
        masses.append(_rod(place, length, tube_kg, shape.joint_kg if number < len(shape.axes) else 0.0))
    tip = np.eye(4)
    tip[2, 3] = heights[-1]
    return SerialArm(
        tuple(joints),
        ("",) * len(joints),
        tuple(axes),
        tuple(masses),
        tip,
        "base",
        "tip",
        (0.0, 0.0, -9.81),
        (),
    )


def _rod(start_m: np.ndarray, length_m: float, tube_kg: float, end_kg: float) -> Mass:
    """A tube that carries the next joint at its end, in the base frame."""
    total_kg = tube_kg + end_kg
    com_m = (0.5 * tube_kg + end_kg) / total_kg * length_m
    across = tube_kg * (length_m**2 / 12 + (com_m - 0.5 * length_m) ** 2) + end_kg * (length_m - com_m) ** 2
    along = 0.5 * total_kg * RADIUS_m**2
    return Mass(
        total_kg,
        start_m + np.array([0.0, 0.0, com_m]),
        np.diag([across + 0.5 * along, across + 0.5 * along, along]),
    )


def is_level(gravity_m_s2: tuple[float, float, float]) -> bool:
    """Whether gravity points along -z, so that a floor below the base is where it seems."""
    x, y, z = gravity_m_s2
    return z < 0.0 and math.hypot(x, y) < 1e-6 * -z
