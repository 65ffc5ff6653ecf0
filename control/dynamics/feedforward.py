"""Feed-forward torque of a motion: rigid body, rotors, and the arm's effects.

`payload` and `link_inertia` change masses, friction takes the sign of the set-point's speed, cogging the motor's angle. A
measured map adds what it has at the set-point.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import exp, sin, tanh
from typing import Final, Protocol

from control.dynamics.dynamics import Dynamics
from control.dynamics.effect_laws import SMOOTH_rad_s
from control.kinematics.smooth_table import SmoothTable
from control.model.arm import Arm, Effect
from control.model.maps import CorrectionMap

FED_FORWARD: Final = frozenset(
    {
        "payload", "link_inertia", "torque_constant", "coulomb_friction", "viscous_friction", "stribeck_friction",
        "load_friction", "asymmetric_friction", "cogging",
    }
)  # fmt: skip
Torques = tuple[float, ...]
FrictionTerm = Callable[
    [float, float, float], float
]  # motor's angle, joint's speed, rigid-body torque -> torque


class MotionTorques(Protocol):
    """Joint torques [N m] for angles, speeds and accelerations of the joints; `motor_rad` if the motors are at other angles."""

    def __call__(
        self,
        q: Sequence[float],
        speed: Sequence[float],
        acceleration: Sequence[float],
        motor_rad: Sequence[float] | None = None,
        /,
    ) -> Torques: ...


def torque_model(arm: Arm, payload_kg: float = 0.0) -> MotionTorques:
    """Return the torque function of the arm with all effects of its file.

    Raises MissingModel where the arm's file lacks masses.
    """
    rigid = Dynamics(with_link_inertia(arm), payload_kg + own_payload_kg(arm)).inverse
    terms = [(e.joint - 1, _term(arm, e)) for e in arm.effects if e.joint is not None and e.effect in _LAWS]
    terms += [(one.joint - 1, _map(arm, one)) for one in arm.maps if one.corrects == "torque_Nm"]

    def torques(
        q: Sequence[float],
        speed: Sequence[float],
        acceleration: Sequence[float],
        motor_rad: Sequence[float] | None = None,
        /,
    ) -> Torques:
        transmitted = rigid(q, speed, acceleration)
        if not terms:
            return transmitted
        total, at = list(transmitted), q if motor_rad is None else motor_rad
        for joint, term in terms:
            total[joint] += term(at[joint], speed[joint], transmitted[joint])
        return tuple(total)

    return torques


def own_payload_kg(arm: Arm) -> float:
    """Payload mass in the arm's file [kg]."""
    return sum(e.parameters["mass_kg"] for e in arm.effects if e.effect == "payload")


def with_link_inertia(arm: Arm) -> Arm:
    """The arm with the mass and inertia of its `link_inertia` effects added to its links; unchanged if it has none."""
    more = [
        (e.joint - 1, e.parameters) for e in arm.effects if e.effect == "link_inertia" and e.joint is not None
    ]
    if not more:
        return arm
    links = list(arm.links)
    for at, parameters in more:
        link = links[at]
        inertia = link.inertia_kg_m2 or (0.0, 0.0, 0.0)
        extra = parameters.get("inertia_kg_m2", 0.0)
        links[at] = replace(
            link,
            mass_kg=(link.mass_kg or 0.0) + parameters.get("mass_kg", 0.0),
            com_m=link.com_m or (0.0, 0.0, 0.0),
            inertia_kg_m2=(inertia[0] + extra, inertia[1] + extra, inertia[2] + extra),
        )
    return replace(arm, links=tuple(links))


def torque_constants_Nm_A(arm: Arm) -> Torques:
    """Joint torque per ampere, and volts per rad/s, of each motor; MissingModel where a joint has no [[drive]]."""
    scale = {e.joint: e.parameters["scale"] for e in arm.effects if e.effect == "torque_constant"}
    drives = [arm.drive(joint) for joint in range(1, arm.joint_count + 1)]
    return tuple(d.gear_ratio * d.torque_constant_Nm_A * scale.get(d.joint, 1.0) for d in drives)


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


def _map(arm: Arm, one: CorrectionMap) -> FrictionTerm:
    table, directed = SmoothTable.of(one), SmoothTable.of_direction(one)
    turn = arm.drive(one.joint).gear_ratio if one.is_periodic else 1.0
    place: FrictionTerm
    match one.over:
        case "load_Nm":
            place = _at_load
        case "speed_rad_s":
            place = _at_speed
        case _:
            place = _at_angle

    def torque(q: float, speed: float, load: float) -> float:
        at = turn * place(q, speed, load)
        return table(at) if directed is None else table(at) + tanh(speed / SMOOTH_rad_s) * directed(at)

    return torque


def _at_angle(q: float, speed: float, load: float) -> float:
    return q


def _at_speed(q: float, speed: float, load: float) -> float:
    return speed


def _at_load(q: float, speed: float, load: float) -> float:
    return load


_LAWS: dict[str, Callable[[Arm, Effect], FrictionTerm]] = {
    "coulomb_friction": _coulomb,
    "viscous_friction": _viscous,
    "stribeck_friction": _stribeck,
    "load_friction": _load,
    "asymmetric_friction": _asymmetric,
    "cogging": _cogging,
}
