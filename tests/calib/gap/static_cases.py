"""Static recordings of the reference arm in which an effect is hidden, made without control's kinematics or dynamics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from calib_arms import REFERENCE, TILTS, angles_for, board_points, deviations

from calib.points import Points, make_points
from control.model.description import load_arm

ARM = load_arm("right")
NOISE_m, NOISE_A = 0.00014, 0.02
APPROACHES = ((1, 1, 1), (-1, -1, -1), (1, -1, 1), (-1, 1, -1))
FRICTION_Nm = np.array([0.9, 0.8, 1.0])  # in the gear, on the motor's side for the most part
LINK_SHARE = 0.3
DESIGNS = {"full": (True, 25, 1), "thin": (True, 25, 4), "level": (False, 0, 1)}
SEEDS_rad = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class Hidden:
    """An effect as formats.md names it, with the value of its first parameter (and the phase of an eccentricity)."""

    effect: str
    joint: int | None
    value: float
    more: float = 0.0


def case(seed: int, hidden: tuple[Hidden, ...] = (), design: str = "thin") -> Points:
    """Three tilts from four approaches, with and without 0.5 kg, and free poses; `thin` visits every fourth cavity."""
    rng = np.random.default_rng(seed)
    true_dh = ARM.dh + deviations(rng, 4)
    has_tilts, free_count, step = DESIGNS[design]
    rows: list[tuple[str, str, int, np.ndarray, tuple[int, ...], float]] = []
    for setup in TILTS if has_tilts else ("normal",):
        q = angles_for(REFERENCE, true_dh, board_points(*TILTS[setup])[::step], SEEDS_rad)
        for repeat, (approach, payload) in enumerate(_visits(setup, design), start=1):
            rows += [(setup, str(k + 1), repeat, angles, approach, payload) for k, angles in enumerate(q)]
    free = rng.uniform([-1.0, -1.6, -1.0], [1.0, 0.6, 1.2], (free_count, 3))
    for repeat, (approach, payload) in enumerate(_visits("free", design), start=1):
        rows += [("free", f"f{k}", repeat, angles, approach, payload) for k, angles in enumerate(free)]
    return _measured(rng, true_dh, rows, hidden)


def _visits(setup: str, design: str) -> list[tuple[tuple[int, ...], float]]:
    if design == "level":
        return [(APPROACHES[0], 0.0)]
    unloaded = [(approach, 0.0) for approach in APPROACHES]
    loaded = [(APPROACHES[0], 0.0), (APPROACHES[0], 0.5), (APPROACHES[1], 0.5)]  # the first is a repeat
    return unloaded + (loaded if setup != "pitch" else [])


def _measured(rng, true_dh: np.ndarray, rows: list, hidden: tuple[Hidden, ...]) -> Points:
    joint_rad = np.array([row[3] for row in rows]) + rng.normal(0.0, 1e-3, (len(rows), 3))
    direction = np.array([row[4] for row in rows], dtype=float)
    payload = np.array([row[5] for row in rows])
    t_s = 8.0 * np.arange(len(rows))
    gravity = np.array([gravity_Nm(q, p) for q, p in zip(joint_rad, payload, strict=True)])
    held = gravity + FRICTION_Nm * direction * rng.uniform(0.7, 1.0, joint_rad.shape)
    transmitted = gravity + LINK_SHARE * (held - gravity)
    encoder = joint_rad - sum(behind(one, joint_rad, gravity, transmitted, t_s) for one in hidden)
    tip = REFERENCE.tips(true_dh, joint_rad) + rng.normal(0.0, NOISE_m, joint_rad.shape)
    torque_per_A = np.array([d.gear_ratio * d.torque_constant_Nm_A for d in ARM.drives])
    current = held / torque_per_A + rng.normal(0.0, NOISE_A, held.shape)
    return make_points(
        [row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows], encoder, tip, direction,
        current, t_s, payload,
    )  # fmt: skip


def behind(one: Hidden, q: np.ndarray, gravity: np.ndarray, transmitted: np.ndarray, t_s: np.ndarray):
    """How far the joints are ahead of their encoders, (m, 3)."""
    ahead = np.zeros_like(q)
    j = (one.joint or 3) - 1
    if one.effect == "backlash":
        ahead[:, j] = -0.5 * one.value * np.sign(transmitted[:, j])
    elif one.effect == "joint_compliance":
        ahead[:, j] = -gravity[:, j] / one.value
    elif one.effect == "encoder_scale":
        ahead[:, j] = q[:, j] * one.value / (1.0 + one.value)
    elif one.effect == "encoder_eccentricity":
        ahead[:, j] = one.value * np.sin(q[:, j] + one.more)
    elif one.effect == "belt_coupling":
        ahead[:, 2] = one.value * q[:, 1]
    elif one.effect == "thermal_drift":
        ahead[:, j] = one.value * (1.0 - np.exp(-t_s / one.more))
    elif one.effect == "slip":  # not in the list: a joint's zero slips
        ahead[:, j] = one.value * (t_s > one.more * t_s.max())
    elif one.effect == "bent rail":  # not in the list: the joint follows another joint's square
        ahead[:, j] = one.value * q[:, (j + 1) % 3] ** 2
    else:
        raise ValueError(one.effect)
    return ahead


def gravity_Nm(q: np.ndarray, payload_kg: float) -> np.ndarray:
    """Holding torques, as the slope of the potential energy by each angle (complex step)."""
    return np.array([_energy_J(q + 1e-30j * unit, payload_kg).imag / 1e-30 for unit in np.eye(3)])


def _energy_J(q: np.ndarray, payload_kg: float) -> complex:
    frame, energy, angles = np.eye(4, dtype=complex), 0.0 + 0.0j, iter(q)
    for link in ARM.links:
        about = link.theta_rad + (next(angles) if link.joint == "revolute" else 0.0)
        c, s, ca, sa = np.cos(about), np.sin(about), np.cos(link.alpha_rad), np.sin(link.alpha_rad)
        frame = frame @ np.array(
            [
                [c, -s * ca, s * sa, link.L_m * c],
                [s, c * ca, -c * sa, link.L_m * s],
                [0.0, sa, ca, link.d_m],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        if link.mass_kg:
            energy += 9.81 * link.mass_kg * (frame @ np.array([*link.com_m, 1.0]))[2]
    return energy + 9.81 * payload_kg * (frame @ np.array([*ARM.tool.position_m, 1.0]))[2]
