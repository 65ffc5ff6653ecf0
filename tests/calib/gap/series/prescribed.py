"""Logs of the reference arm without a simulation: the motion is prescribed, and what follows from it is written down.

Currents follow from inverse dynamics plus whatever is hidden, voltages from the currents and the back-EMF as a drive
that holds its voltage over a sample would need them.
"""

from __future__ import annotations

import csv
import gzip
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.log import Log, LoggedRun
from control.dynamics.dynamics import Dynamics
from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Effect
from control.model.description import load_arm

RATE_Hz, SECONDS = 500.0, 2.0
COULOMB_Nm = (0.6, 0.7, 0.5)
VISCOUS = (0.7, 0.5, 0.4)
STIFFER = 5.0
Hidden = Callable[[int, Array, Array, Array], Array]  # joint, q, speed, link torque -> torque that the motor adds


def arm_with_friction() -> Arm:
    """The reference arm that knows its Coulomb and viscous friction.

    Without inductance and with a high resistance, so that a held voltage makes a step of the current: in a real winding
    the motor's speed bends it within a sample, and this motion knows nothing of that.
    """
    effects = [Effect("coulomb_friction", j + 1, {"torque_Nm": t}) for j, t in enumerate(COULOMB_Nm)]
    effects += [Effect("viscous_friction", j + 1, {"coefficient_Nm_s_rad": v}) for j, v in enumerate(VISCOUS)]
    arm = load_arm("right")
    drives = tuple(
        replace(drive, inductance_H=0.0, resistance_ohm=STIFFER * drive.resistance_ohm, supply_V=2.4 * drive.supply_V)
        for drive in arm.drives
    )
    return replace(arm, effects=tuple(effects), drives=drives)


def longer(arm: Arm) -> Arm:
    """Another arm than the supplied one: its links are longer, its motors stronger."""
    stronger = (replace(one, torque_constant_Nm_A=1.4 * one.torque_constant_Nm_A) for one in arm.drives)
    return replace(arm.with_dh(np.array(arm.dh) * [1.2, 1.0, 1.3, 1.0]), drives=tuple(stronger))


LONG = longer(arm_with_friction())


def nothing(joint: int, q: Array, speed: Array, link: Array) -> Array:
    """Nothing is hidden."""
    return np.zeros_like(q)


def log_of(
    arm: Arm,
    hidden: Hidden = nothing,
    seed: int = 1,
    delay_samples: int = 0,
    winding_share: float = 0.0,
    turned: Callable[[Array, Array], Array] | None = None,
    closes_loop: bool = False,
) -> Log:
    """Seven runs: five motions, two of them twice, one with a payload. `turned`: joint angle beyond the encoder's; `closes_loop`:
    the drives do, so that currents are those of the moment and nobody records voltages.
    """
    rng, model = np.random.default_rng(seed), Model(arm, Dynamics(arm), ForwardKinematics(arm))
    seeds = [11, 12, 13, 14, 15, 13, 12]
    loads = [0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    runs = []
    for k, (motion, load) in enumerate(zip(seeds, loads, strict=True)):
        slow = 0.15 if motion == 11 else 1.0
        runs.append(_run(model, str(k + 1), motion, slow, load, hidden, rng, delay_samples, winding_share, turned, closes_loop))
    return Log(tuple(runs), ("prescribed",))


def write_log(log: Log, path: Path) -> None:
    """As log.csv.gz."""
    kinds = (("q", "rad"), ("q", "set_rad"), ("i", "A"), ("u", "V"))
    joints = range(1, log.runs[0].q_rad.shape[1] + 1)
    columns = [f"{kind}{joint}_{unit}" for kind, unit in kinds for joint in joints]
    with gzip.open(path, "wt", compresslevel=1, newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["run", "t_s", "payload_kg", *columns, "x_m", "y_m", "z_m"])
        for run in log.runs:
            values = (run.q_rad, run.q_set_rad, run.current_A, run.voltage_V, run.tip_m)
            for row in np.column_stack((run.t_s, run.payload_kg, *values)).tolist():
                writer.writerow([run.name, *("" if math.isnan(value) else f"{value:.9g}" for value in row)])


@dataclass(frozen=True, slots=True)
class Model:
    """The arm, and its equations, which take longer to compile than to evaluate."""

    arm: Arm
    dynamics: Dynamics
    kinematics: ForwardKinematics


def _run(
    model: Model,
    name: str,
    motion: int,
    slow: float,
    load: float,
    hidden: Hidden,
    rng: np.random.Generator,
    delay: int,
    winding_share: float,
    turned: Callable[[Array, Array], Array] | None,
    closes_loop: bool,
) -> LoggedRun:
    arm, count = model.arm, int(SECONDS * RATE_Hz)
    T = 1.0 / RATE_Hz
    # One sample before the run, for the voltage that its first current comes from, and `delay` after it.
    starts = T * np.arange(-1, count + delay)
    phases = np.random.default_rng(motion)
    tones = [(phases.uniform(0.3, 1.2, 3), phases.uniform(0.0, 2 * np.pi, 3)) for _ in range(3)]
    q0, v0, a0 = _waves(starts, tones, slow)
    qm, vm, am = _waves(starts + 0.5 * T, tones, slow)
    K = np.array([d.gear_ratio * d.torque_constant_Nm_A for d in arm.drives])
    R = np.array([d.resistance_ohm for d in arm.drives]) * (1.0 + winding_share)
    level = R * _torque(model, qm, vm, am, load, hidden) / K + K * vm  # over the sample that begins at `starts`
    q = q0[1 : count + 1]
    current = (level[:count] - K * v0[1 : count + 1]) / R
    voltage = level[1 + delay : 1 + delay + count]
    if closes_loop:
        current = (_torque(model, q0, v0, a0, load, hidden) / K)[1 : count + 1]
        voltage = np.full_like(current, np.nan)
    step = np.array([2 * np.pi / (d.encoder_counts_per_rev * d.gear_ratio) for d in arm.drives])
    joints = q if turned is None else q + turned(q, model.dynamics.torques(q, 0 * q, 0 * q, load))
    tip = _seen(model, joints, rng)
    return LoggedRun(
        name,
        T * np.arange(count),
        np.round(q / step) * step,
        q,
        current + rng.normal(0.0, 0.01, current.shape),
        voltage,
        np.full(count, load),
        tip,
    )


def _torque(model: Model, q: Array, v: Array, a: Array, load: float, hidden: Hidden) -> Array:
    """What the drives give (m, 3): links, rotors, the friction of the model, and what is hidden."""
    rotor = np.array([d.gear_ratio**2 * d.rotor_inertia_kg_m2 for d in model.arm.drives])
    link = model.dynamics.torques(q, v, a, load) - rotor * a
    torque = link + rotor * a + np.array(COULOMB_Nm) * np.sign(v) + np.array(VISCOUS) * v
    for j in range(3):
        torque[:, j] += hidden(j, q[:, j], v[:, j], link[:, j])
    return torque


def _seen(model: Model, joints: Array, rng: np.random.Generator) -> Array:
    """Tips (m, 3) as the camera measures them: in every fifth sample, the others are not a number."""
    seen = np.arange(len(joints)) % 5 == 0
    tip = np.full((len(joints), 3), np.nan)
    tip[seen] = model.kinematics.tips(joints[seen]) + rng.normal(0.0, 0.00014, (int(seen.sum()), 3))
    return tip


def _waves(
    t: Array, tones: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]], slow: float
) -> tuple[Array, Array, Array]:
    """Three tones a joint; angle, speed and acceleration, exact."""
    q, v, a = (np.zeros((len(t), 3)) for _ in range(3))
    for j, (tone_Hz, phase) in enumerate(tones):
        for f, p in zip(tone_Hz, phase, strict=True):
            w = 2 * np.pi * f * slow
            q[:, j] += 0.2 * np.sin(w * t + p)
            v[:, j] += 0.2 * w * np.cos(w * t + p)
            a[:, j] -= 0.2 * w * w * np.sin(w * t + p)
    return q + np.array([0.0, -0.6, 0.1]), v, a
