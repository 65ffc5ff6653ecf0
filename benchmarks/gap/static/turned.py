"""Measured orientations of the static cases: a target that sits on the last link in a way that nobody told."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.gap.static.physics import Hidden, Poses, Rig, bent, frames_of


def orientations(
    rng: np.random.Generator,
    rig: Rig,
    dh: np.ndarray,
    at: Poses,
    hidden: tuple[Hidden, ...],
    noise_rad: float,
) -> np.ndarray:
    """Quaternions w, x, y, z of the target, (m, 4), in the frame of the camera."""
    frames = frames_of(rig, dh, at.q)
    turned = sum((_turned_rad(one, at, rig, frames) for one in hidden), np.zeros((len(at.q), 3)))
    noise = Rotation.from_rotvec(rng.normal(0.0, noise_rad, (len(at.q), 3)))
    target = Rotation.from_rotvec(rng.normal(0.0, 0.5, 3))
    measured = noise * Rotation.from_rotvec(turned) * Rotation.from_matrix(frames[-1][:, :3, :3]) * target
    for one in hidden:
        if one.effect == "base_frame":  # the camera sees everything turned the other way
            measured = Rotation.from_rotvec([-one.more, 0.0, 0.0]) * measured
    return np.roll(measured.as_quat(), 1, axis=1)


def _turned_rad(one: Hidden, at: Poses, rig: Rig, frames: list[np.ndarray]) -> np.ndarray:
    """Turns of the last link, (m, 3), besides joint angles; a loose tool slides and does not turn."""
    if one.effect == "link_flexure":
        tip = (frames[-1] @ np.array([*rig.chain.tool_m, 1.0]))[:, :3]
        return bent(one, at, rig, frames, tip, np.asarray(rig.arm.gravity_m_s2))[1]
    if one.effect == "wobble":
        k = one.joint or 1
        tilt = one.value * np.cos(2.0 * at.q[:, k - 1] + one.more)
        return np.asarray(tilt[:, None] * frames[k - 1][:, :3, 0])
    return np.zeros((len(at.q), 3))
