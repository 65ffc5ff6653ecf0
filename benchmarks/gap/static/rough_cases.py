"""Static cases with real parts: laws of hidden effects that deviate from the textbook's by a few per cent, several at once.

Based on benchmarks.gap.static.cases (arms made without this project's kinematics, dynamics and beams). Every law deviates in
its own way, drawn per case and joint: unevenly worn backlash, a stiffening gear, an eccentricity with a second and third
harmonic, a nonlinear scale and belt, a drift with two time constants, a tapered beam, a saturating motor.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from benchmarks.gap.static import physics as static_physics
from benchmarks.gap.static.cases import PARAMETER, Design, designed, drawn, drawn_design, drawn_foreign
from benchmarks.gap.static.physics import Hidden, Poses
from control.model.arm import Arm, Effect

LEAST, MOST = 0.04, 0.12  # of the law


@dataclasses.dataclass(frozen=True)
class Case:
    """A known arm, poses of the real one, and its hidden effects (totals if the file has a part)."""

    arm: Arm
    points: Any
    hidden: tuple[Any, ...]
    is_listed: bool = True


class Rough:
    """Deviations of one case, which replace the textbook laws while its poses are made."""

    def __init__(self, seed: int, most: float = MOST) -> None:
        self.rng = np.random.default_rng(seed + 77_000_000)
        self.most = most
        self.originals = dict(static_physics.JOINT_LAWS), static_physics.ahead_rad, static_physics._bent

    def share(self) -> float:
        """A random relative deviation."""
        return float(self.rng.uniform(LEAST, self.most) * self.rng.choice((-1.0, 1.0)))

    def __enter__(self) -> Rough:
        laws, rng = static_physics.JOINT_LAWS, self.rng

        def play(o: Hidden, p: Poses, j: int) -> np.ndarray:
            load = np.abs(p.transmitted[:, j])
            worn = 1.0 + self.share() * np.sin(rng.uniform(1, 2) * p.q[:, j] + rng.uniform(-3, 3))
            worn += 0.5 * self.share() * load / load.max()
            return np.asarray(-0.5 * o.value * np.sign(p.transmitted[:, j]) * worn)

        def gear(o: Hidden, p: Poses, j: int) -> np.ndarray:
            g = p.gravity[:, j]
            return np.asarray(-g / o.value * (1.0 + self.share() * np.abs(g) / np.abs(g).max()))

        def scale(o: Hidden, p: Poses, j: int) -> np.ndarray:
            q = p.q[:, j]
            nonlinear = self.share() * np.std(q) * 1.4 * np.sin(2.0 * q + rng.uniform(-3, 3))
            return np.asarray(o.value * (q + nonlinear))

        def wave(o: Hidden, p: Poses, j: int) -> np.ndarray:
            q = p.q[:, j]
            more = self.share() * np.sin(2 * q + rng.uniform(-3, 3)) + 0.5 * self.share() * np.sin(3 * q + rng.uniform(-3, 3))
            return np.asarray(o.value * (np.sin(q + o.more) + more))

        def drift(o: Hidden, p: Poses, j: int) -> np.ndarray:
            share, times = abs(self.share()), float(rng.choice((0.3, 3.0)))
            slow = 1.0 - np.exp(-p.t_s / (o.more * times))
            return np.asarray(o.value * ((1.0 - share) * (1.0 - np.exp(-p.t_s / o.more)) + share * slow))

        laws |= {
            "backlash": play,
            "joint_compliance": gear,
            "encoder_scale": scale,
            "encoder_eccentricity": wave,
            "thermal_drift": drift,
        }
        static_physics.ahead_rad = self._ahead_rad
        static_physics._bent = self._tapered_m
        return self

    def _ahead_rad(self, one: Hidden, at: Any, rig: Any) -> Any:
        """A slightly nonlinear belt; textbook laws otherwise."""
        if one.effect != "belt_coupling":
            return self.originals[1](one, at, rig)
        found, q = np.zeros_like(at.q), at.q[:, 1]
        found[:, 2] = one.value * (q + self.share() * 1.4 * np.std(q) * np.sin(2.0 * q + self.rng.uniform(-3, 3)))
        return found

    def _tapered_m(self, one: Hidden, at: Any, rig: Any, frames: Any, tip: Any, down: Any) -> Any:
        """A tapered beam: own weight, distal weight and payload see different EI."""
        bent = self.originals[2]
        whole = bent(one, at, rig, frames, tip, down)
        bare = bent(one, dataclasses.replace(at, payload=0.0 * at.payload), rig, frames, tip, down)
        return whole + self.share() * (whole - bare) + 0.5 * self.share() * bare

    def __exit__(self, *_: object) -> None:
        static_physics.JOINT_LAWS.update(self.originals[0])
        static_physics.ahead_rad = self.originals[1]
        static_physics._bent = self.originals[2]


def several(rng: np.random.Generator, count: int, among: tuple[str, ...] | None = None) -> tuple[Any, ...]:
    """Different effects, or the same on different joints."""
    found: dict[tuple[str, int | None], Any] = {}
    while len(found) < count:
        one = drawn(rng) if among is None else drawn(rng, among)
        found[(one.effect, one.joint)] = one
    return tuple(found.values())


def known_half(one: Any, share: float) -> Effect:
    """The effect as in the file: partly right."""
    value = one.value / share if one.effect in ("joint_compliance", "link_flexure") else one.value * share
    parameters = {PARAMETER[one.effect]: value}
    if one.effect == "encoder_eccentricity":
        parameters["phase_rad"] = one.more
    return Effect(one.effect, one.joint, parameters)


KNOWABLE = ("backlash", "joint_compliance", "encoder_scale", "encoder_eccentricity", "belt_coupling")
ON_TIP = (
    "backlash",
    "joint_compliance",
    "encoder_scale",
    "encoder_eccentricity",
    "belt_coupling",
    "thermal_drift",
    "link_flexure",
    "base_frame",
)


def _made(seed: int, hidden: tuple[Any, ...], design: Any) -> Case:
    arm, points = designed(seed, hidden, design)
    return Case(arm, points, hidden)


def case(sort: str, seed: int) -> Case:
    """One case: exact, rough, many (three to six, rough), null, foreign, known (partly right, exact law)."""
    rng = np.random.default_rng(seed)
    if sort == "null":
        return _made(seed, (), drawn_design(rng))
    if sort == "foreign":
        hidden = (drawn_foreign(rng),)
        return dataclasses.replace(_made(seed, hidden, Design()), is_listed=False)
    if sort == "exact":
        hidden = (drawn(rng),)
        return _made(seed, hidden, Design())
    if sort == "known":
        hidden = (drawn(rng, KNOWABLE),)
        arm, points = designed(seed, hidden, Design())
        return Case(dataclasses.replace(arm, effects=(known_half(hidden[0], float(rng.uniform(0.3, 0.8))),)), points, hidden)
    hidden = (drawn(rng),) if sort == "rough" else several(rng, int(rng.integers(3, 7)), ON_TIP)
    with Rough(seed, 0.08 if sort == "rough" else 0.10):
        return _made(seed, hidden, Design())


__all__ = ["PARAMETER", "Case", "Hidden", "case"]
