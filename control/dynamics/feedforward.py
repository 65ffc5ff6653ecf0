"""Feed-forward torque of a motion: rigid body, rotors, and the arm's effects; and of point masses that the last link carries.

`payload` and `link_inertia` change masses, friction takes the sign of the set-point's speed, cogging the motor's angle. A
measured map adds what it has at the set-point.

The tool's own mass and the payload at its tip change at run time. Torques are linear in each mass, so those of 1 kg at each place
are scaled. A mass that appears, goes or moves (another tool) does so at a limited rate: the controller, whose integral has
carried the difference, is not jolted.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

from control.dynamics.dynamics import Dynamics
from control.model.arm import Arm, Drive, Effect, Link, Tool, Vector3
from control.model.effects import EFFECTS, Torque, corrected, direction
from control.model.maps import CorrectionMap, SmoothTable

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


UnitTorques = Callable[[Sequence[float], Sequence[float], Sequence[float]], Sequence[float]]


def without_tool_mass(arm: Arm) -> Arm:
    """The arm with a tool that weighs nothing."""
    return replace(arm, tool=replace(arm.tool, mass_kg=0.0)) if arm.tool.mass_kg else arm


class Loads:
    """The masses [kg] on the last link by their place in its frame: as the model has them now, and as they are stated."""

    def __init__(self, arm: Arm) -> None:
        """The arm's tools give the places; its present tool is on, and nothing is held. MissingModel if masses are missing."""
        self._unit = {
            place: _unit_torques(arm, place)
            for tool in arm.tools
            for place in ((tool.position_m, tool.centre_m) if tool.mass_kg else (tool.position_m,))
        }
        self._tool = arm.tool
        self._stated: dict[Vector3, float] = {}
        self._now: dict[Vector3, float] = {}
        self._payload_kg = 0.0
        self.take_at_once()

    @property
    def payload_kg(self) -> float:
        """The stated payload."""
        return self._payload_kg

    def state(self, tool: Tool, payload_kg: float) -> None:
        """State the tool and what it holds; `follow` makes them the model's."""
        self._tool, self._payload_kg = tool, payload_kg
        stated = dict.fromkeys(self._now, 0.0)
        for place, mass_kg in ((tool.position_m, payload_kg), (tool.centre_m, tool.mass_kg)):
            if mass_kg:
                stated[place] = stated.get(place, 0.0) + mass_kg
        self._stated = stated

    def take_at_once(self) -> None:
        """The model has the stated masses now: for an arm that nothing depends on yet."""
        self.state(self._tool, self._payload_kg)
        self._now = {place: mass for place, mass in self._stated.items() if mass}
        self._stated = dict(self._now)

    def follow(self, most_kg: float) -> None:
        """Let each mass of the model go towards the stated one by at most `most_kg`."""
        if self._now == self._stated:
            return
        for place, wanted in self._stated.items():
            now = self._now.get(place, 0.0)
            self._now[place] = now + min(max(wanted - now, -most_kg), most_kg)
        if self._now == self._stated:
            self.take_at_once()

    @property
    def at_tip_kg(self) -> float:
        """The model's mass at the present tip."""
        return self._now.get(self._tool.position_m, 0.0)

    @property
    def masses_kg(self) -> dict[Vector3, float]:
        """The model's masses now, by their place in the last frame."""
        return dict(self._now)

    def torques(self, q: Sequence[float], speed: Sequence[float], acceleration: Sequence[float]) -> Sequence[float] | None:
        """Joint torques [N m] that the masses need for a motion [rad, rad/s, rad/s^2]; None: there is no mass."""
        total: Sequence[float] | None = None
        for place, mass_kg in self._now.items():
            unit = self._unit[place](q, speed, acceleration)
            total = [mass_kg * u for u in unit] if total is None else [t + mass_kg * u for t, u in zip(total, unit, strict=True)]
        return total


def _unit_torques(arm: Arm, place: Vector3) -> UnitTorques:
    """Torques of 1 kg at a place in the last frame, on an arm whose links and rotors weigh nothing."""
    links = tuple(_weightless(link) for link in arm.links)
    drives = tuple(replace(drive, rotor_inertia_kg_m2=0.0) for drive in arm.drives)
    return Dynamics(replace(arm, links=links, drives=drives, tool=Tool(place), effects=()), 1.0).inverse


def _weightless(link: Link) -> Link:
    return replace(link, mass_kg=0.0, com_m=(0.0, 0.0, 0.0), inertia_kg_m2=(0.0, 0.0, 0.0))
