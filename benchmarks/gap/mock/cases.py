"""Hidden effects of the mock arm's cases: every effect on every joint where it is observable, in three sizes.

`small` is about the smallest relevant size, `large` that of a badly built arm.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.gap.matrix import Hidden, Truth
from calib.gap.finding import EffectName
from calib.gap.log import Log
from calib.points.points import Points
from calib.points.writer import write_points
from control.model.arm import Arm, Effect
from control.model.description import save_arm
from hil_mocks.plant.effects import EffectEntry

Level = Literal["static", "dynamic"]
SIZES = ("small", "medium", "large")
# Of the first parameter, in the order of SIZES.
STATIC: dict[str, tuple[float, float, float]] = {
    "backlash": (0.0015, 0.004, 0.012),
    "joint_compliance": (2500.0, 900.0, 350.0),
    "encoder_scale": (0.0015, 0.004, 0.012),
    "encoder_eccentricity": (0.0015, 0.004, 0.010),
    "belt_coupling": (0.003, 0.008, 0.02),
    "thermal_drift": (0.0015, 0.004, 0.008),
    "link_flexure": (1500.0, 500.0, 200.0),
}
DYNAMIC: dict[str, tuple[float, float, float]] = {
    "coulomb_friction": (0.08, 0.3, 0.8),
    "viscous_friction": (0.08, 0.4, 1.2),
    "stribeck_friction": (0.25, 0.7, 1.5),
    "load_friction": (0.04, 0.12, 0.3),
    "asymmetric_friction": (0.06, 0.15, 0.4),
    "cogging": (0.1, 0.4, 1.2),
    "torque_constant": (0.03, 0.08, 0.15),
    "joint_compliance": (1500.0, 600.0, 200.0),
    "backlash": (0.002, 0.006, 0.018),
    "encoder_eccentricity": (0.001, 0.003, 0.008),
    "encoder_scale": (0.001, 0.003, 0.010),
    "command_delay": (0.0006, 0.0015, 0.004),
    "supply_sag": (0.04, 0.12, 0.4),
    "payload": (0.03, 0.1, 0.3),
    "belt_coupling": (0.002, 0.006, 0.02),
    "link_inertia": (0.08, 0.2, 0.4),
}
OF_THE_ARM = ("belt_coupling", "command_delay", "supply_sag", "payload")
DRIFT_S = (60.0, 200.0)  # time constant: a recording lasts some four minutes
PAIRS: dict[Level, tuple[tuple[str, str], ...]] = {
    "static": (("backlash", "joint_compliance"), ("encoder_eccentricity", "belt_coupling"), ("encoder_scale", "backlash")),
    "dynamic": (("load_friction", "cogging"), ("viscous_friction", "torque_constant"), ("command_delay", "stribeck_friction")),
}


@dataclass(frozen=True, slots=True)
class MockCase:
    """One recording: the hidden effects, in terms of docs/formats.md, and the seed of everything else."""

    level: Level
    hidden: tuple[EffectEntry, ...]
    seed: int
    size: str = ""

    @property
    def truth(self) -> Truth:
        """For the score."""
        hidden = tuple(Hidden(EffectName(e.effect, e.joint or None), e.parameters) for e in self.hidden)
        return Truth(hidden, is_crooked=self.level == "static")

    def __str__(self) -> str:
        """As `mock static backlash1 small, seed 3`."""
        names = "+".join(f"{e.effect}{e.joint or ''}" for e in self.hidden) or "nothing"
        return f"mock {self.level} {names}{' ' if self.size else ''}{self.size}, seed {self.seed}"


def joints_of(effect: str, level: Level, arm: Arm) -> tuple[int, ...]:
    """Joints where an effect is observable in this arm's recordings; 0: the whole arm."""
    n = arm.joint_count
    if effect == "belt_coupling" and n < 3:
        return ()
    if effect in OF_THE_ARM:
        return (0,)
    every = range(1, n + 1)
    if level == "static" and effect == "joint_compliance":
        return tuple(j for j in every if j in _bent_by_gravity(arm))
    if effect == "link_flexure":
        return tuple(k for k, link in enumerate(arm.links, 1) if link.joint == "revolute" and link.L_m > 0.1)
    if effect == "link_inertia":
        return tuple(k for k in every if k > 1)
    return tuple(every)


def _bent_by_gravity(arm: Arm) -> tuple[int, ...]:
    """Joints whose axis is not always along gravity."""
    from control.dynamics.dynamics import Dynamics

    scatter = np.random.default_rng(0).uniform(-1.0, 1.0, (20, arm.joint_count))
    torques = np.array([Dynamics(arm).gravity(q.tolist()) for q in scatter])
    return tuple(int(j) + 1 for j in np.flatnonzero(np.abs(torques).max(axis=0) > 0.3))


def entry(effect: str, joint: int, size: float, rng: np.random.Generator) -> EffectEntry:
    """An effect of this size; its other parameters are drawn."""
    sign = float(rng.choice([-1.0, 1.0]))
    phase = float(rng.uniform(-3.1, 3.1))
    match effect:
        case "backlash":
            values = {"width_rad": size}
        case "joint_compliance":
            values = {"stiffness_Nm_rad": size, "damping_Nm_s_rad": float(rng.uniform(0.5, 1.5))}
        case "encoder_scale":
            values = {"scale": sign * size}
        case "encoder_eccentricity":
            values = {"amplitude_rad": size, "phase_rad": phase}
        case "belt_coupling":
            values = {"ratio": sign * size}
        case "thermal_drift":
            values = {"final_rad": sign * size, "time_constant_s": float(rng.uniform(*DRIFT_S))}
        case "link_flexure":
            values = {"EI_Nm2": size}
        case "viscous_friction":
            values = {"coefficient_Nm_s_rad": size}
        case "stribeck_friction":
            values = {"torque_Nm": size, "speed_rad_s": float(rng.uniform(0.03, 0.09))}
        case "load_friction":
            values = {"fraction": size}
        case "asymmetric_friction" | "coulomb_friction":
            values = {"torque_Nm": size}
        case "cogging":
            values = {"amplitude_Nm": size, "order": float(rng.integers(4, 15)), "phase_rad": phase}
        case "torque_constant":
            values = {"scale": 1.0 + sign * size}
        case "command_delay":
            values = {"delay_s": size}
        case "supply_sag":
            values = {"resistance_ohm": size}
        case "payload":
            values = {"mass_kg": size}
        case _:
            values = {"mass_kg": size} if sign > 0.0 else {"inertia_kg_m2": 0.1 * size}
    return EffectEntry(effect, joint, values)


def grid(level: Level, arm: Arm, first_seed: int) -> Iterator[MockCase]:
    """Every effect on every joint in every size, a seed each."""
    seed = first_seed
    for effect, sizes in (STATIC if level == "static" else DYNAMIC).items():
        for joint in joints_of(effect, level, arm):
            for word, size in zip(SIZES, sizes, strict=True):
                hidden = entry(effect, joint, size, np.random.default_rng(seed))
                yield MockCase(level, (hidden,), seed, word)
                seed += 1


def drawn(level: Level, arm: Arm, count: int, first_seed: int) -> Iterator[MockCase]:
    """`count` cases of one effect; effects by turns, joint and size drawn, the size evenly in the logarithm."""
    table = STATIC if level == "static" else DYNAMIC
    order = np.random.default_rng(first_seed).permutation(list(table))
    for k in range(count):
        yield MockCase(level, (_drawn(str(order[k % len(order)]), level, arm, first_seed + k),), first_seed + k)


def pairs(level: Level, arm: Arm, count: int, first_seed: int) -> Iterator[MockCase]:
    """`count` cases of two effects."""
    for k in range(count):
        seed = first_seed + k
        names = PAIRS[level][k % len(PAIRS[level])]
        yield MockCase(level, tuple(_drawn(name, level, arm, 10 * seed + i) for i, name in enumerate(names)), seed)


def nulls(level: Level, count: int, first_seed: int) -> Iterator[MockCase]:
    """`count` cases that hide nothing."""
    return (MockCase(level, (), first_seed + k) for k in range(count))


def _drawn(effect: str, level: Level, arm: Arm, seed: int) -> EffectEntry:
    rng = np.random.default_rng(seed)
    joints = joints_of(effect, level, arm)
    small, _, large = (STATIC if level == "static" else DYNAMIC)[effect]
    size = float(np.exp(rng.uniform(*sorted((np.log(small), np.log(large))))))
    return entry(effect, int(rng.choice(joints)), size, rng)


def arm_with_friction(arm: Arm, seed: int) -> Arm:
    """The arm's file with Coulomb and viscous friction of every joint, known as from an earlier measurement."""
    rng = np.random.default_rng([seed, 1])
    found = []
    for j, drive in enumerate(arm.drives, start=1):
        stall = drive.gear_ratio * drive.torque_constant_Nm_A * drive.current_limit_A
        found.append(Effect("coulomb_friction", j, {"torque_Nm": stall * float(rng.uniform(0.016, 0.037))}))
        found.append(Effect("viscous_friction", j, {"coefficient_Nm_s_rad": stall * float(rng.uniform(0.012, 0.037))}))
    return replace(arm, effects=(*arm.effects, *found))


def write_case(folder: Path, case: MockCase, arm: Arm, recording: Points | Log) -> None:
    """Write the recording in the formats of docs/formats.md: arm.toml, truth.json, and points.csv or log.csv.gz."""
    folder.mkdir(parents=True, exist_ok=True)
    save_arm(arm, folder / "arm.toml")
    effects = [{"effect": e.effect, "joint": e.joint or None, "parameters": e.parameters} for e in case.hidden]
    truth = {"seed": case.seed, "effects": effects}
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    if isinstance(recording, Points):
        write_points(folder / "points.csv", recording)
    else:
        with gzip.open(folder / "log.csv.gz", "wt", compresslevel=6, encoding="utf-8") as file:
            file.write("\n".join(_log_lines(recording)) + "\n")


def _log_lines(log: Log) -> Iterator[str]:
    joints = range(1, log.joint_count + 1)
    groups = [[form.format(j) for j in joints] for form in ("q{}_set_rad", "q{}_rad", "i{}_A", "u{}_V")]
    yield ",".join(["run", "t_s", "payload_kg", *(n for group in groups for n in group), "x_m", "y_m", "z_m"])
    for run in log.runs:
        for k in range(len(run)):
            tip = ",,"
            if np.isfinite(run.tip_m[k]).all():
                tip = ",".join(f"{x:.6f}" for x in run.tip_m[k])
            cells = [f"{x:.7f}" for x in (*run.q_set_rad[k], *run.q_rad[k])]
            cells += [f"{x:.4f}" for x in (*run.current_A[k], *run.voltage_V[k])]
            yield f"{run.name},{run.t_s[k]:.3f},{run.payload_kg[k]:g},{','.join(cells)},{tip}"
