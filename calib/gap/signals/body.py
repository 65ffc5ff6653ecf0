"""Torques of the rigid arm along every run, and their derivatives by what may be hidden in it.

Link torques are without rotors: what the gear has to transmit when motor and link move as one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.arrays import Array
from calib.gap.signals.recording import EvenRun, RunSet
from calib.gap.signals.staircase import Windings
from calib.gap.signals.terms import Law
from control.dynamics.dynamics import Dynamics
from control.model.arm import Arm

SLOPE_rad = 1e-4
TORQUES_KEPT = 24
INERTIA_EVERY = 25  # samples: how heavy an arm is, on the whole
SAME_kg = 1e-6  # payloads
LIGHTEST_kg_m2 = 1e-7  # of a link: one that the file gives no inertia follows at once, and nothing is divided by nought


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
        return [
            self._ahead(load, run, joint, run.q, run.acceleration + np.eye(run.q.shape[1])[joint]) for run in self._recording.runs
        ]

    def windings(self) -> list[Windings]:
        """The motors and what they turn, of each run; runs of one payload share theirs, in the middle of all their poses."""
        drives, runs = self._arm.drives, self._recording.runs
        K = np.array([d.torque_constant_Nm_A * d.gear_ratio for d in drives])
        R = np.array([d.resistance_ohm for d in drives])
        lag = np.array([d.lag_s for d in drives])
        carried = [round(float(np.median(run.payload_kg)) / SAME_kg) for run in runs]
        found = {}
        for load in dict.fromkeys(carried):
            q = np.concatenate([run.q[::INERTIA_EVERY] for run, own in zip(runs, carried, strict=True) if own == load])
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
        step = SLOPE_rad * np.eye(self._arm.joint_count)[joint]
        return [self._ahead(load, run, joint, run.q + step, run.acceleration) / SLOPE_rad for run in self._recording.runs]

    def _ahead(self, load: Load, run: EvenRun, joint: int, q: Array, acceleration: Array) -> Array:
        """How much more torque a joint has in another motion of a run, (m,)."""
        here = self.moved(load, run, run.q, run.speed, run.acceleration)
        return np.asarray((self.moved(load, run, q, run.speed, acceleration) - here)[:, joint])

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
    links = list(arm.links)
    for k, link in enumerate(links):
        if link.inertia_kg_m2 is not None:
            x, y, z = (max(own, LIGHTEST_kg_m2) for own in link.inertia_kg_m2)
            links[k] = dataclasses.replace(link, inertia_kg_m2=(x, y, z))
    return dataclasses.replace(arm, links=tuple(links))


def _loaded(arm: Arm, load: Load) -> Arm:
    links = list(arm.links)
    for k, mass in load.mass_kg:
        links[k] = dataclasses.replace(links[k], mass_kg=(links[k].mass_kg or 0.0) + mass)
    for k, inertia in load.inertia_kg_m2:
        x, y, z = links[k].inertia_kg_m2 or (0.0, 0.0, 0.0)
        links[k] = dataclasses.replace(links[k], inertia_kg_m2=(x + inertia, y + inertia, z + inertia))
    return dataclasses.replace(arm, links=tuple(links))


OF_TIP = ("beam", "geometry", "frame")


def is_seen_alone(term: Law) -> bool:
    """Whether a term changes what the camera sees and nothing else."""
    return term.form.acts in OF_TIP or term.form.where == "seen"


@dataclass(slots=True)
class ActingTerms:
    """Terms by where they act."""

    load: Load = field(default_factory=Load)
    scale: dict[int, float] = field(default_factory=dict)
    delay_s: float = 0.0
    sag: list[Law] = field(default_factory=list)
    friction: list[Law] = field(default_factory=list)
    elastic: list[Law] = field(default_factory=list)
    angles: list[Law] = field(default_factory=list)
    tip: list[Law] = field(default_factory=list)

    def add_gear(self, term: Law) -> None:
        """A gear is one: what a file has of its play or softness and what is found besides make one width, or one softness."""
        for k, gear in enumerate(self.elastic):
            if (gear.index, gear.form) == (term.index, term.form):
                both = zip(gear.values, term.values, strict=True)
                self.elastic[k] = gear.at(tuple(one + other for one, other in both))
                return
        self.elastic.append(term)

    def gears(self) -> dict[int, tuple[Law, ...]]:
        """What is soft or loose of each joint's gear (0-based), softness first: one gear, which may be both."""
        softness_first = sorted(self.elastic, key=lambda term: term.form.acts != "spring")
        found: dict[int, tuple[Law, ...]] = {}
        for term in softness_first:
            found[term.index] = (*found.get(term.index, ()), term)
        return found

    def link_friction(self, j: int) -> tuple[float, float]:
        """Coulomb and viscous friction of a joint (0-based) in all."""
        sums = {"coulomb": 0.0, "viscous": 0.0}
        for term in self.friction:
            if term.index == j and term.form.shared:
                sums[term.form.shared] += term.values[0]
        return max(sums["coulomb"], 0.0), max(sums["viscous"], 0.0)  # less than none drives

    def behind(self, term: Law) -> float:
        """The share of a friction that acts behind its elastic or loose gear."""
        if not term.form.shared:
            return 0.0
        return share_behind([gear for gear in self.elastic if gear.index == term.index])


def share_behind(gear: Sequence[Law]) -> float:
    """The share of friction that acts behind a gear, of all that is soft or loose in it."""
    return min(sum(term.values[-1] for term in gear), 1.0)


def sorted_terms(model: Sequence[Law]) -> ActingTerms:
    """A model's terms by where they act."""
    parts = ActingTerms()
    payload, masses, inertias = 0.0, [], []
    for term in model:
        match term.form.acts:
            case "payload":
                payload += term.values[0]
            case "mass":
                masses.append((term.index, term.values[0]))
            case "inertia":
                inertias.append((term.index, term.values[0]))
            case "torque constant":
                parts.scale[term.index] = parts.scale.get(term.index, 0.0) + term.values[0]
            case "delay":
                parts.delay_s += max(term.values[0], 0.0)
            case "sampling":  # a voltage that took effect before the sample is one that comes early
                parts.delay_s -= term.values[0]
            case "sag":
                parts.sag.append(term)
            case "spring" | "play":
                parts.add_gear(term)
            case "angle":
                parts.angles.append(term)
            case "motor":
                parts.friction.append(term)
            case _:
                parts.tip.append(term)
    parts.load = Load(payload, tuple(masses), tuple(inertias))
    return parts
