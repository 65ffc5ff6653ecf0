"""The H-bridges of the motors: voltage with current limiting, current source, or open circuit.

MuJoCo's dcmotor solves L di/dt = u - R i - K w with the current as its state. The three modes are three settings of it:
the plain voltage; a current source is a huge R with u = I R, so that back-EMF is negligible, with its own lag; open
circuit is a huge R with u = 0. One mj_step then does any number of steps in any mode.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from hil_mocks.plant.effects import PlantEffects
from hil_mocks.plant.parts import ArmParts

_SOURCE_OHM = 1e6  # back-EMF of some V makes some uA
_OPEN_OHM = 1e12
CURRENT_LAG_S = 5e-4  # first-order lag of a current controller of 2 kHz bandwidth

OPEN, VOLTAGE, CURRENT = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Winding:
    """Electrical constants of a motor seen at its joint: `K_V_s_rad` = gear ratio x motor constant (also Nm/A)."""

    K_V_s_rad: float
    resistance_ohm: float
    inductance_H: float
    supply_V: float


def windings_of(arm: ArmParts, effects: PlantEffects) -> list[Winding]:
    """Return the motors' windings as the joints see them."""
    return [
        Winding(
            K_V_s_rad=drive.gear_ratio * drive.torque_constant_Nm_A * effect.torque_constant_scale,
            resistance_ohm=drive.resistance_ohm,
            inductance_H=drive.inductance_H,
            supply_V=drive.supply_V,
        )
        for drive, effect in zip(arm.drives, effects.joints, strict=True)
    ]


class Bridges:
    """All bridges of an arm. Commands are held until the next; `settle` applies the limits once a tick."""

    def __init__(self, model: Any, state: Any, windings: Sequence[Winding], index: Sequence[int], supply_ohm: float) -> None:
        self._gain, self._dynamics = model.actuator_gainprm, model.actuator_dynprm
        self._ctrl, self._act, self._velocity = state.ctrl, state.act, state.actuator_velocity
        self._windings, self._index = tuple(windings), tuple(index)
        self._constants = [(w.K_V_s_rad, w.resistance_ohm, w.supply_V) for w in self._windings]
        self._current_at = tuple(int(model.actuator_actadr[k]) for k in index)
        self._supply_ohm = supply_ohm
        count = len(self._windings)
        self._mode, self._command = [OPEN] * count, [0.0] * count
        self._limit_A = [1e9] * count
        self._set_as = [-1] * count
        self._ctrl_V = [math.nan] * count  # as it was set last: to write into MuJoCo's array costs more than to compare
        self.supply_V = [winding.supply_V for winding in self._windings]
        self.is_clamped = [False] * count
        self._no_load_V = [winding.supply_V for winding in self._windings]
        for j in range(count):
            self._settle(j, 0.0)

    def command(self, j: int, mode: int, value: float) -> None:
        """Command OPEN, VOLTAGE in V or CURRENT in A."""
        self._mode[j], self._command[j] = mode, value

    def limit_current(self, j: int, limit_A: float) -> None:
        """Limit the current to +-limit in every mode."""
        self._limit_A[j] = limit_A

    def set_supply(self, j: int, supply_V: float | None) -> None:
        """Set the supply voltage at bridge j; None: the nominal one."""
        self._no_load_V[j] = self.supply_V[j] = self._windings[j].supply_V if supply_V is None else supply_V

    def settle(self, speeds_rad_s: Sequence[float]) -> None:
        """Limit all outputs by the motors' speeds (joint side) and the supply; call it before each run of steps."""
        is_stiff = self._supply_ohm == 0.0
        if not is_stiff:
            self._sag()
        bridges = zip(
            speeds_rad_s, self._set_as, self._mode, self._command, self._constants, self._limit_A, self.supply_V, strict=True
        )
        for j, (speed, set_as, mode, voltage, (K, resistance_ohm, nominal_V), limit_A, supply_V) in enumerate(bridges):
            # The usual case: same mode and no limit in reach.
            if (
                mode == set_as == VOLTAGE
                and is_stiff
                and -supply_V <= voltage <= supply_V == nominal_V
                and -limit_A <= (voltage - K * speed) / resistance_ohm <= limit_A
            ):
                if voltage != self._ctrl_V[j]:
                    self._ctrl_V[j] = self._ctrl[self._index[j]] = voltage
            else:
                self._ctrl_V[j] = math.nan
                self._settle(j, speed)

    def currents_A(self) -> list[float]:
        """Currents of all motors now."""
        act: list[float] = self._act.tolist()
        return [act[k] for k in self._current_at]

    def current_A(self, j: int) -> float:
        """Current of the motor now."""
        return float(self._act[self._current_at[j]])

    def voltage_V(self, j: int) -> float:
        """The commanded voltage, 0 in the other modes."""
        return self._command[j] if self._mode[j] == VOLTAGE else 0.0

    def _sag(self) -> None:
        """Supply minus the drop over the shared resistance; a bridge draws duty x motor current."""
        drawn_A = sum(self.voltage_V(j) / w.supply_V * self.current_A(j) for j, w in enumerate(self._windings))
        for j in range(len(self._windings)):
            self.supply_V[j] = max(0.0, self._no_load_V[j] - self._supply_ohm * drawn_A)

    def _settle(self, j: int, speed_rad_s: float) -> None:
        winding, mode, value = self._windings[j], self._mode[j], self._command[j]
        if mode == OPEN:
            self.is_clamped[j] = False
            if self._set_as[j] != OPEN:
                self._set(j, OPEN, _OPEN_OHM, winding)
                self._act[self._current_at[j]] = 0.0
            self._ctrl[self._index[j]] = 0.0
            return
        supply_V = self.supply_V[j]
        emf_V = winding.K_V_s_rad * speed_rad_s
        limit_A = self._limit_A[j]
        if mode == VOLTAGE:
            voltage = value * supply_V / winding.supply_V  # duty cycle of the bridge
            voltage = min(max(voltage, -supply_V), supply_V)
            wanted_A = (voltage - emf_V) / winding.resistance_ohm
            if -limit_A <= wanted_A <= limit_A:
                self.is_clamped[j] = False
                if self._set_as[j] != VOLTAGE:
                    self._set(j, VOLTAGE, winding.resistance_ohm, winding)
                self._ctrl[self._index[j]] = voltage
                return
            value = wanted_A
        current = self._feasible_A(value, emf_V, supply_V, limit_A, winding)
        self.is_clamped[j] = current != value
        if self._set_as[j] != CURRENT:
            self._set(j, CURRENT, _SOURCE_OHM, winding)
        self._ctrl[self._index[j]] = current * _SOURCE_OHM

    @staticmethod
    def _feasible_A(value: float, emf_V: float, supply_V: float, limit_A: float, winding: Winding) -> float:
        """The current nearest to `value` within the limit and with |R i + K w| <= supply."""
        value = min(max(value, -limit_A), limit_A)
        lower_A = (-supply_V - emf_V) / winding.resistance_ohm
        upper_A = (supply_V - emf_V) / winding.resistance_ohm
        return min(max(value, lower_A), upper_A)

    def _set(self, j: int, mode: int, resistance_ohm: float, winding: Winding) -> None:
        k = self._index[j]
        self._gain[k, 0] = resistance_ohm
        self._dynamics[k, 0] = CURRENT_LAG_S if mode == CURRENT else winding.inductance_H / winding.resistance_ohm
        self._set_as[j] = mode
