"""The torque that the model expects for a motion: rigid body, rotors, and the friction among the arm's effects."""

from collections.abc import Callable, Sequence
from math import exp, sin, tanh

from control.model.arm import Arm, Effect
from control.model.dynamics import Dynamics
from control.model.effect_laws import SMOOTH_rad_s

Torques = tuple[float, ...]
FrictionTerm = Callable[[float, float, float], float]  # joint angle, speed, rigid-body torque -> torque


def torque_model(
    arm: Arm, payload_kg: float = 0.0
) -> Callable[[Sequence[float], Sequence[float], Sequence[float]], Torques]:
    """Return `torques(q, speed, acceleration)` [N m at the joints] for the arm with all that it knows of itself.

    Raises MissingModel where the arm's file lacks masses.
    """
    rigid = Dynamics(arm, payload_kg).inverse
    terms = [(e.joint - 1, _term(arm, e)) for e in arm.effects if e.joint is not None and e.effect in _LAWS]
    if not terms:
        return rigid

    def torques(q: Sequence[float], speed: Sequence[float], acceleration: Sequence[float]) -> Torques:
        transmitted = rigid(q, speed, acceleration)
        total = list(transmitted)
        for joint, term in terms:
            total[joint] += term(q[joint], speed[joint], transmitted[joint])
        return tuple(total)

    return torques


def _term(arm: Arm, effect: Effect) -> FrictionTerm:
    return _LAWS[effect.effect](arm, effect)


def _coulomb(arm: Arm, effect: Effect) -> FrictionTerm:
    torque = effect.parameters["torque_Nm"]
    return lambda q, speed, load: torque * tanh(speed / SMOOTH_rad_s)


def _viscous(arm: Arm, effect: Effect) -> FrictionTerm:
    coefficient = effect.parameters["coefficient_Nm_s_rad"]
    return lambda q, speed, load: coefficient * speed


def _stribeck(arm: Arm, effect: Effect) -> FrictionTerm:
    torque, scale = effect.parameters["torque_Nm"], effect.parameters["speed_rad_s"]
    return lambda q, speed, load: torque * exp(-((speed / scale) ** 2)) * tanh(speed / SMOOTH_rad_s)


def _load(arm: Arm, effect: Effect) -> FrictionTerm:
    fraction = effect.parameters["fraction"]
    return lambda q, speed, load: fraction * abs(load) * tanh(speed / SMOOTH_rad_s)


def _asymmetric(arm: Arm, effect: Effect) -> FrictionTerm:
    torque = effect.parameters["torque_Nm"]
    return lambda q, speed, load: torque * abs(tanh(speed / SMOOTH_rad_s))


def _cogging(arm: Arm, effect: Effect) -> FrictionTerm:
    amplitude, phase = effect.parameters["amplitude_Nm"], effect.parameters["phase_rad"]
    per_rad = effect.parameters["order"] * arm.drive(effect.joint or 0).gear_ratio
    return lambda q, speed, load: amplitude * sin(per_rad * q + phase)


_LAWS: dict[str, Callable[[Arm, Effect], FrictionTerm]] = {
    "coulomb_friction": _coulomb,
    "viscous_friction": _viscous,
    "stribeck_friction": _stribeck,
    "load_friction": _load,
    "asymmetric_friction": _asymmetric,
    "cogging": _cogging,
}
