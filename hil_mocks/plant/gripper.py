"""The physics of a gripper: a motor, fingers between two ends, and an elastic object between them.

m dv/dt = K i - friction + object, with L neglected: i = (u - K v) / R within the bridge's current limit. The object is a spring
of its own width; the ends are stiff. Integrated with the physics' time step (semi-implicit Euler), or with parts of it where
light fingers need them at the ends, opening positive.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_FINGERS_KG = 0.15
_END_N_m, _END_DAMPING_N_s_m = 2e5, 400.0  # of the hard ends


@dataclass(frozen=True, slots=True)
class GripperParts:
    """Constants of the gripper, at its fingers. `constant_N_A` is force per current and V s/m."""

    travel_m: float
    constant_N_A: float
    resistance_ohm: float
    supply_V: float
    rotor_kg: float
    friction_N: float
    start_m: float
    counts_per_m: float
    travel_per_turn_m: float


class GripperPlant:
    """One gripper. The bridge's output is open, voltage (V) or current (A), opening positive."""

    def __init__(self, parts: GripperParts, step_s: float) -> None:
        self._parts, self._mass_kg = parts, parts.rotor_kg + _FINGERS_KG
        # An explicit damper of c throws a mass back that it stops within a step: c h / m must stay below 1.
        self._splits = math.ceil(step_s * _END_DAMPING_N_s_m / self._mass_kg)
        self._step_s = step_s / self._splits
        self.opening_m, self.speed_m_s, self.current_A = parts.start_m, 0.0, 0.0
        self.supply_V = parts.supply_V
        self.is_clamped = False
        self.object_m: tuple[float, float] | None = None  # width, stiffness in N/m
        self.is_jammed = False
        self._kind, self._value, self._limit_A = "open", 0.0, math.inf

    def drive(self, kind: str, value: float, limit_A: float) -> None:
        """Hold the bridge's output until the next."""
        self._kind, self._value, self._limit_A = kind, value, limit_A

    def set_supply(self, supply_V: float | None) -> None:
        """Set the supply at the bridge; None: the nominal one."""
        self.supply_V = self._parts.supply_V if supply_V is None else supply_V

    def force_N(self) -> float:
        """Force on the object now."""
        if self.object_m is None:
            return 0.0
        width_m, stiffness = self.object_m
        return stiffness * max(0.0, width_m - self.opening_m)

    def count(self) -> int:
        """Edges of the motor's encoder, opening positive."""
        return math.floor((self.opening_m - self._parts.start_m) * self._parts.counts_per_m)

    def motor_rad(self) -> float:
        """How far its motor has turned since the start, opening positive."""
        return 2.0 * math.pi * (self.opening_m - self._parts.start_m) / self._parts.travel_per_turn_m

    def step(self, steps: int) -> None:
        """Advance by a number of time steps."""
        for _ in range(steps * self._splits):
            self._step()

    def _step(self) -> None:
        parts, h = self._parts, self._step_s
        self.current_A = self._bridge_A()
        push_N = parts.constant_N_A * self.current_A + self.force_N() + self._ends_N()
        wanted = self.speed_m_s + h * push_N / self._mass_kg
        most = h * parts.friction_N / self._mass_kg  # dry friction stops within a step, and then holds
        self.speed_m_s = 0.0 if abs(wanted) <= most else wanted - math.copysign(most, wanted)
        if self.is_jammed:
            self.speed_m_s = 0.0
        self.opening_m += h * self.speed_m_s

    def _bridge_A(self) -> float:
        parts = self._parts
        emf_V = parts.constant_N_A * self.speed_m_s
        if self._kind == "open":
            self.is_clamped = False
            return 0.0
        if self._kind == "current":
            wanted_A = self._value
        else:
            volts = min(max(self._value, -self.supply_V), self.supply_V)
            wanted_A = (volts - emf_V) / parts.resistance_ohm
        lower_A = max(-self._limit_A, (-self.supply_V - emf_V) / parts.resistance_ohm)
        upper_A = min(self._limit_A, (self.supply_V - emf_V) / parts.resistance_ohm)
        current_A = min(max(wanted_A, lower_A), max(lower_A, upper_A))
        self.is_clamped = current_A != wanted_A
        return current_A

    def _ends_N(self) -> float:
        beyond_m = min(self.opening_m, 0.0) + max(self.opening_m - self._parts.travel_m, 0.0)
        return -_END_N_m * beyond_m - (_END_DAMPING_N_s_m * self.speed_m_s if beyond_m else 0.0)
