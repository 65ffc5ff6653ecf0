"""Small arms whose behaviour has a formula, and short ways to say what is in a plant."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hil_mocks.plant.build import PlantOptions
from hil_mocks.plant.effects import EffectEntry, PlantEffects, gather
from hil_mocks.plant.parts import ArmParts, DriveParts, LinkParts, PlantTool, Vector
from hil_mocks.plant.plant import Plant

MASS_KG, COM_M, LENGTH_M, INERTIA_kg_m2 = 1.2, 0.3, 0.5, 0.01
ROTOR_kg_m2, RATIO, KT_Nm_A, R_OHM, L_H, SUPPLY_V = 1.42e-5, 100.0, 0.0302, 0.299, 8.2e-5, 24.0
REFLECTED_kg_m2 = RATIO**2 * ROTOR_kg_m2
LINK_kg_m2 = INERTIA_kg_m2 + MASS_KG * COM_M**2
TOTAL_kg_m2 = REFLECTED_kg_m2 + LINK_kg_m2
K_Nm_A = RATIO * KT_Nm_A
G_m_s2 = 9.81


def drive(rotor_inertia_kg_m2: float = ROTOR_kg_m2) -> DriveParts:
    return DriveParts(
        gear_ratio=RATIO,
        encoder_counts_per_rev=2048,
        encoder_bits=32,
        torque_constant_Nm_A=KT_Nm_A,
        resistance_ohm=R_OHM,
        inductance_H=L_H,
        rotor_inertia_kg_m2=rotor_inertia_kg_m2,
        supply_V=SUPPLY_V,
        current_limit_A=1e3,
        joint_lower_rad=-1e3,
        joint_upper_rad=1e3,
    )


def arm(joints: int = 1, gravity_m_s2: Vector = (0.0, -G_m_s2, 0.0), **of_drive: float) -> ArmParts:
    """Links in the vertical plane, hinges horizontal; at q = 0 they lie level along x."""
    link = LinkParts(0.0, 0.0, LENGTH_M, 0.0, True, MASS_KG, (COM_M - LENGTH_M, 0.0, 0.0), (INERTIA_kg_m2,) * 3)
    return ArmParts(
        "pendulum", gravity_m_s2, "standard", (link,) * joints, (drive(**of_drive),) * joints, PlantTool((0.0, 0.0, 0.0))
    )


WEIGHTLESS: Vector = (0.0, 0.0, 0.0)


def effects(*entries: tuple[str, int, dict[str, float]], joints: int = 1) -> PlantEffects:
    return gather([EffectEntry(*entry) for entry in entries], joints, joints, "test")


def plant(
    *entries: tuple[str, int, dict[str, float]],
    start_rad: Sequence[float] = (0.0,),
    gravity_m_s2: Vector = (0.0, -G_m_s2, 0.0),
    timestep_s: float = 2.5e-4,
    link_share: float = 0.5,
    **of_drive: float,
) -> Plant:
    joints = len(start_rad)
    return Plant(
        arm(joints, gravity_m_s2, **of_drive),
        effects(*entries, joints=joints),
        start_rad,
        PlantOptions(timestep_s=timestep_s, link_share=link_share),
    )


def run(subject: Plant, duration_s: float) -> None:
    """Advance in ticks of 1 ms, as the boards do."""
    steps = round(1e-3 / subject.timestep_s)
    for _ in range(round(duration_s * 1e3)):
        subject.step(steps)


def gravity_torque_Nm(q_rad: float) -> float:
    """That a motor must hold at angle q."""
    return MASS_KG * G_m_s2 * COM_M * math.cos(q_rad)
