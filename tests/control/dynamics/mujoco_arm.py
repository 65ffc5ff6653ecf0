"""A MuJoCo model of a DH arm, made for the tests alone: frames from 4x4 products, nothing of control.dynamics.dynamics."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from control.model.arm import Arm, Link

Array = NDArray[np.float64]


def _z(link: Link, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, link.d_m], [0, 0, 0, 1.0]])


def _x(link: Link) -> Array:
    c, s = math.cos(link.alpha_rad), math.sin(link.alpha_rad)
    return np.array([[1, 0, 0, link.L_m], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])


def model_of(arm: Arm, payload_kg: float = 0.0) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """One body a link, placed by its transform at q = 0, hinged about its z axis."""
    spec = mujoco.MjSpec()
    spec.option.gravity = arm.gravity_m_s2
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    body = spec.worldbody
    rotors = {d.joint: d.gear_ratio**2 * d.rotor_inertia_kg_m2 for d in arm.drives}
    joint = 0
    for number, link in enumerate(arm.links):
        parts = (_z(link, link.theta_rad), _x(link))
        placed = parts[0] @ parts[1] if arm.dh_convention == "standard" else parts[1] @ parts[0]
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, placed[:3, :3].flatten())
        body = body.add_body(pos=placed[:3, 3], quat=quaternion)
        mass, com, inertia = link.mass_kg or 0.0, link.com_m or (0, 0, 0), link.inertia_kg_m2 or (0, 0, 0)
        _weigh(body, mass, com, inertia, arm.tool.position_m, payload_kg if number == len(arm.links) - 1 else 0)
        if link.joint == "revolute":
            joint += 1
            at, axis = np.zeros(3), np.array([0.0, 0.0, 1.0])
            if arm.dh_convention == "standard":  # the axis is z of the frame before
                inverse = np.linalg.inv(placed)
                at, axis = inverse[:3, 3], inverse[:3, 2]
            body.add_joint(pos=at, axis=axis, armature=rotors.get(joint, 0.0))
    model = spec.compile()
    return model, mujoco.MjData(model)


def _weigh(body, mass, com, inertia, tool, payload) -> None:  # type: ignore[no-untyped-def]
    """Mass properties of a link, and the payload as a body of its own at the tip."""
    body.mass, body.ipos, body.inertia = max(mass, 1e-9), com, np.maximum(inertia, 1e-12)
    body.explicitinertial = True
    if payload:
        load = body.add_body(pos=tool)
        load.mass, load.inertia, load.explicitinertial = payload, np.full(3, 1e-12), True
