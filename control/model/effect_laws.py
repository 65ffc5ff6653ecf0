"""The laws of the effects as pure functions: torques that a motor has to add, and joint angle minus encoder angle.

Each law stands here once, for the controller and for identification: of floats with `math`, of arrays with `numpy`. A friction
torque is what the motor has to add to overcome it. The sign of a speed is smooth, tanh(speed / SMOOTH_rad_s).
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

Value = Any  # float or numpy array
# Gears stick below some mrad/s, and a measured speed has no sign there. Wider, friction is missing in slow motion: at 10 mrad/s
# a width of 0.01 leaves out a quarter, this one 0.3 %.
SMOOTH_rad_s: Final = 0.003


class Functions(Protocol):
    """`math`, or `numpy` for arrays."""

    @property
    def tanh(self) -> Callable[[Value], Value]:
        """Hyperbolic tangent."""

    @property
    def exp(self) -> Callable[[Value], Value]:
        """Exponential function."""

    @property
    def sin(self) -> Callable[[Value], Value]:
        """Sine."""


Torque = Callable[
    [Value, Value, Value], Value
]  # angle of joint or motor, joint speed, transmitted torque -> torque
TorqueLaw = Callable[[Mapping[str, float], Functions], Torque]  # of an effect's parameters


def direction(speed_rad_s: Value, f: Functions = math) -> Value:
    """Smooth sign of a speed, -1 to 1."""
    return f.tanh(speed_rad_s / SMOOTH_rad_s)


def coulomb_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Dry friction."""
    torque_Nm, tanh = p["torque_Nm"], f.tanh
    return lambda angle, speed, load: torque_Nm * tanh(speed / SMOOTH_rad_s)


def viscous_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Friction that grows with speed."""
    coefficient = p["coefficient_Nm_s_rad"]
    return lambda angle, speed, load: coefficient * speed


def stribeck_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Friction beyond Coulomb near rest, exp(-(v / v_s)^2) (Armstrong-Helouvry's Gaussian form)."""
    torque_Nm, scale, tanh, exp = p["torque_Nm"], p["speed_rad_s"], f.tanh, f.exp
    return lambda angle, speed, load: torque_Nm * exp(-((speed / scale) ** 2)) * tanh(speed / SMOOTH_rad_s)


def load_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Dry friction that grows with the torque that the gear transmits."""
    fraction, tanh = p["fraction"], f.tanh
    return lambda angle, speed, load: fraction * abs(load) * tanh(speed / SMOOTH_rad_s)


def asymmetric_friction(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Additional Coulomb friction in the positive direction, and as much less in the negative; zero at rest."""
    torque_Nm, tanh = p["torque_Nm"], f.tanh
    return lambda angle, speed, load: torque_Nm * abs(tanh(speed / SMOOTH_rad_s))


def cogging(p: Mapping[str, float], f: Functions = math) -> Torque:
    """Torque that the motor has to add against cogging: `order` periods a turn of the angle, which is the motor's."""
    amplitude_Nm, order, phase, sin = p["amplitude_Nm"], p["order"], p["phase_rad"], f.sin
    return lambda angle, speed, load: amplitude_Nm * sin(order * angle + phase)


def backlash_rad(flank: Value, width_rad: Value) -> Value:
    """Joint angle minus motor angle, for backlash; `flank` is the sign of the transmitted torque."""
    return -0.5 * width_rad * flank


def compliance_rad(transmitted_Nm: Value, stiffness_Nm_rad: Value) -> Value:
    """Joint angle minus motor angle, for a compliant gear that transmits a torque from motor to joint."""
    return -transmitted_Nm / stiffness_Nm_rad
