"""Labelled time series with a hidden effect, simulated many at a time, for `benchmarks.gap.dynamic.score`.

`python -m benchmarks.gap.dynamic.cases OUT SEED EFFECT [--joint J]` writes OUT/{arm.toml,log.csv.gz,truth.json}.
EFFECT: `none`, an effect's name, several joined by `+`, or one that is in no list (`gap_dynamic_hidden.FOREIGN`).
"""

from __future__ import annotations

import argparse
import gzip
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.gap.dynamic.hidden import NUMBERS, Hidden, hide, nominal
from benchmarks.gap.dynamic.motions import LOADED, RUNS, set_points
from benchmarks.gap.dynamic.plant import Chain, Plant, Recorded, Simulation, rnea, turned
from benchmarks.gap.dynamic.rough import RoughSimulation, drawn, side_by_side

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
            drawn(
                np.random.default_rng(one.asked.seed + 5_000_000),
                n,
                one.asked.rough,
                {entry["joint"] for entry in one.truth},
            )
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


def _side_by_side(
    drafts: Sequence[_Draft], arm: Mapping[str, Any], under: Conditions
) -> tuple[Plant, Array, Array]:
    """One plant of all cases' runs, set-points and feed-forward voltages (samples, n, B)."""
    chain = _chain(arm, RUNS * len(drafts))
    load = np.array([PAYLOAD_kg if k in LOADED else 0.0 for _ in drafts for k in range(RUNS)])
    sets = np.stack([run for draft in drafts for run in draft.sets], axis=2)
    forward = _forward(chain, sets, drafts, load, under.rate_Hz)
    whole = {
        name: np.repeat([draft.hidden.whole.get(name, 0.0) for draft in drafts], RUNS)
        for name in ("payload", "delay", "sag")
    }
    joints = {
        name: np.repeat(np.stack([draft.hidden.joints[name] for draft in drafts], axis=1), RUNS, axis=1)
        for name in NUMBERS
    }
    drive = arm["drive"][0]
    plant = Plant(
        _loaded(chain, drafts), joints, load + whole["payload"], whole["delay"], whole["sag"],
        drive["supply_V"], drive["current_limit_A"], GAINS, under.rate_Hz, under.sampled_late,
    )  # fmt: skip
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
    draft: _Draft,
    text: str,
    recorded: Recorded,
    places: slice,
    sets: Array,
    arm: Mapping[str, Any],
    under: Conditions,
) -> Case:
    runs = tuple(_run(draft, k, recorded, places.start + k, sets, arm, under) for k in range(RUNS))
    return Case(draft.asked, text + _frictions(draft), runs, draft.truth)


def _run(
    draft: _Draft, k: int, recorded: Recorded, at: int, sets: Array, arm: Mapping[str, Any], under: Conditions
) -> Array:
    """Run `k` of a case, which is run `at` of the plant, as log.csv has it: a row a sample."""
    encoder, joint, speed = (
        part[:, :, at].copy() for part in (recorded.encoder_rad, recorded.joint_rad, recorded.speed_rad_s)
    )
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
    return np.asarray(
        tip - base[:3] - np.cross(base[3:], tip)
    )  # in the camera's frame, which lies so in the arm's


def _frictions(draft: _Draft) -> str:
    lines = []
    for j in range(len(draft.known["C"])):
        for effect, key, name in (
            ("coulomb_friction", "torque_Nm", "C"),
            ("viscous_friction", "coefficient_Nm_s_rad", "V"),
        ):
            value = draft.known[name][j]
            lines.append(
                f'[[effect]]\neffect = "{effect}"\njoint = {j + 1}\nparameters = {{ {key} = {value:.6f} }}\n\n'
            )
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
