"""Labelled time series with a hidden effect, simulated many at a time, for `benchmarks.gap.dynamic.score`.

`python -m benchmarks.gap.dynamic.cases OUT SEED EFFECT [--joint J]` writes OUT/{arm.toml,log.csv.gz,truth.json}.
EFFECT: `none`, an effect's name, several joined by `+`, or one that is in no list (`gap_dynamic_hidden.FOREIGN`).
"""

from __future__ import annotations

import argparse
import gzip
import json
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.gap.dynamic.hidden import NUMBERS, Hidden, hide, nominal
from benchmarks.gap.dynamic.plant import (
    Chain,
    FLANK_DAMPING_Nm_s_rad,
    FLANK_Nm_rad,
    Plant,
    Recorded,
    Simulation,
    _State,
    rnea,
    turned,
)

Array = npt.NDArray[np.float64]

SECONDS = 8.0
TOGETHER = 44  # cases simulated side by side: more costs memory, not time
GAINS = (60.0, 1.2, 100.0)  # V/rad, V s/rad, V/(rad s)
PAYLOAD_kg = 0.5
CURRENT_NOISE_A, CAMERA_NOISE_m, CAMERA_Hz = 0.01, 0.00014, 100
REFERENCE = Path(__file__).parents[3] / "control" / "arms" / "right.toml"


@dataclass(frozen=True, slots=True)
class Asked:
    """A case to be made: `effects` joined by `+`; `size` times the usual; a joint, or one by the seed."""

    seed: int
    effects: str
    joint: int | None = None
    size: float = 1.0
    rough: float = 0.0  # by how much laws depart from the textbook's, at most


@dataclass(frozen=True, slots=True)
class Conditions:
    """Common conditions of a batch of cases: sampling, noise, and the arm (torques and drives scaled)."""

    rate_Hz: int = 500
    seconds: float = SECONDS
    current_noise_A: float = CURRENT_NOISE_A
    sampled_late: int = 0  # physics steps (0.1 ms) after the voltage's change
    arm: Path = REFERENCE
    torque_share: float = 1.0


@dataclass(frozen=True, slots=True)
class Case:
    """An arm's file, one array (samples, columns as in the file after run) a run, and what is hidden."""

    asked: Asked
    arm_toml: str
    runs: tuple[Array, ...]
    truth: tuple[dict[str, Any], ...]


USUAL = Conditions()


def made(asked: Sequence[Asked], under: Conditions = USUAL) -> Iterator[Case]:
    """The cases, in order, a few dozen at a time."""
    for start in range(0, len(asked), TOGETHER):
        yield from _batch(asked[start : start + TOGETHER], under)


def _batch(asked: Sequence[Asked], under: Conditions) -> Iterator[Case]:
    text = under.arm.read_text(encoding="utf-8").split("[[effect]]")[0]
    arm = tomllib.loads(text)
    drafts = [_draft(one, arm, under) for one in asked]
    plant, sets, forward = _side_by_side(drafts, arm, under)
    if any(one.rough for one in asked):
        n = len(arm["drive"])
        shares = [
            drawn(np.random.default_rng(one.asked.seed + 5_000_000), n, one.asked.rough, {entry["joint"] for entry in one.truth})
            for one in drafts
        ]
        recorded = RoughSimulation(plant, sets, forward, side_by_side(shares, RUNS)).run()
    else:
        recorded = Simulation(plant, sets, forward).run()
    for k, draft in enumerate(drafts):
        places = slice(k * RUNS, (k + 1) * RUNS)
        yield _case(draft, text, recorded, places, sets[:, :, places], arm, under)


@dataclass(slots=True)
class _Draft:
    asked: Asked
    rng: np.random.Generator
    known: dict[str, Array]
    hidden: Hidden
    truth: tuple[dict[str, Any], ...]
    sets: list[Array]


def _draft(asked: Asked, arm: Mapping[str, Any], under: Conditions) -> _Draft:
    rng = np.random.default_rng(asked.seed)
    known = nominal(arm["drive"], rng, under.torque_share)
    hidden = Hidden({name: values.copy() for name, values in known.items()}, torque_share=under.torque_share)
    n = len(arm["drive"])
    drawn = int(rng.integers(1, n + 1))
    names = [name for name in asked.effects.split("+") if name != "none"]
    truth = []
    for place, name in enumerate(names):
        joint = asked.joint if asked.joint is not None and place == 0 else (drawn + place - 1) % n + 1
        truth.append(hide(name, joint, rng, hidden, asked.size))
    return _Draft(asked, rng, known, hidden, tuple(truth), set_points(rng, under.rate_Hz, under.seconds, n))


def _side_by_side(drafts: Sequence[_Draft], arm: Mapping[str, Any], under: Conditions) -> tuple[Plant, Array, Array]:
    """One plant of all cases' runs, set-points and feed-forward voltages (samples, n, B)."""
    chain = _chain(arm, RUNS * len(drafts))
    load = np.array([PAYLOAD_kg if k in LOADED else 0.0 for _ in drafts for k in range(RUNS)])
    sets = np.stack([run for draft in drafts for run in draft.sets], axis=2)
    forward = _forward(chain, sets, drafts, load, under.rate_Hz)
    whole = {
        name: np.repeat([draft.hidden.whole.get(name, 0.0) for draft in drafts], RUNS) for name in ("payload", "delay", "sag")
    }
    joints = {
        name: np.repeat(np.stack([draft.hidden.joints[name] for draft in drafts], axis=1), RUNS, axis=1) for name in NUMBERS
    }
    drive = arm["drive"][0]
    plant = Plant(
        _loaded(chain, drafts),
        joints,
        load + whole["payload"],
        whole["delay"],
        whole["sag"],
        drive["supply_V"],
        drive["current_limit_A"],
        GAINS,
        under.rate_Hz,
        under.sampled_late,
    )
    return plant, sets, forward


def _chain(arm: Mapping[str, Any], wide: int) -> Chain:
    """The arm as arm.toml has it, `wide` times side by side."""
    links, n = arm["link"], len(arm["drive"])
    dh = np.array([[link[key] for key in ("d_m", "theta_rad", "L_m", "alpha_rad")] for link in links])
    mass = np.repeat(np.array([[link["mass_kg"]] for link in links[:n]]), wide, axis=1)
    inertia = np.repeat(np.array([link["inertia_kg_m2"] for link in links[:n]])[:, :, None], wide, axis=2)
    com = np.array([link["com_m"] for link in links[:n]])
    return Chain(dh, com, mass, inertia, np.array(arm["gravity_m_s2"]))


def _loaded(chain: Chain, drafts: Sequence[_Draft]) -> Chain:
    """The chain with the masses and inertias that the cases hide."""
    mass, inertia = chain.mass.copy(), chain.inertia.copy()
    for k, draft in enumerate(drafts):
        places = slice(k * RUNS, (k + 1) * RUNS)
        for j, value in draft.hidden.mass_kg.items():
            mass[j, places] += value
        for j, value in draft.hidden.inertia_kg_m2.items():
            inertia[j, :, places] += value
    return replace(chain, mass=mass, inertia=inertia)


def _forward(chain: Chain, sets: Array, drafts: Sequence[_Draft], load: Array, rate_Hz: int) -> Array:
    """Voltages that the known model expects of the set-points."""
    known = {
        name: np.repeat(np.stack([draft.known[name] for draft in drafts], axis=1), RUNS, axis=1)
        for name in ("J", "K", "R", "C", "V")
    }
    samples, _, wide = sets.shape
    v = np.gradient(sets, 1.0 / rate_Hz, axis=0)
    a = np.gradient(v, 1.0 / rate_Hz, axis=0)
    gravity = np.repeat(chain.gravity[:, None], wide, axis=1)
    result = np.empty_like(sets)
    for s in range(samples):
        torque = rnea(chain, sets[s], v[s], a[s], gravity, load, chain.mass, chain.inertia)
        torque += known["J"] * a[s] + known["C"] * np.tanh(v[s] / 0.02) + known["V"] * v[s]
        result[s] = torque / known["K"] * known["R"] + known["K"] * v[s]
    return result


def _case(
    draft: _Draft, text: str, recorded: Recorded, places: slice, sets: Array, arm: Mapping[str, Any], under: Conditions
) -> Case:
    runs = tuple(_run(draft, k, recorded, places.start + k, sets, arm, under) for k in range(RUNS))
    return Case(draft.asked, text + _frictions(draft), runs, draft.truth)


def _run(draft: _Draft, k: int, recorded: Recorded, at: int, sets: Array, arm: Mapping[str, Any], under: Conditions) -> Array:
    """Run `k` of a case, which is run `at` of the plant, as log.csv has it: a row a sample."""
    encoder, joint, speed = (part[:, :, at].copy() for part in (recorded.encoder_rad, recorded.joint_rad, recorded.speed_rad_s))
    current, voltage = recorded.current_A[:, :, at].copy(), recorded.voltage_V[:, :, at]
    t = np.asarray((1.0 / under.rate_Hz) * np.arange(len(encoder)), dtype=np.float64)
    _sensed(draft, t, encoder, joint, speed, current)
    current += draft.rng.normal(0.0, under.current_noise_A, current.shape)
    tip = _tips(draft, joint, arm) + draft.rng.normal(0.0, CAMERA_NOISE_m, (len(t), 3))
    tip[np.arange(len(t)) % max(1, round(under.rate_Hz / CAMERA_Hz)) != 0] = np.nan
    load = np.full(len(t), PAYLOAD_kg if k in LOADED else 0.0)
    columns = [t, load, sets[:, :, k].round(6), encoder.round(7), current.round(4), voltage.round(4)]
    return np.column_stack([*columns, tip.round(6)])


def _sensed(draft: _Draft, t: Array, encoder: Array, joint: Array, speed: Array, current: Array) -> None:
    """Effects of joints, sensors and clocks beyond the plant's physics, in place."""
    for kind, j, value in draft.hidden.after:
        match kind:
            case "thermal_drift":
                joint[:, j] += value["final_rad"] * (1.0 - np.exp(-t / value["time_constant_s"]))
            case "slip":
                joint[len(t) // 2 :, j] += value["angle_rad"]
            case "tooth_ripple":
                joint[:, j] += value["amplitude_rad"] * np.sin(value["order"] * encoder[:, j])
            case "camera_delay":
                joint -= speed * value["delay_s"]
            case "time_jitter":
                late = draft.rng.uniform(-value["share"], value["share"], len(t)) * (t[1] - t[0])
                encoder += speed * late[:, None]
            case "sensor_gain":
                current[:, j] *= 1.0 + value["share"]
            case "sensor_curve":
                current[:, j] += value["cubic"] * current[:, j] ** 3
            case _:
                pass


def _tips(draft: _Draft, joint: Array, arm: Mapping[str, Any]) -> Array:
    """Tips measured by the camera, (m, 3)."""
    dh = np.array([[link[key] for key in ("d_m", "theta_rad", "L_m", "alpha_rad")] for link in arm["link"]])
    base = np.zeros(6)
    for kind, j, value in draft.hidden.after:
        if kind == "link_geometry":
            dh[j, 2] += value["L_m"]
        if kind == "base_frame":
            base[[0, 4]] = value["x_m"], value["ry_rad"]
    frame = tuple(np.repeat(axis[:, None], len(joint), axis=1) for axis in np.eye(3))
    origin, still = np.zeros((3, len(joint))), np.zeros(len(joint))
    for k, row in enumerate(dh):
        *new, r = turned(frame, row, joint[:, k] if k < joint.shape[1] else still)  # type: ignore[arg-type]
        frame, origin = tuple(new), origin + r
    tip = origin.T
    return np.asarray(tip - base[:3] - np.cross(base[3:], tip))  # in the camera's frame, which lies so in the arm's


def _frictions(draft: _Draft) -> str:
    lines = []
    for j in range(len(draft.known["C"])):
        for effect, key, name in (("coulomb_friction", "torque_Nm", "C"), ("viscous_friction", "coefficient_Nm_s_rad", "V")):
            value = draft.known[name][j]
            lines.append(f'[[effect]]\neffect = "{effect}"\njoint = {j + 1}\nparameters = {{ {key} = {value:.6f} }}\n\n')
    return "".join(lines)


def write(case: Case, out: Path) -> None:
    """Write one folder for `armwright gap`."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "arm.toml").write_text(case.arm_toml, encoding="utf-8")
    with gzip.open(out / "log.csv.gz", "wt", compresslevel=3) as file:
        file.write(_header(len(tomllib.loads(case.arm_toml)["drive"])) + "\n")
        for k, run in enumerate(case.runs):
            for row in run:
                cells = ("" if np.isnan(value) else f"{value:.7g}" for value in row)
                file.write(f"{k + 1},{','.join(cells)}\n")
    truth = json.dumps({"seed": case.asked.seed, "effects": case.truth}, indent=1)
    (out / "truth.json").write_text(truth, encoding="utf-8")


def _header(joints: int) -> str:
    kinds = (("q", "set_rad"), ("q", "rad"), ("i", "A"), ("u", "V"))
    columns = [f"{a}{j}_{b}" for a, b in kinds for j in range(1, joints + 1)]
    return ",".join(["run", "t_s", "payload_kg", *columns, "x_m", "y_m", "z_m"])


# Motions of the recordings of a scored case: slow, creeping, free, a sweep, small and fast, ramps.

MIDDLE_rad = (0.0, -0.6, 0.1)
LOADED = (6, 9)  # runs with 0.5 kg
RUNS = 11


def set_points(rng: np.random.Generator, rate_Hz: int, seconds: float, joints: int = 3) -> list[Array]:
    """Eleven runs (samples, joints); three of them are repeats, two are for a payload (`LOADED`)."""
    t = np.arange(int(seconds * rate_Hz)) / rate_Hz
    ease = _eased(np.clip(t, 0.0, 1.0))[:, None]
    middle = np.resize(MIDDLE_rad, joints)

    def waves(amplitude: float, low: float, high: float, count: int) -> Array:
        out = np.zeros((len(t), joints))
        for j in range(joints):
            for f in rng.uniform(low, high, count):
                out[:, j] += np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) / count
        return np.asarray(middle + amplitude * (out - out[0]) * ease)

    phase = 2 * np.pi * (0.2 * t + 0.5 * (2.6 - 0.2) / seconds * t**2)
    sweep = middle + 0.12 * np.sin(phase)[:, None] * ease * np.resize([1.0, 0.8, 1.0], joints)
    swing = _of_joints([0.24 * np.sin(0.8 * t), 0.35 * (np.cos(1.1 * t) - 1), 0.5 * np.sin(1.9 * t)], joints)
    slow = middle + swing * ease
    creep = middle + 0.055 * _of_joints([np.sin(1.2 * t), np.sin(1.0 * t), np.sin(1.4 * t)], joints) * ease
    free, other, third = (waves(0.75, 0.1, 0.7, 4) for _ in range(3))
    fast, up = waves(0.03, 2.0, 7.0, 5), _ramps(t, joints)
    return [slow, creep, free, sweep, fast, up, other, slow, third, up, free]


def _eased(x: Array) -> Array:
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


def _of_joints(three: list[Array], joints: int) -> Array:
    return np.stack([three[j % 3] for j in range(joints)], axis=1)


def _ramps(t: Array, joints: int) -> Array:
    s = (t % 4.0) / 2.0
    out = _eased(np.where(s < 1, s, 2 - s))[:, None]
    start = np.resize(MIDDLE_rad, joints) + np.resize([0.0, 0.3, -0.3], joints)
    return np.asarray(start + out * np.resize([0.6, -0.9, 0.9], joints))


# Parts that keep their law only roughly: all laws of a joint that hides something depart from the textbook's by a few per cent.
#
# A plant on top of `plant.Simulation`: friction whose level follows the angle, viscous friction that bends, load friction and
# gears that harden, play that is worn unevenly, cogging with a second harmonic, a torque constant that saturates, a disc with a
# second harmonic, Stribeck with another exponent.

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
            **p,
            "C": p["C"] * level,
            "asym": p["asym"] * level,
            "load": p["load"] * load,
            "V": p["V"] * (1.0 + s["bend"] * np.minimum(speed / SPEED_rad_s, 2.0)),
            "Fs": p["Fs"] * (1.0 + s["exponent"] * np.minimum(speed / p["vs"], 2.0)),
        }
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
        half = 0.5 * p["w"] * self._wave("play", state.motor)
        into = ahead - np.clip(ahead, -half, half)
        harder = 1.0 + s["gear"] * np.minimum(np.abs(p["k"] * into) / LOAD_Nm, 2.0)
        spring = p["k"] * harder * into + p["d"] * rate
        spring = np.where(self._has_play & (into * spring <= 0.0), 0.0, spring)
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
    return {name: np.repeat(np.stack([one[name] for one in shares], axis=1), runs, axis=1) for name in shares[0]}


def main() -> None:
    """Write one case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("seed", type=int)
    parser.add_argument("effects")
    parser.add_argument("--joint", type=int)
    parser.add_argument("--size", type=float, default=1.0, help="times the usual size")
    given = parser.parse_args()
    for case in made([Asked(given.seed, given.effects, given.joint, given.size)]):
        write(case, given.out)


if __name__ == "__main__":
    main()
