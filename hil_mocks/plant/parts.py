"""The data of arm.toml that the plant needs, complete; missing values are errors."""

from __future__ import annotations

from dataclasses import dataclass

from control.model.description import Arm, Drive, Gripper, Link, Tool
from hil_mocks.errors import MockError
from hil_mocks.plant.geometry import Convention

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
    return PlantTool(
        _vector(tool.position_m),
        tool.mass_kg,
        _vector(tool.position_m if tool.com_m is None else tool.com_m),
    )


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
