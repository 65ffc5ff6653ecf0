"""Gains of a joint's position control: those that arm.toml gives, the others by pole placement on the model.

The joint as its motor sees it, without the inductance (its time constant is a fraction of a cycle): with inertia J
(the mass matrix's diagonal in the rest pose, rotor included), ratio N, motor constant k and resistance R,

    J q'' = N k i,   i = (u - N k q') / R        =>   q'' = b u - a q',   b = N k / (R J),   a = (N k)^2 / (R J)

(current mode: b = N k / J, a = 0). A PID closes it to s^3 + (a + b kd) s^2 + b kp s + b ki, which is (s + w)^3 for

    kd = (3 w - a) / b,   kp = 3 w^2 / b,   ki = w^3 / b.

w = 40 rad/s: with the 500 Hz loop's delay of one and a half cycles this leaves at least 50 degrees of phase margin
and a largest sensitivity of 1.5 for inertias from 0.2 to 0.9 kg m^2 with the reference motor, and a closed-loop
bandwidth of 50 to 180 rad/s. Where the back-EMF damps more than 3 w, kd is zero.
"""

from dataclasses import dataclass

from control.errors import MissingModel
from control.model.arm import Arm, Drive
from control.model.dynamics import Dynamics

POLE_rad_s = 40.0
DERIVATIVE_FILTER_S = 0.001  # half a cycle: only enough to calm the steps of the encoder


@dataclass(frozen=True, slots=True)
class Gains:
    """At the joint; kp in V/rad, ki in V/(rad s), kd in V s/rad, in current mode with A for V."""

    kp: float
    ki: float
    kd: float
    derivative_filter_s: float


def gains_of(arm: Arm, joint: int) -> Gains:
    """Return the gains of a joint (1-based); MissingModel where neither the file nor the masses give them."""
    drive = arm.drive(joint)
    pid = drive.pid
    filter_s = DERIVATIVE_FILTER_S if pid.derivative_filter_s is None else pid.derivative_filter_s
    if pid.kp is not None and pid.ki is not None and pid.kd is not None:
        return Gains(pid.kp, pid.ki, pid.kd, filter_s)
    placed = placed_gains(drive, _inertia_kg_m2(arm, joint), filter_s)
    return Gains(
        placed.kp if pid.kp is None else pid.kp,
        placed.ki if pid.ki is None else pid.ki,
        placed.kd if pid.kd is None else pid.kd,
        filter_s,
    )


def placed_gains(
    drive: Drive, inertia_kg_m2: float, filter_s: float, pole_rad_s: float = POLE_rad_s
) -> Gains:
    """Return the gains that put three poles at -pole for a joint of this inertia."""
    constant = drive.gear_ratio * drive.torque_constant_Nm_A
    if drive.pid.mode == "current":
        b, a = constant / inertia_kg_m2, 0.0
    else:
        b = constant / (drive.resistance_ohm * inertia_kg_m2)
        a = constant * b
    w = pole_rad_s
    return Gains(3.0 * w * w / b, w**3 / b, max(3.0 * w - a, 0.0) / b, filter_s)


def _inertia_kg_m2(arm: Arm, joint: int) -> float:
    try:
        matrices = Dynamics(arm).mass_matrices([_rest(arm)])
    except MissingModel as error:
        needs = f"gains of joint {joint}: [drive.pid] has no kp, ki, kd, and they cannot be derived"
        raise MissingModel(f"{needs}: {error}") from None
    inertia = float(matrices[0, joint - 1, joint - 1])
    if inertia <= 0.0:
        raise MissingModel(
            f"arm {arm.name}: joint {joint} has no inertia to derive gains from; "
            "give rotor_inertia_kg_m2, or kp, ki, kd in [drive.pid]"
        )
    return inertia


def _rest(arm: Arm) -> tuple[float, ...]:
    """The rest pose, or zero brought into the limits."""
    if arm.rest is not None:
        return arm.rest.q_rad
    return tuple(min(max(0.0, lower), upper) for lower, upper in arm.limits_rad)
