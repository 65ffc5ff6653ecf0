"""Feed-forward torque of a motion: rigid body, rotors, and the arm's effects.

`payload` and `link_inertia` change masses, friction takes the sign of the set-point's speed, cogging the motor's angle. A
measured map adds what it has at the set-point.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

from control.dynamics.dynamics import Dynamics
from control.kinematics.smooth_table import SmoothTable
from control.model.arm import Arm, Drive, Effect
from control.model.effects import EFFECTS, Torque, corrected, direction
from control.model.maps import CorrectionMap

FED_FORWARD: Final = corrected("torque")
Torques = tuple[float, ...]


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
    terms = [_term(arm, one) for one in arm.effects if EFFECTS[one.effect].torque is not None]
    terms += [(one.joint - 1, 1.0, _map(arm, one)) for one in arm.maps if one.corrects == "torque_Nm"]

    def torques(
        q: Sequence[float], speed: Sequence[float], acceleration: Sequence[float], motor_rad: Sequence[float] | None = None, /
    ) -> Torques:
        transmitted = rigid(q, speed, acceleration)
        if not terms:
            return transmitted
        total, at = list(transmitted), q if motor_rad is None else motor_rad
        for joint, ratio, term in terms:
            total[joint] += term(ratio * at[joint], speed[joint], transmitted[joint])
        return tuple(total)

    return torques


def own_payload_kg(arm: Arm) -> float:
    """Payload mass in the arm's file [kg]."""
    return sum(e.parameters["mass_kg"] for e in arm.effects if e.effect == "payload")


def links_alone(arm: Arm) -> Arm:
    """The arm with its `link_inertia` effects and without rotors: its torques are those that gears transmit to the links."""
    return replace(with_link_inertia(arm), drives=tuple(replace(one, rotor_inertia_kg_m2=0.0) for one in arm.drives))


def with_link_inertia(arm: Arm) -> Arm:
    """The arm with the mass and inertia of its `link_inertia` effects added to its links; unchanged if it has none."""
    more = [(e.joint - 1, e.parameters) for e in arm.effects if e.effect == "link_inertia" and e.joint is not None]
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


@dataclass(frozen=True, slots=True)
class Motor:
    """One joint's motor, referred to the joint: volts and amperes per N m and rad/s."""

    amperes_per_Nm: float
    resistance_ohm: float
    volts_per_rad_s: float
    supply_V: float
    current_limit_A: float
    current_step_A: float = 0.0  # to which its board rounds the current
    current_is_newest: bool = False  # it belongs to the last command, not to the one before that
    slack_rad: float = 0.0  # by which it may turn while the encoder stands


def torque_constants_Nm_A(arm: Arm) -> Torques:
    """Joint torque per ampere, and volts per rad/s, of each motor; MissingModel where a joint has no [[drive]]."""
    return tuple(torque_constant_Nm_A(arm, arm.drive(joint)) for joint in range(1, arm.joint_count + 1))


def torque_constant_Nm_A(arm: Arm, drive: Drive) -> float:
    """The same of one drive, with what the arm's file has of the effect."""
    scale = {e.joint: e.parameters["scale"] for e in arm.effects if e.effect == "torque_constant"}
    return drive.gear_ratio * drive.torque_constant_Nm_A * scale.get(drive.joint, 1.0)


def _term(arm: Arm, effect: Effect) -> tuple[int, float, Torque]:
    """Joint (0-based), turns of the law's angle a joint turn, and law of an effect with a torque."""
    kind, joint = EFFECTS[effect.effect], effect.joint
    assert kind.torque is not None
    assert joint is not None
    ratio = arm.drive(joint).gear_ratio if kind.is_of_motor else 1.0
    return joint - 1, ratio, kind.torque(effect.parameters, math)


def _map(arm: Arm, entry: CorrectionMap) -> Torque:
    table, directed = SmoothTable.of(entry), SmoothTable.of_direction(entry)
    turn = arm.drive(entry.joint).gear_ratio if entry.is_periodic else 1.0
    place: Torque
    match entry.over:
        case "load_Nm":
            place = _at_load
        case "speed_rad_s":
            place = _at_speed
        case _:
            place = _at_angle

    def torque(q: float, speed: float, load: float) -> float:
        at = turn * place(q, speed, load)
        return table(at) if directed is None else table(at) + direction(speed) * directed(at)

    return torque


def _at_angle(q: float, speed: float, load: float) -> float:
    return q


def _at_speed(q: float, speed: float, load: float) -> float:
    return speed


def _at_load(q: float, speed: float, load: float) -> float:
    return load
