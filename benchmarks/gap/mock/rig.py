"""The mock arm's physics under a joint controller, without boards and buses: a recording of minutes in seconds.

The plant is that of `hil_mocks.plant`; here it gets encoders that count, a controller at 500 Hz (the arm's own gains and the
model's torque as feed-forward), and sensors with noise. Hidden effects are added to those of arm.toml.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.arrays import Array
from control.dynamics.feedforward import torque_model
from control.dynamics.gains import gains_of
from control.model.arm import Arm
from hil_mocks.plant.build import PlantOptions
from hil_mocks.plant.effects import EffectEntry, PlantEffects, gather
from hil_mocks.plant.parts import parts_of
from hil_mocks.plant.plant import Plant

CONTROL_Hz = 500.0
STEP_S = 2.5e-4  # of the physics
CAMERA_NOISE_m = 0.00014
ADDED = ("coulomb_friction", "viscous_friction", "payload")  # added to those in arm.toml


def effects_with(arm: Arm, hidden: Sequence[EffectEntry]) -> PlantEffects:
    """The plant's effects: the file's own, and the hidden ones beyond them."""
    own = [EffectEntry(e.effect, e.joint or 0, e.parameters) for e in arm.effects]
    return gather([*own, *(_beyond(own, one) for one in hidden)], arm.joint_count, len(arm.links), "mock case")


def _beyond(own: Sequence[EffectEntry], one: EffectEntry) -> EffectEntry:
    for known in own:
        if (known.effect, known.joint) == (one.effect, one.joint) and one.effect in ADDED:
            total = {name: known.parameters[name] + value for name, value in one.parameters.items()}
            return replace(one, parameters=total)
    return one


@dataclass(frozen=True, slots=True)
class Trace:
    """What was measured at m samples, before each new voltage: (m, n) arrays, the true tip (m, 3)."""

    q_rad: Array
    current_A: Array
    voltage_V: Array
    tip_m: Array


@dataclass(frozen=True, slots=True)
class Reading:
    """Values at rest: encoders, currents without noise, the true tip, and the plant's time."""

    q_rad: tuple[float, ...]
    current_A: tuple[float, ...]
    tip_m: tuple[float, float, float]
    t_s: float


class MockRig:
    """One arm, from rest at a pose. `integral` off: it rests where friction stops it, without hunting.

    `pieces` of a control cycle: the plant fits friction under load once a piece.
    """

    def __init__(
        self,
        arm: Arm,
        effects: PlantEffects,
        start_rad: Sequence[float],
        payload_kg: float = 0.0,
        integral: bool = True,
        step_s: float = STEP_S,
        pieces: int = 1,
        link_share: float = 0.5,
        rate_Hz: float = CONTROL_Hz,
    ) -> None:
        self._arm, self._hidden_kg = arm, effects.payload_kg
        self._plant = Plant(parts_of(arm), effects, start_rad, PlantOptions(timestep_s=step_s, link_share=link_share))
        self._pieces, self._steps = pieces, round(1.0 / (rate_Hz * pieces * step_s))
        self._rate_Hz = rate_Hz
        gains = [gains_of(arm, j) for j in range(1, arm.joint_count + 1)]
        self._kp, self._kd = [g.kp for g in gains], [g.kd for g in gains]
        self._ki = [g.ki if integral else 0.0 for g in gains]
        self._constant = [d.gear_ratio * d.torque_constant_Nm_A for d in arm.drives]
        self._count = [2.0 * np.pi / (d.encoder_counts_per_rev * d.gear_ratio) for d in arm.drives]
        self.load(payload_kg)
        self._integral = [0.0] * arm.joint_count
        self._last = self._encoders()

    def load(self, payload_kg: float) -> None:
        """Set the mass at the tip; the controller knows it, but not the hidden effects."""
        self._plant.set_payload(payload_kg + self._hidden_kg)
        self._torques: Callable[..., tuple[float, ...]] = torque_model(self._arm, payload_kg)

    def follow(self, sets_rad: Array, has_tip: Sequence[int] = ()) -> Trace:
        """Follow set-points (m, n), one per cycle; the tip is measured only in the samples of `has_tip`."""
        speeds = np.gradient(sets_rad, 1.0 / self._rate_Hz, axis=0)
        accelerations = np.gradient(speeds, 1.0 / self._rate_Hz, axis=0).tolist()
        rows, looked = [], frozenset(has_tip)
        tips = np.full((len(sets_rad), 3), np.nan)
        for k, (wanted, speed) in enumerate(zip(sets_rad.tolist(), speeds.tolist(), strict=True)):
            q = self._encoders()
            if k in looked:
                tips[k] = self._plant.tip_m()
            current = self._plant.bridges.currents_A()
            voltage = self._voltages(q, wanted, speed, self._torques(wanted, speed, accelerations[k]))
            rows.append((q, current, voltage))
            for j, value in enumerate(voltage):
                self._plant.drive_voltage(j, value)
            for _ in range(self._pieces):
                self._plant.step(self._steps)
        q_rad, current_A, voltage_V = (np.array(column) for column in zip(*rows, strict=True))
        return Trace(q_rad, current_A, voltage_V, tips)

    def reading(self) -> Reading:
        """Read all values now."""
        plant = self._plant
        return Reading(tuple(self._encoders()), tuple(plant.bridges.currents_A()), plant.tip_m(), plant.time_s)

    def _encoders(self) -> list[float]:
        angles = self._plant.encoder_angles_rad()
        return [round(q / count) * count for q, count in zip(angles, self._count, strict=True)]

    def _voltages(
        self, q: Sequence[float], wanted: Sequence[float], speed: Sequence[float], torque: Sequence[float]
    ) -> list[float]:
        """PID and feed-forward, within supply and current limit."""
        voltages = []
        for j, drive in enumerate(self._arm.drives):
            error, constant = wanted[j] - q[j], self._constant[j]
            moving = (q[j] - self._last[j]) * self._rate_Hz
            self._integral[j] += self._ki[j] * error / self._rate_Hz
            voltage = torque[j] / constant * drive.resistance_ohm + constant * speed[j]
            voltage += self._kp[j] * error + self._kd[j] * (speed[j] - moving) + self._integral[j]
            room = drive.current_limit_A * drive.resistance_ohm
            voltage = min(max(voltage, constant * moving - room), constant * moving + room)
            voltages.append(min(max(voltage, -drive.supply_V), drive.supply_V))
        self._last = list(q)
        return voltages


def eased(start_rad: Array, end_rad: Array, duration_s: float, rate_Hz: float = CONTROL_Hz) -> Array:
    """Set-points (m, n) of a minimum-jerk move, without its start."""
    count = round(duration_s * rate_Hz)
    s = np.arange(1, count + 1) / count
    share = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    return np.asarray(start_rad + share[:, None] * (end_rad - start_rad))
