"""Parts that keep their law only roughly: all laws of a joint that hides something depart from the textbook's by a few per cent.

A plant on top of `plant.Simulation`: friction whose level follows the angle, viscous friction that bends, load friction and
gears that harden, play that is worn unevenly, cogging with a second harmonic, a torque constant that saturates, a disc with a
second harmonic, Stribeck with another exponent.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

from benchmarks.gap.dynamic.plant import (
    FLANK_DAMPING_Nm_s_rad,
    FLANK_Nm_rad,
    Plant,
    Simulation,
    _State,
)

Array = npt.NDArray[np.float64]
LEAST = 0.04
LOAD_Nm, CURRENT_A, SPEED_rad_s = 15.0, 4.0, 1.0  # at which a law departs by its whole share
SHARES = ("level", "bend", "load", "gear", "play", "wave", "constant", "disc", "exponent")


def drawn(rng: np.random.Generator, n: int, most: float, joints: Collection[int]) -> dict[str, Array]:
    """Departures of the laws of `joints` (n,), nought on the others, and the phases with which they follow the angle."""
    is_rough = np.array([j + 1 in joints for j in range(n)])
    found = {name: is_rough * rng.uniform(LEAST, most, n) * rng.choice([-1.0, 1.0], n) for name in SHARES}
    return found | {f"{name}_at": rng.uniform(-3.0, 3.0, n) for name in SHARES}


class RoughSimulation(Simulation):
    """A simulation whose laws depart by shares (n, B) of each recording."""

    def __init__(self, plant: Plant, sets: Array, forward_V: Array, shares: dict[str, Array]) -> None:
        super().__init__(plant, sets, forward_V)
        self._s = shares
        self._plain = dict(self._p)

    def _wave(self, name: str, angle: Array, harmonics: float = 2.0) -> Array:
        return np.asarray(1.0 + self._s[name] * np.sin(harmonics * angle + self._s[f"{name}_at"]))

    def _opposing(self, state: _State, share: float) -> Array:
        p, s = self._plain, self._s
        level = self._wave("level", state.motor)
        load = 1.0 + s["load"] * np.minimum(np.abs(state.transmitted) / LOAD_Nm, 2.0)
        speed = np.abs(state.motor_speed)
        self._p = {
            **p, "C": p["C"] * level, "asym": p["asym"] * level, "load": p["load"] * load,
            "V": p["V"] * (1.0 + s["bend"] * np.minimum(speed / SPEED_rad_s, 2.0)),
            "Fs": p["Fs"] * (1.0 + s["exponent"] * np.minimum(speed / p["vs"], 2.0)),
        }  # fmt: skip
        total = super()._opposing(state, share)
        self._p = p
        if "cog_A" in self._used:
            twice = 2.0 * (p["cog_n"] * p["ratio"] * state.motor + p["cog_phi"]) + s["wave_at"]
            total = total + s["wave"] * p["cog_A"] * np.sin(twice)
        return np.asarray(total)

    def _motor_torque(self, state: _State, applied: Array) -> Array:
        p = self._plain
        bend = 1.0 + self._s["constant"] * np.abs(state.current) / CURRENT_A
        self._p = {**p, "scale": p["scale"] * bend}
        torque = super()._motor_torque(state, applied)
        self._p = p
        return torque

    def _gear(self, state: _State) -> Array:
        p, s = self._plain, self._s
        ahead, rate = state.motor - state.q, state.motor_speed - state.qd
        harder = 1.0 + s["gear"] * np.minimum(np.abs(p["k"] * ahead) / LOAD_Nm, 2.0)
        spring = p["k"] * harder * ahead + p["d"] * rate
        half = 0.5 * p["w"] * self._wave("play", state.motor)
        push = np.maximum(FLANK_Nm_rad * (ahead - half) + FLANK_DAMPING_Nm_s_rad * rate, 0.0)
        pull = np.minimum(FLANK_Nm_rad * (ahead + half) + FLANK_DAMPING_Nm_s_rad * rate, 0.0)
        flank = np.where(ahead > half, push, np.where(ahead < -half, pull, 0.0))
        return np.where(self._has_spring, spring, flank)

    def _encoder(self, state: _State) -> Array:
        p, s = self._plain, self._s
        if "ecc_A" in self._used:
            more = s["disc"] * p["ecc_A"] * np.sin(2.0 * state.motor + s["disc_at"])
            self._p = {**p, "ecc_A": p["ecc_A"]}
            seen = super()._encoder(state) - more
            self._p = p
            return np.asarray(seen)
        return super()._encoder(state)


def side_by_side(shares: Sequence[dict[str, Array]], runs: int) -> dict[str, Array]:
    """Shares of several cases, each for all of its runs: (n, B)."""
    return {
        name: np.repeat(np.stack([one[name] for one in shares], axis=1), runs, axis=1) for name in shares[0]
    }
