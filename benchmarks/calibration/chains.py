"""Arms and boards as plain 4x4 chains, for tests and benchmarks: independent of control.model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

PI = np.pi
Numbers = float | npt.NDArray[Any]  # complex ones too: slopes are taken by complex steps
REFERENCE_DH = np.array(
    [[0.076, 0.0, 0.0, PI / 2], [0.0, PI / 2, 0.4, 0.0], [-0.012, 0.0, 0.0, PI / 2], [0.3543, 0.0, 0.0, PI / 2]]
)
TWO_JOINT_DH = np.array([[0.1, 0.0, 0.3, PI / 2], [0.02, 0.3, 0.25, 0.1]])
MODIFIED_DH = np.array(
    [
        [0.333, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, -PI / 2],
        [0.316, 0.0, 0.0, PI / 2],
        [0.0, 0.0, 0.0825, PI / 2],
        [0.107, 0.0, 0.1, 0.3],
    ]
)


def _along(axis: int, by: Numbers, about: Numbers, m: int) -> np.ndarray:
    """Screw motion about and along x (0) or z (2) as (m, 4, 4)."""
    t = np.zeros((m, 4, 4), dtype=np.result_type(by, about, float))
    t[:] = np.eye(4)
    i, j = [k for k in range(3) if k != axis]
    sign = 1.0 if axis != 1 else -1.0
    t[:, i, i] = t[:, j, j] = np.cos(about)
    t[:, i, j], t[:, j, i] = -sign * np.sin(about), sign * np.sin(about)
    t[:, axis, 3] = by
    return t


@dataclass(frozen=True)
class ChainModel:
    """A serial arm: `joints` says per link whether it turns; `modified` picks the convention; tip in the last frame."""

    joints: tuple[bool, ...]
    modified: bool = False
    tool_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def tips(self, dh: np.ndarray, q: np.ndarray) -> np.ndarray:
        m = len(q)
        t = np.tile(np.eye(4), (m, 1, 1)).astype(np.result_type(dh, float))
        angles = iter(q.T)
        for (d, theta, length, alpha), turns in zip(dh, self.joints, strict=True):
            about_z = theta + (next(angles) if turns else np.zeros(m))
            z, x = _along(2, d, about_z, m), _along(0, length, alpha, m)
            t = t @ x @ z if self.modified else t @ z @ x
        return np.asarray(t[:, :3, 3] + t[:, :3, :3] @ np.asarray(self.tool_m))

    def tips_and_dh_jacobian(self, dh: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Each parameter is a screw along x or z of some frame: it moves the tip by its axis, or axis x lever."""
        m, t = len(q), np.tile(np.eye(4), (len(q), 1, 1))
        angles, screws = iter(q.T), []
        for (d, theta, length, alpha), turns in zip(dh, self.joints, strict=True):
            about_z = theta + (next(angles) if turns else np.zeros(m))
            z, x = _along(2, d, about_z, m), _along(0, length, alpha, m)
            middle = t @ x if self.modified else t @ z
            z_frame, x_frame = (middle, t) if self.modified else (t, middle)
            screws.append((z_frame[:, :3, 2], z_frame[:, :3, 3], x_frame[:, :3, 0], x_frame[:, :3, 3]))
            t = middle @ (z if self.modified else x)
        tip = t[:, :3, 3] + t[:, :3, :3] @ np.asarray(self.tool_m)
        columns = [
            column
            for z, z_origin, x, x_origin in screws
            for column in (z, np.cross(z, tip - z_origin), x, np.cross(x, tip - x_origin))
        ]
        return tip, np.stack(columns, axis=2)


REFERENCE = ChainModel((True, True, True, False))
TWO_JOINT = ChainModel((True, True))
MODIFIED = ChainModel((True, True, True, True, False), modified=True, tool_m=(0.03, 0.0, 0.05))


def board_points(roll_rad: float = 0.0, pitch_rad: float = 0.0) -> np.ndarray:
    """The 33 cavities of the reference board, base frame, (33, 3)."""
    turn = np.arange(24) * 2 * PI / 24
    circle = 0.09 * np.column_stack((np.cos(turn), np.sin(turn), 0 * turn))
    line = np.column_stack((np.linspace(-0.08, 0.08, 9), np.zeros(9), np.zeros(9)))
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.asarray(np.array([0.5, 0.0, 0.0]) + np.vstack((circle, line)) @ (about_y @ about_x).T)


def angles_for(model: ChainModel, dh: np.ndarray, tips_m: np.ndarray, seed_rad: np.ndarray) -> np.ndarray:
    """Joint angles (m, n) that put the tip of an arm with parameters dh at tips_m, by Newton from one seed.

    A step after one of a nanoradian would be rounding: each leaves of the error its square.
    """
    q = np.tile(seed_rad, (len(tips_m), 1)).astype(float)
    for _ in range(60):
        miss = tips_m - model.tips(dh, q)
        jacobian = np.stack([model.tips(dh, q + 1e-30j * unit).imag / 1e-30 for unit in np.eye(q.shape[1])], axis=2)
        step = np.einsum("mnk,mk->mn", np.linalg.pinv(jacobian), miss)
        q += step * np.minimum(1.0, 0.4 / np.maximum(1e-12, np.abs(step).max(axis=1, keepdims=True)))
        if np.abs(step).max() < 1e-9:
            break
    return q


TILTS = {"normal": (0.0, 0.0), "roll": (np.radians(11.7), 0.0), "pitch": (0.0, np.radians(11.8))}


def deviations(rng: np.random.Generator, links: int, length_m: float = 0.003, angle_rad: float = 0.02) -> np.ndarray:
    """Uniform random DH deviations (links, 4)."""
    return np.asarray(rng.uniform(-1, 1, (links, 4)) * np.array([length_m, angle_rad, length_m, angle_rad]))


def board_session(
    rng: np.random.Generator, setups: Sequence[str] = ("normal", "roll", "pitch"), noise_m: float = 0.00014, size: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """A table session of the reference arm: (true dh, q (m,3), tips measured (m,3), setup names)."""
    true_dh = REFERENCE_DH + size * deviations(rng, 4)
    tips = np.vstack([board_points(*TILTS[s]) for s in setups])
    q = angles_for(REFERENCE, true_dh, tips, np.array([0.0, -1.0, 0.0]))
    names = tuple(s for s in setups for _ in range(33))
    return true_dh, q, tips + rng.normal(0, noise_m, tips.shape), names
