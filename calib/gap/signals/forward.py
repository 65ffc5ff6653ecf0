"""The model run forward: voltages in, motion out; rigid, elastic and loose joints, many recordings side by side.

    L di/dt + R i = u - K motor speed
    rigid joint:         (M + J) q'' = K i - friction - bias
    elastic or loose:    J motor'' = K i - friction - tau,    M q'' = tau - (friction behind the gear) - bias
with tau = k (motor - q) + d (motor' - q'), or that of the flank that the motor leans on. Symplectic Euler in steps of 0.4 ms;
a flank, and a spring stiffer than that, is as hard as the step carries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.signals.friction import friction_Nm
from calib.gap.signals.parts import sorted_terms
from calib.gap.signals.physics import Physics
from calib.gap.signals.recording import Flags
from calib.gap.signals.terms import Law

STEP_s = 0.0004
HARDEST = 0.25  # of inertia over step squared
FLANK_DAMPING = 0.7  # of critical


@dataclass(slots=True)
class ForwardState:
    """Angles, speeds and accelerations of the links, those of the motors at the joint, and currents: (W, n)."""

    q: Array
    speed: Array
    acceleration: Array
    motor: Array
    motor_speed: Array
    current_A: Array
    t_s: Array  # (W,), for laws that change with time


@dataclass(frozen=True, slots=True)
class _Motion:
    """What the laws of friction ask for."""

    q: Array
    speed: Array
    acceleration: Array
    t_s: Array


class Forward:
    """One model of the arm, for W motions at once that carry `payload_kg` (W,)."""

    def __init__(self, physics: Physics, model: Sequence[Law], payload_kg: Array) -> None:
        self._physics, self._parts, self._payload = physics, sorted_terms(model), payload_kg
        self._period = 1.0 / physics.recording.filters.rate_Hz
        self._steps = max(2, round(self._period / STEP_s))
        self._h = self._period / self._steps
        self._gears = {term.index: term for term in self._parts.elastic}
        self._rotor = physics.body.rotor_kg_m2
        self._own_rotor = np.array([0.0 if j in self._gears else J for j, J in enumerate(self._rotor)])
        self._rubbing = [
            (term, term.index, self._parts.behind(term), physics.gear_ratios[term.index])
            for term in self._parts.friction
        ]
        self._K = physics.torque_per_A * physics.scales(self._parts)

    @property
    def delay(self) -> tuple[int, float]:
        """Whole samples by which a voltage is late, and what of a sample beyond; one that comes early is taken as in time."""
        whole, within = divmod(max(self._parts.delay_s, 0.0), self._period)
        return int(whole), within

    def advance(self, state: ForwardState, newer_V: Array, older_V: Array, is_off: Flags) -> None:
        """One sample, in place: `older_V` until the delay's rest has passed, then `newer_V` (W, n)."""
        bias, inverse, mass = self._body(state)
        rigid = bias + np.einsum("wij,wj->wi", mass, state.acceleration)
        _, within = self.delay
        h = self._h
        for step in range(self._steps):
            voltage = older_V if (step + 0.5) * h < within else newer_V
            state.current_A = np.where(is_off, 0.0, self._current(state, voltage))
            transmitted = self._transmitted(state, inverse)
            load = rigid.copy()
            for j, torque in transmitted.items():
                load[:, j] = torque
            at_motor, behind = self._frictions(state, load)
            drive = self._K * state.current_A - at_motor
            pull = drive - bias
            for j, torque in transmitted.items():
                pull[:, j] = torque - behind[:, j] - bias[:, j]
            state.acceleration = np.einsum("wij,wj->wi", inverse, pull)
            state.speed = state.speed + h * state.acceleration
            state.q = state.q + h * state.speed
            motor_speed, motor = state.speed.copy(), state.q.copy()
            for j, torque in transmitted.items():
                own = (drive[:, j] - torque) / self._rotor[j]
                motor_speed[:, j] = state.motor_speed[:, j] + h * own
                motor[:, j] = state.motor[:, j] + h * motor_speed[:, j]
            state.motor_speed, state.motor = motor_speed, motor
        state.t_s = state.t_s + self._period

    def _current(self, state: ForwardState, voltage: Array) -> Array:
        physics = self._physics
        seen = physics.sagged(self._parts, voltage, state.current_A)
        target = (seen - self._K * state.motor_speed) / physics.resistance_ohm
        lag = np.maximum(physics.lag_s, 1e-9)
        return np.asarray(target + (state.current_A - target) * np.exp(-self._h / lag))

    def _transmitted(self, state: ForwardState, inverse: Array) -> dict[int, Array]:
        """Torque of each elastic or loose gear (W,)."""
        result = {}
        for j, term in self._gears.items():
            ahead = state.motor[:, j] - state.q[:, j]
            rate = state.motor_speed[:, j] - state.speed[:, j]
            inertia = 1.0 / (1.0 / self._rotor[j] + inverse[:, j, j])
            hardest = HARDEST * inertia / self._h**2
            if term.form.acts == "spring":
                stiffness = np.minimum(1.0 / max(term.values[0], 1e-9), hardest)
                result[j] = stiffness * ahead + max(term.values[1], 0.0) * rate
            else:
                half = 0.5 * max(term.values[0], 0.0)
                into = ahead - np.clip(ahead, -half, half)
                damping = 2.0 * FLANK_DAMPING * np.sqrt(hardest * inertia)
                torque = hardest * into + np.where(into != 0.0, damping * rate, 0.0)
                result[j] = np.where(into > 0.0, np.maximum(torque, 0.0), np.minimum(torque, 0.0))
        return result

    def _frictions(self, state: ForwardState, load_Nm: Array) -> tuple[Array, Array]:
        """At the motors, and behind the gears: (W, n) each."""
        at_motor, behind = np.zeros_like(load_Nm), np.zeros_like(load_Nm)
        motors = _Motion(state.motor, state.motor_speed, state.acceleration, state.t_s)
        links = _Motion(state.q, state.speed, state.acceleration, state.t_s)
        for term, j, share, ratio in self._rubbing:
            at_motor[:, j] += (1.0 - share) * friction_Nm(term, motors, j, load_Nm[:, j], ratio)
            if share > 0.0:
                behind[:, j] += share * friction_Nm(term, links, j, load_Nm[:, j], ratio)
        return at_motor, behind

    def _body(self, state: ForwardState) -> tuple[Array, Array, Array]:
        """Bias (W, n), inverse of the mass matrices with the rotors that turn with their links, those without rotors."""
        W, n = state.q.shape
        dynamics = self._physics.body.dynamics(self._parts.load)
        pushes = np.repeat(np.vstack([np.zeros((1, n)), np.eye(n)]), W, axis=0)
        carried = np.tile(np.maximum(self._payload + self._parts.load.payload_kg, 0.0), n + 1)
        found = dynamics.torques(
            np.tile(state.q, (n + 1, 1)), np.tile(state.speed, (n + 1, 1)), pushes, carried
        ).reshape(n + 1, W, n)
        mass = np.moveaxis(found[1:] - found[0], 0, 2) - np.diag(self._rotor)
        return found[0], np.linalg.inv(mass + np.diag(self._own_rotor)), mass


def begin(
    physics: Physics, model: Sequence[Law], runs: Sequence[int], samples: Sequence[int]
) -> ForwardState:
    """The measured states at these samples of these runs; behind elastic gears where they are simulated to be."""
    recording = physics.recording
    offsets, speeds = physics.following.beyond(model)
    pairs = list(zip(runs, samples, strict=True))

    def at(name: str) -> Array:
        return np.stack([getattr(recording.runs[k], name)[s] for k, s in pairs])

    motor, motor_speed = at("q"), at("speed")
    if recording.has_current:
        current = at("current_A")
    else:
        current = (at("voltage_V") - physics.torque_per_A * motor_speed) / physics.resistance_ohm
    ahead = np.stack([offsets[k][s] for k, s in pairs])
    faster = np.stack([speeds[k][s] for k, s in pairs])
    times = np.array([recording.runs[k].t_s[s] for k, s in pairs])
    return ForwardState(
        motor + ahead, motor_speed + faster, at("acceleration"), motor, motor_speed, current, times
    )
