"""The smallest size of each effect that is worth a name: below it nothing is named.

About what a careful builder of such an arm would still correct: a tenth of a typical friction, a hundredth of a motor
constant, half a milliradian.
"""

from __future__ import annotations

import math

from calib.gap.signals.angles import plain
from calib.gap.signals.terms import Term
from control.model.arm import Arm

SMALLEST = {
    "coulomb_friction": 0.03,
    "viscous_friction": 0.03,
    "stribeck_friction": 0.08,
    "stribeck exponential": 0.08,
    "load_friction": 0.02,
    "asymmetric_friction": 0.03,
    "cogging": 0.05,
    "torque_constant": 0.01,
    "command_delay": 2e-4,
    "supply_sag": 0.01,
    "supply_sag by sum": 0.01,
    "payload": 0.01,
    "mass_kg": 0.03,
    "inertia_kg_m2": 0.003,
    "joint_compliance": 1e-4,
    "backlash": 5e-4,
    "link_flexure": 1 / 3000.0,
    "encoder_eccentricity": 3e-4,
    "encoder_scale": 5e-4,
    "belt_coupling": 5e-4,
    "thermal_drift": 3e-4,
    "base_frame": 3e-4,
    "link_geometry": 3e-4,
    "zero": 3e-4,
    "camera time": 5e-4,
    "sampling time": 5e-5,
}
MEANT_FOR_Nm = 30.0  # stall torque


def smallest(arm: Arm, form: str, joint: int) -> float:
    """The size for a joint (0-based) of this arm; small drives have small frictions."""
    return SMALLEST[plain(form)] * min(1.0, _of_drive(arm, form, joint))


def typical(arm: Arm, form: str, joint: int) -> float:
    """What `smallest` is a share of: the frictions of a large drive are larger, although as little is worth a name."""
    return smallest(arm, form, joint) * max(1.0, _of_drive(arm, form, joint))


def _of_drive(arm: Arm, form: str, joint: int) -> float:
    """A joint's torque over that of the drives that the sizes of torques are meant for; 1 for what is no torque."""
    return stall_Nm(arm, joint) / MEANT_FOR_Nm if form in _TORQUES and joint >= 0 else 1.0


def stall_Nm(arm: Arm, joint: int) -> float:
    """Torque at the current limit, or with the whole supply on a standing motor."""
    drive = arm.drives[joint]
    current = min(drive.current_limit_A, drive.supply_V / drive.resistance_ohm)
    return drive.torque_constant_Nm_A * drive.gear_ratio * current


_TORQUES = {
    "coulomb_friction",
    "viscous_friction",
    "stribeck_friction",
    "stribeck exponential",
    "asymmetric_friction",
    "cogging",
}


def is_worth_a_name(arm: Arm, term: Term) -> bool:
    """Whether a term is at least of the smallest size."""
    counted = term.values[:1] if plain(term.form) in _FIRST_COUNTS else term.values
    return math.hypot(*counted) >= smallest(arm, term.form, term.index)


_FIRST_COUNTS = {"stribeck_friction", "stribeck exponential", "joint_compliance", "backlash", "thermal_drift"}
