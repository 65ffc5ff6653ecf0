"""Torques of the rigid arm along every run, and their derivatives by what may be hidden in it.

Link torques are without rotors: what the gear has to transmit when motor and link move as one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from calib.arrays import Array
from calib.gap.signals.recording import EvenRun, RunSet
from calib.gap.signals.staircase import Windings
from control.dynamics.dynamics import Dynamics
from control.model.arm import Arm

SLOPE_rad = 1e-4
TORQUES_KEPT = 24
INERTIA_EVERY = 25  # samples: how heavy an arm is, on the whole
SAME_kg = 1e-6  # payloads
LIGHTEST_kg_m2 = (
    1e-7  # of a link: one that the file gives no inertia follows at once, and nothing is divided by nought
)


@dataclass(frozen=True, slots=True)
class Load:
    """What the arm carries beyond its file: at the tip, and by link (0-based) as mass or as inertia."""

    payload_kg: float = 0.0
    mass_kg: tuple[tuple[int, float], ...] = ()
    inertia_kg_m2: tuple[tuple[int, float], ...] = ()


class BodyTorques:
    """Rigid-body torques of one arm on one recording."""

    def __init__(self, arm: Arm, recording: RunSet) -> None:
        self._arm, self._recording = _with_inertia(arm), recording
        self._loaded: dict[Load, Dynamics] = {}
        self._torques: dict[Load, list[Array]] = {}
        self.rotor_kg_m2 = np.array([d.gear_ratio**2 * d.rotor_inertia_kg_m2 for d in arm.drives])
        self.links = [k for k, link in enumerate(arm.links) if link.mass_kg and link.com_m is not None]

    def link_torques(self, load: Load) -> list[Array]:
        """Torques (m, n) of each run, motor and link moving as one; kept for the loads seen last."""
        if load not in self._torques:
            if len(self._torques) > TORQUES_KEPT:
                self._torques.clear()
            runs = self._recording.runs
            self._torques[load] = [self.moved(load, r, r.q, r.speed, r.acceleration) for r in runs]
        return self._torques[load]

    def moved(self, load: Load, run: EvenRun, q: Array, speed: Array, acceleration: Array) -> Array:
        """Link torques (m, n) of one run for another motion of the links."""
        dynamics = self.dynamics(load)
        payload = np.maximum(run.payload_kg + load.payload_kg, 0.0)
        return dynamics.torques(q, speed, acceleration, payload) - self.rotor_kg_m2 * acceleration

    def own_inertia(self, load: Load, joint: int) -> list[Array]:
        """What joint `joint` (0-based) turns: the mass matrix's diagonal without the rotor, (m,) of each run."""
        return [self._push(load, run, joint) for run in self._recording.runs]

    def windings(self) -> list[Windings]:
        """The motors and what they turn, of each run; runs of one payload share theirs, in the middle of all their poses."""
        drives, runs = self._arm.drives, self._recording.runs
        K = np.array([d.torque_constant_Nm_A * d.gear_ratio for d in drives])
        R = np.array([d.resistance_ohm for d in drives])
        lag = np.array([d.inductance_H / d.resistance_ohm for d in drives])
        carried = [round(float(np.median(run.payload_kg)) / SAME_kg) for run in runs]
        found = {}
        for load in dict.fromkeys(carried):
            q = np.concatenate(
                [run.q[::INERTIA_EVERY] for run, own in zip(runs, carried, strict=True) if own == load]
            )
            found[load] = Windings(self._inertia(q, load * SAME_kg), K, R, lag)
        return [found[load] for load in carried]

    def _inertia(self, q: Array, payload_kg: float) -> Array:
        """The mass matrix with rotors (n, n) in the middle of poses (m, n)."""
        still, dynamics = np.zeros_like(q), self.dynamics(Load())
        payload = np.full(len(q), payload_kg)
        held = dynamics.gravities(q, payload)
        columns = [dynamics.torques(q, still, still + axis, payload) - held for axis in np.eye(q.shape[1])]
        return np.asarray(np.linalg.inv(np.linalg.inv(np.stack(columns, axis=2)).mean(axis=0)))

    def gravity_slope(self, load: Load, joint: int) -> list[Array]:
        """How the joint's torque grows with its own angle [N m/rad], (m,) of each run."""
        result = []
        for run in self._recording.runs:
            ahead = np.array(run.q)
            ahead[:, joint] += SLOPE_rad
            here = self.moved(load, run, run.q, run.speed, run.acceleration)
            there = self.moved(load, run, ahead, run.speed, run.acceleration)
            result.append((there - here)[:, joint] / SLOPE_rad)
        return result

    def _push(self, load: Load, run: EvenRun, joint: int) -> Array:
        pushed = np.array(run.acceleration)
        pushed[:, joint] += 1.0
        with_push = self.moved(load, run, run.q, run.speed, pushed)
        return np.asarray((with_push - self.moved(load, run, run.q, run.speed, run.acceleration))[:, joint])

    def dynamics(self, load: Load) -> Dynamics:
        """The arm that carries this, but for a payload at its tip."""
        key = dataclasses.replace(load, payload_kg=0.0)
        if key not in self._loaded:
            if len(self._loaded) > 40:
                self._loaded.clear()
            self._loaded[key] = Dynamics(_loaded(self._arm, load))
        return self._loaded[key]


def _with_inertia(arm: Arm) -> Arm:
    """The arm with at least the lightest inertia about every axis of every link that has any."""
    links = []
    for link in arm.links:
        if link.inertia_kg_m2 is not None:
            x, y, z = (max(own, LIGHTEST_kg_m2) for own in link.inertia_kg_m2)
            links.append(dataclasses.replace(link, inertia_kg_m2=(x, y, z)))
        else:
            links.append(link)
    return dataclasses.replace(arm, links=tuple(links))


def _loaded(arm: Arm, load: Load) -> Arm:
    links = list(arm.links)
    for k, mass in load.mass_kg:
        links[k] = dataclasses.replace(links[k], mass_kg=(links[k].mass_kg or 0.0) + mass)
    for k, inertia in load.inertia_kg_m2:
        x, y, z = links[k].inertia_kg_m2 or (0.0, 0.0, 0.0)
        links[k] = dataclasses.replace(links[k], inertia_kg_m2=(x + inertia, y + inertia, z + inertia))
    return dataclasses.replace(arm, links=tuple(links))
