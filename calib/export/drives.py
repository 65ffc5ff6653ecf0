"""A drive for other formats: joint limits, torque, speed, friction, rotor inertia, all at the joint."""

from __future__ import annotations

import math
from dataclasses import dataclass

from control.model.arm import Arm, Drive


@dataclass(frozen=True, slots=True)
class DriveFigures:
    """Figures of one joint; infinite if unlimited, 0 if there is none."""

    lower_rad: float
    upper_rad: float
    torque_Nm: float
    speed_rad_s: float
    rotor_kg_m2: float
    viscous_Nm_s_rad: float
    coulomb_Nm: float

    @property
    def is_limited(self) -> bool:
        """Whether both ends of its range are known."""
        return math.isfinite(self.lower_rad) and math.isfinite(self.upper_rad)


def joint_figures(arm: Arm, joint: int) -> DriveFigures:
    """Figures of a joint (1-based), from its drive, if it has one, and the model's friction."""
    drive = next((d for d in arm.drives if d.joint == joint), None)
    lower, upper = arm.limits_rad[joint - 1]
    return DriveFigures(
        lower_rad=lower,
        upper_rad=upper,
        torque_Nm=_torque_Nm(drive) if drive else math.inf,
        speed_rad_s=_speed_rad_s(drive) if drive else math.inf,
        rotor_kg_m2=drive.gear_ratio**2 * drive.rotor_inertia_kg_m2 if drive else 0.0,
        viscous_Nm_s_rad=_effect(arm, "viscous_friction", joint, "coefficient_Nm_s_rad"),
        coulomb_Nm=_effect(arm, "coulomb_friction", joint, "torque_Nm"),
    )


def _torque_Nm(drive: Drive) -> float:
    """At the current limit, or stalled at the full supply if that is less."""
    current_A = min(drive.current_limit_A, drive.supply_V / drive.resistance_ohm)
    return current_A * drive.torque_constant_Nm_A * drive.gear_ratio


def _speed_rad_s(drive: Drive) -> float:
    """The joint's limit, or the motor's idle speed at the full supply if that is less."""
    idle_rad_s = drive.supply_V / (drive.torque_constant_Nm_A * drive.gear_ratio)
    return min(drive.joint_speed_limit_rad_s, idle_rad_s)


def _effect(arm: Arm, name: str, joint: int, parameter: str) -> float:
    return next((e.parameters[parameter] for e in arm.effects if (e.effect, e.joint) == (name, joint)), 0.0)
