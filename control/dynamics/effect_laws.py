"""The laws of the effects as pure functions: friction and cogging torques, and joint angle minus encoder angle.

Scalars, numpy arrays or both. A friction torque is what the motor has to add to overcome it. The sign of a speed is
smooth, tanh(speed / smooth), so that the feed-forward does not chatter at a constant set-point.
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
    """Additional Coulomb friction in the positive direction, and as much less in the negative; zero at rest."""
    return torque_Nm * abs(direction(speed_rad_s))


def cogging_Nm(q_rad: Value, gear_ratio: float, amplitude_Nm: Value, order: Value, phase_rad: Value) -> Value:
    """Torque that the motor has to add against cogging: `order` periods per motor turn."""
    return amplitude_Nm * np.sin(order * gear_ratio * q_rad + phase_rad)


def encoder_scale_rad(q_rad: Value, scale: Value) -> Value:
    """Joint angle minus encoder angle, for a scale error of the encoder."""
    return scale * q_rad


def encoder_eccentricity_rad(q_rad: Value, amplitude_rad: Value, phase_rad: Value) -> Value:
    """Joint angle minus encoder angle, for an eccentric encoder disc."""
    return amplitude_rad * np.sin(q_rad + phase_rad)


def backlash_rad(flank: Value, width_rad: Value) -> Value:
    """Joint angle minus motor angle, for backlash; `flank` is the sign of the transmitted torque."""
    return -0.5 * width_rad * flank


def compliance_rad(transmitted_Nm: Value, stiffness_Nm_rad: Value) -> Value:
    """Joint angle minus motor angle, for a compliant gear that transmits a torque from motor to joint."""
    return -transmitted_Nm / stiffness_Nm_rad


def belt_coupling_rad(q2_rad: Value, ratio: Value) -> Value:
    """Rotation of joint 3 by the belt from joint 2, which its encoder does not measure."""
    return ratio * q2_rad
