"""Point masses that the last link carries, as torques: the tool's own mass and the payload at its tip, both of which change at
run time.

Torques are linear in each mass, so those of 1 kg at each place are scaled. A mass that appears, goes or moves (another tool)
does so at a limited rate: the controller, whose integral has carried the difference, is not jolted.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from control.dynamics.dynamics import Dynamics
from control.model.arm import Arm, Link, Tool, Vector3

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
