"""What the effects do, as pure functions: friction and cogging as torques, and the joint angle behind the encoder.

Scalars, numpy arrays or both. Friction torques oppose motion: they are what the motor has to add. A speed's sign is
smooth, tanh(speed / smooth), so that a feed-forward does not chatter where the set-point stands still.
"""

from typing import Any, Final

import numpy as np

Value = Any  # float or numpy array
SMOOTH_rad_s: Final = 0.01


def direction(speed_rad_s: Value, smooth_rad_s: float = SMOOTH_rad_s) -> Value:
    """Smooth sign of a speed, -1 to 1."""
    return np.tanh(speed_rad_s / smooth_rad_s)


def coulomb_Nm(speed_rad_s: Value, torque_Nm: Value) -> Value:
    """Dry friction."""
    return torque_Nm * direction(speed_rad_s)


def viscous_Nm(speed_rad_s: Value, coefficient_Nm_s_rad: Value) -> Value:
    """Friction that grows with speed."""
    return coefficient_Nm_s_rad * speed_rad_s


def stribeck_Nm(speed_rad_s: Value, torque_Nm: Value, stribeck_rad_s: Value) -> Value:
    """Friction beyond Coulomb near rest, exp(-(v / v_s)^2) (Armstrong-Helouvry's Gaussian form)."""
    return torque_Nm * np.exp(-((speed_rad_s / stribeck_rad_s) ** 2)) * direction(speed_rad_s)


def load_friction_Nm(speed_rad_s: Value, transmitted_Nm: Value, fraction: Value) -> Value:
    """Dry friction that grows with the torque that the gear transmits."""
    return fraction * abs(transmitted_Nm) * direction(speed_rad_s)


def asymmetric_Nm(speed_rad_s: Value, torque_Nm: Value) -> Value:
    """Coulomb friction's surplus in the positive direction, its lack in the negative; nothing at rest."""
    return torque_Nm * abs(direction(speed_rad_s))


def cogging_Nm(q_rad: Value, gear_ratio: float, amplitude_Nm: Value, order: Value, phase_rad: Value) -> Value:
    """Torque that the motor has to add against its magnets: `order` periods a motor turn."""
    return amplitude_Nm * np.sin(order * gear_ratio * q_rad + phase_rad)


def encoder_scale_rad(q_rad: Value, scale: Value) -> Value:
    """How much further than its encoder says the joint has turned."""
    return scale * q_rad


def encoder_eccentricity_rad(q_rad: Value, amplitude_rad: Value, phase_rad: Value) -> Value:
    """How far the joint is ahead of an encoder whose disc is off centre."""
    return amplitude_rad * np.sin(q_rad + phase_rad)


def backlash_rad(flank: Value, width_rad: Value) -> Value:
    """How far the joint is ahead of its motor; `flank` is the sign of the torque that the gear transmits."""
    return -0.5 * width_rad * flank


def compliance_rad(transmitted_Nm: Value, stiffness_Nm_rad: Value) -> Value:
    """How far the joint is ahead of its motor when the gear transmits a torque from motor to joint."""
    return -transmitted_Nm / stiffness_Nm_rad


def belt_coupling_rad(q2_rad: Value, ratio: Value) -> Value:
    """How far joint 3 turns with joint 2 unseen by its encoder."""
    return ratio * q2_rad
