"""A drive at its joint for other formats, and messages about everything that a format cannot represent."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib.export.frames import bodies_of, massless_joints
from control.model.arm import Arm, Drive, Effect

HELD = ("viscous_friction", "coulomb_friction")
EARTH_m_s2 = (0.0, 0.0, -9.81)


def losses(arm: Arm, form: str) -> tuple[str, ...]:
    """One sentence each; none for JSON, which represents everything."""
    if form == "json":
        return ()
    sentences = [*_effects(arm, form), *_masses(arm)]
    if form == "urdf" and arm.gravity_m_s2 != EARTH_m_s2:
        x, y, z = arm.gravity_m_s2
        sentences.append(f"urdf has no gravity: set {x:g}, {y:g}, {z:g} m/s^2 in the tool that reads it")
    return (*sentences, *_drives(arm, form), *_rest(arm, form))


def _effects(arm: Arm, form: str) -> list[str]:
    return [
        f"{form} cannot express the effect {_spelled(effect)}: omitted"
        for effect in arm.effects
        if effect.effect not in HELD
    ]


def _spelled(effect: Effect) -> str:
    figures = ", ".join(f"{key} {value:g}" for key, value in effect.parameters.items())
    where = f" of {effect.joint}" if effect.joint is not None else ""
    return f"{effect.effect}{where} ({figures})"


def _masses(arm: Arm) -> list[str]:
    bodies = bodies_of(arm)
    bare = massless_joints(bodies)
    sentences = []
    if bare:
        joints = ", ".join(map(str, bare))
        sentences.append(
            f"masses behind joint {joints} are unknown: the geometry is valid, the dynamics are not"
            " (MuJoCo gets 1e-6 kg per link, since it refuses zero mass)"
        )
    vague = [body.number for body in bodies if body.link.mass_kg and not body.has_inertia]
    if vague:
        sentences.append(
            f"link {', '.join(map(str, vague))}: mass without com_m and inertia_kg_m2 is omitted"
        )
    return sentences


def _drives(arm: Arm, form: str) -> list[str]:
    sentences = []
    for joint in range(1, arm.joint_count + 1):
        figures = joint_figures(arm, joint)
        ends = (figures.lower_rad, figures.upper_rad)
        if not figures.is_limited and any(abs(end) < 1e3 for end in ends):
            sentences.append(
                f"{form} has no joint with a single limit: joint {joint}, {ends[0]:g} to {ends[1]:g} rad, is unlimited"
            )
        if form == "urdf" and figures.rotor_kg_m2:
            sentences.append(
                f"urdf has no rotor inertia: joint {joint} lacks {figures.rotor_kg_m2:.3g} kg m^2"
                " and will accelerate too fast in a simulation"
            )
    if arm.drives:
        included = (
            "limits, torque, speed and friction" if form == "urdf" else "limits, torque, friction and rotor"
        )
        sentences.append(
            f"{form} contains {included} of the drives; motors, gears, encoders, accelerations, jerk and gains are omitted"
        )
    return sentences


def _rest(arm: Arm, form: str) -> list[str]:
    parts = [
        name
        for name, part in (
            ("table", arm.table),
            ("camera", arm.camera),
            ("boards", arm.encoder_boards or arm.can),
            ("rest pose", arm.rest),
        )
        if part
    ]
    return [f"{form} cannot express: {', '.join(parts)}; omitted"] if parts else []


# A drive for other formats: joint limits, torque, speed, friction, rotor inertia, all at the joint.


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
