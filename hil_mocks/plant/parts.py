"""The data of arm.toml that the plant needs, complete; missing values are errors. Denavit-Hartenberg frames as
MuJoCo bodies: pose of a body in its parent at joint angle zero, and its hinge.

Frames are written for the plant only and independent of control.kinematics.kinematics, so that testing one against the other is
meaningful. Their signs: Siciliano et al., Robotics (2009), section 2.8 (standard); Craig, Introduction to Robotics (2005),
section 3.4 (modified).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from control.model.arm import Arm, Drive, Link, Tool
from control.model.end_effector import Gripper
from hil_mocks.errors import MockError

Matrix = NDArray[np.float64]
Convention = Literal["standard", "modified"]
DH_KEYS = ("d_m", "theta_rad", "L_m", "alpha_rad")


class DhLink(Protocol):
    """Geometry of a link of arm.toml."""

    @property
    def d_m(self) -> float: ...
    @property
    def theta_rad(self) -> float: ...
    @property
    def L_m(self) -> float: ...
    @property
    def alpha_rad(self) -> float: ...


@dataclass(frozen=True, slots=True)
class LinkFrame:
    """A link frame in its parent's at joint angle zero, with the hinge's axis and anchor in the link's own frame."""

    position_m: Matrix  # (3,)
    rotation: Matrix  # (3, 3)
    axis: Matrix  # (3,) unit vector
    anchor_m: Matrix  # (3,)


def rotation_x(angle_rad: float) -> Matrix:
    """Rotation about x, (3, 3)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rotation_z(angle_rad: float) -> Matrix:
    """Rotation about z, (3, 3)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def standard_frame(d_m: float, theta_rad: float, L_m: float, alpha_rad: float) -> LinkFrame:
    """Tz(d) Rz(theta) Tx(L) Rx(alpha): the hinge is the parent's z axis, seen from the link's frame."""
    turn = rotation_z(theta_rad)
    rotation = turn @ rotation_x(alpha_rad)
    position_m = turn @ np.array([L_m, 0.0, 0.0]) + np.array([0.0, 0.0, d_m])
    return LinkFrame(position_m, rotation, rotation.T @ np.array([0.0, 0.0, 1.0]), -rotation.T @ position_m)


def modified_frame(d_m: float, theta_rad: float, L_m: float, alpha_rad: float) -> LinkFrame:
    """Rx(alpha) Tx(L) Rz(theta) Tz(d): the hinge is the link's own z axis."""
    tilt = rotation_x(alpha_rad)
    rotation = tilt @ rotation_z(theta_rad)
    position_m = tilt @ np.array([L_m, 0.0, d_m])
    return LinkFrame(position_m, rotation, np.array([0.0, 0.0, 1.0]), np.zeros(3))


def true_frame(link: DhLink, deviation: Mapping[str, float], convention: Convention) -> LinkFrame:
    """Frame of a link whose DH parameters are off nominal by `deviation` (keys of DH_KEYS; absent: 0)."""
    d, theta, length, alpha = (float(getattr(link, key)) + deviation.get(key, 0.0) for key in DH_KEYS)
    place = standard_frame if convention == "standard" else modified_frame
    return place(d, theta, length, alpha)


ELECTRICAL_S, MECHANICAL_S = 1e-4, 0.02  # L / R and J R / K^2 of a small motor

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class LinkParts:
    """Nominal DH parameters and mass properties of a link, in its own frame."""

    d_m: float
    theta_rad: float
    L_m: float
    alpha_rad: float
    is_revolute: bool
    mass_kg: float
    com_m: Vector
    inertia_kg_m2: Vector  # principal, about the centre of mass


@dataclass(frozen=True, slots=True)
class DriveParts:
    """Motor, gear and encoder of a joint."""

    gear_ratio: float
    encoder_counts_per_rev: int
    encoder_bits: int
    torque_constant_Nm_A: float
    resistance_ohm: float
    inductance_H: float
    rotor_inertia_kg_m2: float
    supply_V: float
    current_limit_A: float
    joint_lower_rad: float
    joint_upper_rad: float
    is_encoder_on_joint: bool = False  # else on the motor, before play and springs


@dataclass(frozen=True, slots=True)
class PlantTool:
    """A tool: its tip, and a point mass, in the frame of the last link."""

    tip_m: Vector
    mass_kg: float = 0.0
    com_m: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ArmParts:
    """The physical arm; `convention` of its DH parameters."""

    name: str
    gravity_m_s2: Vector
    convention: Convention
    links: tuple[LinkParts, ...]
    drives: tuple[DriveParts, ...]
    tool: PlantTool


def parts_of(arm: Arm) -> ArmParts:
    """The parts of an arm.toml. Raises MockError if a link that moves has no mass or a joint has no drive."""
    return ArmParts(
        name=arm.name,
        gravity_m_s2=_vector(arm.gravity_m_s2),
        convention="modified" if arm.dh_convention == "modified" else "standard",
        links=tuple(_link(arm, i, link) for i, link in enumerate(arm.links)),
        drives=tuple(_drive(drive) for drive in arm.drives),
        tool=tool_parts(arm.tool),
    )


def tool_parts(tool: Tool) -> PlantTool:
    """The parts of a [tool]; its mass is at the tip if its centre is not given."""
    return PlantTool(_vector(tool.position_m), tool.mass_kg, _vector(tool.position_m if tool.com_m is None else tool.com_m))


def _vector(values: tuple[float, ...]) -> Vector:
    x, y, z = values
    return float(x), float(y), float(z)


def _link(arm: Arm, i: int, link: Link) -> LinkParts:
    is_revolute = link.joint == "revolute"
    mass, com, inertia = link.mass_kg, link.com_m, link.inertia_kg_m2
    if is_revolute and (mass is None or com is None or inertia is None):
        raise MockError(
            f'arm "{arm.name}", link {i + 1}: the mock robot needs mass_kg, com_m and inertia_kg_m2 of each moving link.'
        )
    return LinkParts(
        d_m=link.d_m,
        theta_rad=link.theta_rad,
        L_m=link.L_m,
        alpha_rad=link.alpha_rad,
        is_revolute=is_revolute,
        mass_kg=mass or 0.0,
        com_m=_vector(com or (0.0, 0.0, 0.0)),
        inertia_kg_m2=_vector(inertia or (0.0, 0.0, 0.0)),
    )


def rotor_inertia_kg_m2(motor: Drive | Gripper) -> float:
    """That of the file, or of a usual motor: nothing follows a motor that weighs nothing."""
    usual_kg_m2 = MECHANICAL_S * motor.torque_constant_Nm_A**2 / motor.resistance_ohm
    return motor.rotor_inertia_kg_m2 or usual_kg_m2


def _drive(drive: Drive) -> DriveParts:
    """Inductance and rotor inertia that the file does not know are those of usual motors, by their time constants."""
    usual_H = ELECTRICAL_S * drive.resistance_ohm
    return DriveParts(
        gear_ratio=drive.gear_ratio,
        encoder_counts_per_rev=drive.encoder_counts_per_rev,
        encoder_bits=drive.encoder_bits,
        torque_constant_Nm_A=drive.torque_constant_Nm_A,
        resistance_ohm=drive.resistance_ohm,
        inductance_H=drive.inductance_H or usual_H,
        rotor_inertia_kg_m2=rotor_inertia_kg_m2(drive),
        supply_V=drive.supply_V,
        current_limit_A=drive.current_limit_A,
        joint_lower_rad=drive.joint_lower_rad,
        joint_upper_rad=drive.joint_upper_rad,
        is_encoder_on_joint=drive.encoder_on == "joint",
    )
