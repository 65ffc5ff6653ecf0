"""Independent physics for scoring the gap workflow: many recordings of an arm at once, in numpy.

Shares nothing with the product: Newton-Euler in the base frame, LuGre friction at the motors, windings with
inductance, stiff contacts for play, 10 kHz. Every array's last axis is the recordings (B), so that a step costs the
same for one recording as for two hundred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

PHYSICS_Hz = 10_000
REFRESH = 8  # physics steps for which mass matrix and bias are kept
BRISTLE_Nm_rad, BRISTLE_DAMPING_Nm_s_rad, BRISTLE_SPEED_rad_s = 15_000.0, 2.0, 0.005
FLANK_Nm_rad, FLANK_DAMPING_Nm_s_rad = 2e4, 12.0
SMALLEST_FRICTION_Nm = 1e-3


@dataclass(frozen=True, slots=True)
class Chain:
    """Rigid body: dh (links, 4) standard; com (n, 3), mass (n, B), inertia (n, 3, B) of the moving links; g (3,)."""

    dh: Array
    com: Array
    mass: Array
    inertia: Array
    gravity: Array


@dataclass(frozen=True, slots=True)
class Plant:
    """The plant of B recordings, without their motions.

    `joints`: parameters (n, B) by name (`gap_dynamic_hidden` says which); payload_kg, delay_s, sag_ohm (B,).
    """

    chain: Chain
    joints: Mapping[str, Array]
    payload_kg: Array
    delay_s: Array
    sag_ohm: Array
    supply_V: float
    current_limit_A: float
    gains: tuple[float, float, float]
    rate_Hz: int
    sampled_late: int = 0  # physics steps after the new voltage at which angles and currents are read


@dataclass(slots=True)
class Recorded:
    """(samples, n, B): encoder angles, joint angles, their speeds, currents, commanded voltages."""

    encoder_rad: Array
    joint_rad: Array
    speed_rad_s: Array
    current_A: Array
    voltage_V: Array
    transmitted_Nm: Array


def cross(a: Array, b: Array) -> Array:
    """Cross product of (3, B) arrays, by rows y z x and z x y of each; np.cross is thirty times slower."""
    a, b = np.concatenate((a, a[:2])), np.concatenate((b, b[:2]))
    return np.asarray(a[1:4] * b[2:] - a[2:] * b[1:4])


def dot(a: Array, b: Array) -> Array:
    """Scalar products (B,) of (3, B) arrays; np.sum is twice as slow."""
    parts = a * b
    return np.asarray(parts[0] + parts[1] + parts[2])


def turned(frame: tuple[Array, Array, Array], row: Array, angle: Array) -> tuple[Array, Array, Array, Array]:
    """The next DH frame's axes, and the way to its origin; `angle` (B,) is added to the row's theta."""
    x, y, z = frame
    d, theta, length, alpha = row
    c, s, ca, sa = np.cos(theta + angle), np.sin(theta + angle), np.cos(alpha), np.sin(alpha)
    along = x * c + y * s
    across = y * c - x * s
    return along, across * ca + z * sa, z * ca - across * sa, along * length + z * d


def rnea(chain: Chain, q: Array, qd: Array, qdd: Array, gravity: Array, payload: Array, mass: Array, inertia: Array) -> Array:
    """Joint torques (n, B) in the base frame; links of `dh` beyond the joints are fixed and end at the tip."""
    n, wide = q.shape
    frame = tuple(np.repeat(axis[:, None], wide, axis=1) for axis in np.eye(3))
    w, al, a = np.zeros((3, wide)), np.zeros((3, wide)), -gravity
    origin, axes, origins, forces, moments = np.zeros((3, wide)), [], [], [], []
    for i in range(n):
        z = frame[2]
        axes.append(z)
        origins.append(origin)
        al = al + z * qdd[i] + cross(w, z) * qd[i]
        w = w + z * qd[i]
        *new, r = turned(frame, chain.dh[i], q[i])  # type: ignore[arg-type]
        frame = tuple(new)
        origin = origin + r
        a = a + cross(al, r) + cross(w, cross(w, r))
        to_com = sum(axis * part for axis, part in zip(frame, chain.com[i], strict=True))
        force = mass[i] * (a + cross(al, to_com) + cross(w, cross(w, to_com)))
        turning = _inertial(frame, inertia[i], al) + cross(w, _inertial(frame, inertia[i], w))
        forces.append(force)
        moments.append(turning + cross(origin + to_com, force))
    to_tip = np.zeros((3, wide))
    for row in chain.dh[n:]:
        *new, r = turned(frame, row, np.zeros(wide))  # type: ignore[arg-type]
        frame = tuple(new)
        to_tip = to_tip + r
    load = payload * (a + cross(al, to_tip) + cross(w, cross(w, to_tip)))
    forces[-1] = forces[-1] + load
    moments[-1] = moments[-1] + cross(origin + to_tip, load)
    result = np.empty((n, wide))
    force, moment = np.zeros((3, wide)), np.zeros((3, wide))
    for i in range(n - 1, -1, -1):
        force, moment = force + forces[i], moment + moments[i]
        result[i] = dot(axes[i], moment - cross(origins[i], force))
    return result


def _inertial(frame: tuple[Array, ...], inertia: Array, vector: Array) -> Array:
    parts = [axis * (value * dot(axis, vector)) for axis, value in zip(frame, inertia, strict=True)]
    return np.asarray(parts[0] + parts[1] + parts[2])


class _Body:
    """Mass matrix and bias of all recordings, in one call of the recursion."""

    def __init__(self, plant: Plant, n: int, wide: int) -> None:
        self._chain, self._n, self._wide = plant.chain, n, wide
        times = n + 1
        self._mass = np.tile(plant.chain.mass, times)
        self._inertia = np.tile(plant.chain.inertia, times)
        self._payload = np.tile(plant.payload_kg, times)
        self._gravity = np.zeros((3, times * wide))
        self._gravity[:, :wide] = plant.chain.gravity[:, None]
        self._unit = np.zeros((n, times * wide))
        for j in range(n):
            self._unit[j, (j + 1) * wide : (j + 2) * wide] = 1.0

    def at(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """(n, n, B) and (n, B)."""
        speed = np.zeros_like(self._unit)
        speed[:, : self._wide] = qd
        found = rnea(
            self._chain, np.tile(q, self._n + 1), speed, self._unit, self._gravity, self._payload, self._mass, self._inertia
        ).reshape(self._n, self._n + 1, self._wide)
        return found[:, 1:], found[:, 0]


def inverse(matrices: Array) -> Array:
    """Inverses of (n, n, B)."""
    return np.asarray(np.moveaxis(np.linalg.inv(np.moveaxis(matrices, 2, 0)), 0, 2), dtype=np.float64)


@dataclass(slots=True)
class _State:
    q: Array
    qd: Array
    motor: Array
    motor_speed: Array
    current: Array
    bristle: Array
    transmitted: Array
    acceleration: Array


class Simulation:
    """B recordings in parallel: from (samples, n, B) set-points and feed-forward voltages to sensor values."""

    def __init__(self, plant: Plant, sets: Array, forward_V: Array) -> None:
        self._plant, self._sets, self._forward = plant, sets, forward_V
        self._n, self._wide = sets.shape[1:]
        self._body = _Body(plant, self._n, self._wide)
        p = plant.joints
        self._p = p
        self._has_spring, self._has_play = p["k"] > 0, p["w"] > 0
        self._is_apart = self._has_spring | self._has_play
        self._some_are_apart = bool(np.any(self._is_apart))
        self._used = {name for name, values in p.items() if np.any(values != 0.0)}
        self._h = 1.0 / PHYSICS_Hz
        self._K, self._R = p["K"] * (1 + p["scale"]), p["R"] * (1 + p["res"])
        self._settles = np.exp(-self._h * self._R / (p["L"] * (1 + p["ind"])))
        self._stiff = np.where(p["soft"] > 0, p["soft"], BRISTLE_Nm_rad)
        self._delay = np.round(plant.delay_s * PHYSICS_Hz).astype(int)
        self._late = int(self._delay.max()) + 1

    def run(self) -> Recorded:
        """The whole of it."""
        samples, n, wide = self._sets.shape
        out = Recorded(*(np.empty((samples, n, wide)) for _ in range(6)))
        state = self._begin()
        command = state.current * self._p["R"]
        queue = np.repeat(command[None], self._late, axis=0)
        integral, before = np.zeros((n, wide)), state.motor.copy()
        every = np.arange(wide)
        step = 0
        for s in range(samples):
            share = s / samples
            for sub in range(PHYSICS_Hz // self._plant.rate_Hz):
                if sub == 0:
                    command, before = self._commanded(s, state, before, integral)
                    out.voltage_V[s] = command
                if sub == self._plant.sampled_late:
                    self._sampled(out, s, state)
                queue[step % self._late] = command
                applied = queue[(step - self._delay) % self._late, :, every].T
                if step % REFRESH == 0:
                    mass, bias = self._body.at(state.q, state.qd)
                    rigid = np.where(self._is_apart, 0.0, self._p["J"])
                    whole = mass + rigid[:, None, :] * np.eye(n)[:, :, None]
                    inverted = inverse(whole)
                step += 1
                self._advance(state, applied, inverted, bias, share)
        return out

    def _begin(self) -> _State:
        p, q = self._p, self._sets[0].copy()
        still = np.zeros_like(q)
        held = self._body.at(q, still)[1]
        motor = q.copy()
        if self._some_are_apart:
            yields = np.where(self._has_spring, held / np.where(self._has_spring, p["k"], 1.0), 0.0)
            hard = np.where(self._has_spring, 0.0, held / FLANK_Nm_rad)
            rests = np.where(self._has_play, np.sign(held) * p["w"] / 2 + hard, 0.0)
            q = q - yields - rests
        current = held / self._K
        return _State(q, still.copy(), motor, still.copy(), current, still.copy(), held.copy(), still.copy())

    def _commanded(self, s: int, state: _State, before: Array, integral: Array) -> tuple[Array, Array]:
        """The controller uses only the encoders; `integral` is updated in place."""
        p, rate = self._p, self._plant.rate_Hz
        seen = self._encoder(state)
        error = self._sets[s] - seen
        speed = (seen - before) * rate
        wanted = (self._sets[min(s + 1, len(self._sets) - 1)] - self._sets[s]) * rate
        integral += error / rate
        kp, kd, ki = self._plant.gains
        voltage = self._forward[s] + kp * error + kd * (wanted - speed) + ki * integral
        room, emf = self._plant.current_limit_A * p["R"], p["K"] * speed
        voltage = np.minimum(np.maximum(voltage, emf - room), emf + room)
        return np.minimum(np.maximum(voltage, -self._plant.supply_V), self._plant.supply_V), seen

    def _encoder(self, state: _State) -> Array:
        """Counter values: with an eccentric disc, another number of lines, or a belt coupling."""
        p, angle = self._p, state.motor
        seen = angle / (1 + p["enc_scale"])
        if "ecc_A" in self._used:
            for _ in range(3):
                seen = (angle - p["ecc_A"] * np.sin(seen + p["ecc_phi"])) / (1 + p["enc_scale"])
        if "belt" in self._used and self._n > 2:
            seen = seen.copy()
            seen[2] -= p["belt"][2] * angle[1]
        count = 2.0 * np.pi / (p["counts"] * p["ratio"])
        return np.round(seen / count) * count

    def _sampled(self, out: Recorded, s: int, state: _State) -> None:
        out.encoder_rad[s] = self._encoder(state)
        out.joint_rad[s], out.speed_rad_s[s] = state.q, state.qd
        out.current_A[s], out.transmitted_Nm[s] = state.current, state.transmitted

    def _advance(self, state: _State, applied: Array, inverted: Array, bias: Array, share: float) -> None:
        """One step of the physics, in place."""
        h, p = self._h, self._p
        torque = self._motor_torque(state, applied) - self._opposing(state, share)
        load = torque
        if self._some_are_apart:
            state.transmitted = np.where(self._is_apart, self._gear(state), state.transmitted)
            load = np.where(self._is_apart, state.transmitted, torque)
        acceleration = np.einsum("ijb,jb->ib", inverted, load - bias)
        state.qd = state.qd + h * acceleration
        state.q = state.q + h * state.qd
        if not self._some_are_apart:
            state.acceleration, state.motor, state.motor_speed = acceleration, state.q, state.qd
            state.transmitted = torque - p["J"] * acceleration
            return
        own = np.where(self._is_apart, (torque - state.transmitted) / p["J"], acceleration)
        state.transmitted = np.where(self._is_apart, state.transmitted, torque - p["J"] * acceleration)
        speed = np.where(self._is_apart, state.motor_speed + h * own, state.qd)
        state.motor = np.where(self._is_apart, state.motor + h * speed, state.q)
        state.motor_speed, state.acceleration = speed, own

    def _motor_torque(self, state: _State, applied: Array) -> Array:
        """Winding and magnets; the current settles exactly within a step."""
        p, h, K = self._p, self._h, self._K
        supply = self._plant.supply_V
        drawn = np.sum(applied / supply * state.current, axis=0)
        volt = applied * (1.0 - self._plant.sag_ohm * drawn / supply)
        if "dead" in self._used:
            volt = volt - p["dead"] * np.tanh(state.current / 0.05)
        if "ripple" in self._used:
            K = K * (1 + p["ripple"] * np.sin(p["ripple_n"] * p["ratio"] * state.motor))
        target = (volt - K * (state.motor_speed + h * state.acceleration)) / self._R
        state.current = target + (state.current - target) * self._settles
        if "droop" in self._used:
            K = K * (1 - p["droop"] * np.abs(state.current))
        return K * state.current

    def _opposing(self, state: _State, share: float) -> Array:
        """Motor-side friction (LuGre, implicit), cogging, and unlisted effects."""
        p, h, used = self._p, self._h, self._used
        speed, angle = state.motor_speed, state.motor
        way = np.where(speed >= 0, 1.0, -1.0)
        level = p["C"] + p["asym"] * way
        if "load" in used:
            level = level + p["load"] * np.abs(state.transmitted)
        if "driving" in used:
            level = level + p["driving"] * np.maximum(state.transmitted * way, 0.0)
        if "Fs" in used:
            level = level + p["Fs"] * np.exp(-((speed / p["vs"]) ** 2))
        if "posf" in used:
            level = level + p["posf"] * np.sin(2 * angle) ** 2
        if "sector" in used:
            level = level + p["sector"] * np.exp(-(((angle - p["sector_at"]) / 0.15) ** 2))
        if "warm" in used:
            level = level + p["warm"] * share
        level = np.maximum(level, SMALLEST_FRICTION_Nm)
        old, stiff = state.bristle, self._stiff
        state.bristle = (old + h * speed) / (1 + h * stiff * np.abs(speed) / level)
        damping = BRISTLE_DAMPING_Nm_s_rad * np.exp(-((speed / BRISTLE_SPEED_rad_s) ** 2))
        total = stiff * state.bristle + damping * (state.bristle - old) / h + p["V"] * speed
        return total + self._conservative(angle, speed)

    def _conservative(self, angle: Array, speed: Array) -> Array:
        p, used = self._p, self._used
        total = np.zeros_like(angle)
        if "cog_A" in used:
            total += p["cog_A"] * np.sin(p["cog_n"] * p["ratio"] * angle + p["cog_phi"])
        if "mesh_A" in used:
            total += p["mesh_A"] * np.sin(p["mesh_n"] * angle)
        if "drag" in used:
            total += p["drag"] * speed * np.abs(speed)
        if "cubic" in used:
            total += p["cubic"] * speed**3
        if "spring" in used:
            total += p["spring"] * angle
        if "cable" in used:
            total += p["cable"] * np.maximum(angle - p["cable_at"], 0.0)
        return total

    def _gear(self, state: _State) -> Array:
        """Torque of a spring, or of the contact flank; the spring of a loose gear stands on its flanks, and only pushes."""
        p = self._p
        ahead, rate = state.motor - state.q, state.motor_speed - state.qd
        half = 0.5 * p["w"]
        into = ahead - np.clip(ahead, -half, half)
        spring = p["k"] * into + p["d"] * rate
        spring = np.where(self._has_play & (into * spring <= 0.0), 0.0, spring)
        push = np.maximum(FLANK_Nm_rad * (ahead - half) + FLANK_DAMPING_Nm_s_rad * rate, 0.0)
        pull = np.minimum(FLANK_Nm_rad * (ahead + half) + FLANK_DAMPING_Nm_s_rad * rate, 0.0)
        flank = np.where(ahead > half, push, np.where(ahead < -half, pull, 0.0))
        return np.where(self._has_spring, spring, flank)
