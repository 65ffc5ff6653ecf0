"""Physics of hidden effects on an arm at rest, listed and unlisted. Independent of the model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.calibration.chains import ChainModel
from control.model.arm import Arm

SEGMENTS = 40


@dataclass(frozen=True)
class Hidden:
    """An effect with the value of its first parameter, and of a second (phase, time constant, order, ...)."""

    effect: str
    joint: int | None
    value: float
    more: float = 0.0


@dataclass(frozen=True)
class Rig:
    """A known arm, its true chain, the range of its free poses and its gears' friction."""

    arm: Arm
    chain: ChainModel
    lower: np.ndarray
    upper: np.ndarray
    friction_Nm: np.ndarray


@dataclass(frozen=True)
class Poses:
    """True values of m poses: joints (m, n), directions, payload, torques, setups."""

    q: np.ndarray
    last: np.ndarray
    payload: np.ndarray
    t_s: np.ndarray
    gravity: np.ndarray
    transmitted: np.ndarray
    setup: tuple[str, ...]
    rng: np.random.Generator


def known_wrong(rig: Rig, hidden: tuple[Hidden, ...]) -> tuple[float, dict[int, float], np.ndarray]:
    """Payload beyond what is stated, mass beyond nominal by link (1-based), torque constants by joint."""
    payload = sum(one.value for one in hidden if one.effect == "payload")
    masses = {one.joint or 0: one.value for one in hidden if one.effect == "link_inertia"}
    constants = np.ones(len(rig.lower))
    for one in hidden:
        if one.effect == "torque_constant":
            constants[(one.joint or 1) - 1] = one.value
    return payload, masses, constants


def frames_of(rig: Rig, dh: np.ndarray, q: np.ndarray) -> list[np.ndarray]:
    """Frames 0 to the last, each (m, 4, 4)."""
    m, t = len(q), np.tile(np.eye(4), (len(q), 1, 1)).astype(np.result_type(dh, q, float))
    found, angles = [t], iter(q.T)
    for (d, theta, length, alpha), turns in zip(dh, rig.chain.joints, strict=True):
        about = theta + (next(angles) if turns else np.zeros(m))
        z, x = _screw(2, d, about, m), _screw(0, length, np.full(m, alpha), m)
        t = t @ x @ z if rig.chain.modified else t @ z @ x
        found.append(t)
    return found


def _screw(axis: int, by: float, about: np.ndarray, m: int) -> np.ndarray:
    t = np.zeros((m, 4, 4), dtype=np.result_type(about, float))
    t[:] = np.eye(4)
    i, j = (1, 2) if axis == 0 else (0, 1)
    t[:, i, i] = t[:, j, j] = np.cos(about)
    t[:, i, j], t[:, j, i] = -np.sin(about), np.sin(about)
    t[:, axis, 3] = by
    return t


def weights(
    rig: Rig, frames: list[np.ndarray], payload: np.ndarray, masses: dict[int, float]
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Every weight: its link (links + 1: payload), mass (m,), place (m, 3)."""
    for k, link in enumerate(rig.arm.links, start=1):
        if link.mass_kg and link.com_m is not None:
            mass = np.full(len(payload), link.mass_kg + masses.get(k, 0.0))
            yield k, mass, (frames[k] @ np.array([*link.com_m, 1.0]))[:, :3]
    tip = (frames[-1] @ np.array([*rig.chain.tool_m, 1.0]))[:, :3]
    yield len(rig.arm.links) + 1, payload, tip


def gravity_torques(rig: Rig, dh: np.ndarray, q: np.ndarray, payload: np.ndarray, masses: dict[int, float]) -> np.ndarray:
    """Holding torques (m, n): the slope of the potential energy by each angle (complex step)."""
    down = np.asarray(rig.arm.gravity_m_s2)
    torques = np.empty(q.shape)
    for j in range(q.shape[1]):
        frames = frames_of(rig, dh, q + 1e-30j * np.eye(q.shape[1])[j])
        energy = sum(-mass * (place @ down) for _, mass, place in weights(rig, frames, payload, masses))
        torques[:, j] = energy.imag / 1e-30
    return torques


def ahead_rad(one: Hidden, at: Poses, rig: Rig) -> np.ndarray:
    """Joint minus encoder angles, (m, n)."""
    ahead = np.zeros_like(at.q)
    if one.effect == "belt_coupling":
        ahead[:, 2] = one.value * at.q[:, 1]
    elif one.effect in JOINT_LAWS:
        j = (one.joint or 3) - 1
        ahead[:, j] = JOINT_LAWS[one.effect](one, at, j)
    elif one.effect == "motor ripple":
        j = (one.joint or 1) - 1
        ahead[:, j] = one.value * np.sin(rig.arm.drives[j].gear_ratio * at.q[:, j] + one.more)
    return ahead


def _walk(one: Hidden, at: Poses, j: int) -> np.ndarray:
    """A zero that slips at three random times, back and forth."""
    edges = at.rng.uniform(0.1, 0.9, 3) * at.t_s.max()
    slips = [sign * (at.t_s > edge) for sign, edge in zip((1, -1.6, 1), edges, strict=True)]
    return np.asarray(one.value * sum(slips))


JOINT_LAWS: dict[str, Callable[[Hidden, Poses, int], np.ndarray]] = {
    "backlash": lambda o, p, j: -0.5 * o.value * np.sign(p.transmitted[:, j]),
    "joint_compliance": lambda o, p, j: -p.gravity[:, j] / o.value,
    "encoder_scale": lambda o, p, j: p.q[:, j] * o.value / (1.0 + o.value),
    "encoder_eccentricity": lambda o, p, j: o.value * np.sin(p.q[:, j] + o.more),
    "thermal_drift": lambda o, p, j: o.value * (1.0 - np.exp(-p.t_s / o.more)),
    # in no list:
    "slip": lambda o, p, j: o.value * (p.t_s > o.more * p.t_s.max()),
    "bent rail": lambda o, p, j: o.value * p.q[:, (j + 1) % p.q.shape[1]] ** 2,
    "hysteresis": lambda o, p, j: -o.value * p.last[:, j] * (1.0 - np.exp(-np.abs(p.transmitted[:, j]) / 2.0)),
    "ripple": lambda o, p, j: o.value * np.sin(round(o.more) * p.q[:, j] + 0.7),
    "slipping zero": _walk,
    "linear drift": lambda o, p, j: o.value * p.t_s / p.t_s.max(),
    "periodic drift": lambda o, p, j: o.value * np.sin(2 * np.pi * p.t_s / p.t_s.max() * o.more),
    "stiffening": lambda o, p, j: -o.value * np.sign(p.gravity[:, j]) * np.sqrt(np.abs(p.gravity[:, j])),
    "softening": lambda o, p, j: -o.value * p.gravity[:, j] * np.abs(p.gravity[:, j]) / np.abs(p.gravity[:, j]).max(),
    "asymmetric compliance": lambda o, p, j: -o.value * np.where(p.gravity[:, j] > 0.0, 1.0, 0.25) * p.gravity[:, j],
    "lost counts": lambda o, p, j: o.value * np.cumsum(np.abs(np.diff(p.q[:, j], prepend=p.q[0, j]))),
}


def shifted_m(one: Hidden, at: Poses, rig: Rig, dh: np.ndarray, tip: np.ndarray) -> np.ndarray:
    """Displacement of the tip, (m, 3), besides joint angles."""
    frames = frames_of(rig, dh, at.q)
    down = np.asarray(rig.arm.gravity_m_s2)
    if one.effect == "link_flexure":
        return _bent(one, at, rig, frames, tip, down)
    if one.effect == "wobble":
        k = one.joint or 1
        axis_frame = frames[k if rig.chain.modified else k - 1]
        tilt = one.value * np.cos(2.0 * at.q[:, k - 1] + one.more)
        return tilt[:, None] * np.cross(frames[k - 1][:, :3, 0], tip - axis_frame[:, :3, 3])
    if one.effect == "loose tool":
        axis = frames[-1][:, :3, round(one.more) % 3]
        return np.asarray(one.value * np.sign(axis @ down)[:, None] * axis)
    return np.zeros_like(tip)


def _bent(one: Hidden, at: Poses, rig: Rig, frames: list[np.ndarray], tip: np.ndarray, down: np.ndarray) -> np.ndarray:
    """How a bent link moves the tip, (m, 3)."""
    return bent(one, at, rig, frames, tip, down)[0]


def bent(
    one: Hidden, at: Poses, rig: Rig, frames: list[np.ndarray], tip: np.ndarray, down: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A link as a row of small hinges from its joint to the next, each turned by the moment of everything beyond it.

    Displacement of the tip (m, 3), and the hinges' turns together (m, 3).
    """
    k, turning = one.joint or 2, [r for r, link in enumerate(rig.arm.links, 1) if link.joint == "revolute"]
    following = next((r for r in turning if r > k), None)
    before = 0 if rig.chain.modified else 1
    begin = frames[k - before][:, :3, 3]
    end = tip if following is None else frames[following - before][:, :3, 3]
    along = (end - begin) / np.linalg.norm(end - begin, axis=1, keepdims=True)
    piece = np.linalg.norm(end - begin, axis=1, keepdims=True) / SEGMENTS
    shift, turned = np.zeros_like(tip), np.zeros_like(tip)
    for s in range(SEGMENTS):
        hinge, moment = begin + (s + 0.5) * piece * along, np.zeros_like(tip)
        for link, mass, place in weights(rig, frames, at.payload, {}):
            hangs = link >= (following or len(rig.arm.links) + 1)
            is_beyond = hangs | (np.sum((place - hinge) * along, axis=1) > 0.0) & (link >= k)
            moment += np.where(is_beyond[:, None], np.cross(place - hinge, mass[:, None] * down), 0.0)
        moment -= np.sum(moment * along, axis=1, keepdims=True) * along
        turn = moment / one.value * piece
        shift, turned = shift + np.cross(turn, tip - hinge), turned + turn
    return shift, turned


def camera_m(one: Hidden, at: Poses, tip: np.ndarray) -> np.ndarray:
    """Tips (m, 3) measured by the camera."""
    made = CAMERAS.get(one.effect)
    return tip if made is None else made(one, at, tip)


def _turned(tip: np.ndarray, about: np.ndarray, turn: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows turned by a small rotation vector about a point."""
    return np.where(rows[:, None], tip + np.cross(turn, tip - about), tip)


def _registered(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    names = list(dict.fromkeys(p.setup))
    rows = np.array([s == names[round(o.more) % len(names)] for s in p.setup])
    moved = _turned(tip, tip[rows].mean(axis=0), np.array([o.value, -0.6 * o.value, o.value]) / 0.3, rows)
    return np.where(rows[:, None], moved + o.value * np.array([1.0, 0.5, -0.7]), moved)


def _tilted(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    names = list(dict.fromkeys(p.setup))
    rows = np.array([s == names[round(o.more) % len(names)] for s in p.setup])
    rows &= p.t_s > np.median(p.t_s[rows])
    return _turned(tip, tip[rows].mean(axis=0), np.array([o.value, 0.0, 0.0]), rows)


def _framed(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    """The camera's frame is displaced: base = R tip + t, so it measures R' (base - t)."""
    c, s = np.cos(o.more), np.sin(o.more)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.asarray((tip - o.value * np.array([1.0, -0.8, 0.0])) @ turn)


def _lens(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    off = tip - (tip.mean(axis=0) + np.array([0.05, -0.03, 0.0]))
    flat = off * np.array([1.0, 1.0, 0.0])
    return np.asarray(tip + o.value * flat * np.sum(flat**2, axis=1, keepdims=True) / 0.04)


def _some(p: Poses, share: float) -> np.ndarray:
    return p.rng.choice(len(p.setup), max(2, round(share * len(p.setup))), replace=False)


def _outliers(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    rows, out = _some(p, o.more), tip.copy()
    out[rows] += p.rng.normal(0.0, o.value, (len(rows), 3))
    return out


def _swapped(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    rows, out = _some(p, o.more), tip.copy()
    out[rows] = tip[np.roll(rows, 1)]
    return out


def _late(o: Hidden, p: Poses, tip: np.ndarray) -> np.ndarray:
    """The camera's exposure started before the arm was at rest: a share of the previous pose."""
    return np.asarray(tip + o.value * (np.roll(tip, 1, axis=0) - tip) * (np.arange(len(tip)) > 0)[:, None])


CAMERAS: dict[str, Callable[[Hidden, Poses, np.ndarray], np.ndarray]] = {
    "base_frame": _framed,
    "camera scale": lambda o, p, tip: tip * (1.0 + o.value),
    "camera lens": _lens,
    "camera skew": lambda o, p, tip: tip + o.value * tip[:, [1]] * np.array([1.0, 0.0, 0.0]),
    "registration": _registered,
    "tilted table": _tilted,
    "outliers": _outliers,
    "swapped points": _swapped,
    "late camera": _late,
}
