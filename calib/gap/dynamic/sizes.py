"""The smallest size of each effect that is worth a name: below it nothing is named, and detectability is for it.

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
    "inertia": 0.01,
    "current offset": 0.02,
    "warming": 0.1,
    "drag": 0.03,
    "cubic drag": 0.03,
    "position friction": 0.05,
    "position torque": 0.05,
    "joint turn torque": 0.05,
}
SAME_RESISTANCE = 0.03  # of the winding's
SAME_INDUCTANCE = 0.5  # of the winding's, or of what a tenth of a sample's delay looks like


def smallest(arm: Arm, form: str, joint: int) -> float:
    """The size for a joint (0-based) of this arm; small drives have small frictions."""
    if form == "resistance":
        return SAME_RESISTANCE * arm.drives[joint].resistance_ohm
    if form == "inductance":
        drive = arm.drives[joint]
        return max(SAME_INDUCTANCE * drive.inductance_H, 2e-4 * drive.resistance_ohm)
    size = SMALLEST[plain(form)]
    is_torque = form in _TORQUES and joint >= 0
    return size * min(1.0, stall_Nm(arm, joint) / 30.0) if is_torque else size


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
    "inertia",
    "warming",
    "drag",
    "cubic drag",
    "position friction",
    "position torque",
    "joint turn torque",
}


def is_worth_a_name(arm: Arm, term: Term) -> bool:
    """Whether a term is at least of the smallest size."""
    counted = term.values[:1] if plain(term.form) in _FIRST_COUNTS else term.values
    return math.hypot(*counted) >= smallest(arm, term.form, term.index)


_FIRST_COUNTS = {"stribeck_friction", "stribeck exponential", "joint_compliance", "backlash", "thermal_drift"}

NAMEABLE_sd = 8.0  # of the smallest size worth a name
