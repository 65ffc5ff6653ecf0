"""Sessions of the reference arm on boards whose places nobody knows: a ball in cavities, board after board."""

from __future__ import annotations

import dataclasses

import numpy as np

from benchmarks.calibration.chains import REFERENCE, angles_for, board_points, deviations
from benchmarks.gap.static.cases import ARM, FRICTION_Nm, NOISE_m, SEEDS_rad, gravity_Nm
from calib.points.points import Points, make_points
from control.model.arm import Arm, Camera, Table

CAVITIES = board_points()
LINK_SHARE = 0.3


def arm() -> Arm:
    """The reference arm with a board that may stand anywhere, whose seats scatter as the camera does."""
    centre = CAVITIES.mean(axis=0)
    cavities = {f"c{k}": tuple(map(float, place - centre)) for k, place in enumerate(CAVITIES)}
    table = Table(known_pose=False, cavities_m=cavities)
    return dataclasses.replace(ARM, table=table, camera=Camera(NOISE_m))


def session(boards: int, seed: int = 1, play_rad: float = 0.0, stiffness_Nm_rad: float = np.inf) -> Points:
    """Each board in another place and tilt, every other cavity from one side, with what joint 2 hides."""
    rng = np.random.default_rng(seed)
    true_dh = ARM.dh + deviations(rng, len(ARM.links))
    setups, names, angles, lasts, held = [], [], [], [], []
    for board in range(boards):
        places = _placed(rng, board)
        q = angles_for(REFERENCE, true_dh, places[board % 2 :: 2], SEEDS_rad)
        last = np.where(rng.random(q.shape) < 0.5, -1.0, 1.0)
        gravity = np.array([gravity_Nm(own, 0.0) for own in q])
        own = gravity + FRICTION_Nm * last * rng.uniform(0.7, 1.0, q.shape)
        torque = gravity + LINK_SHARE * (own - gravity)
        ahead = np.zeros_like(q)
        ahead[:, 1] = -0.5 * play_rad * np.sign(torque[:, 1]) - torque[:, 1] / stiffness_Nm_rad
        count = len(q)
        setups += [f"board{board}"] * count
        names += [f"c{k}" for k in range(board % 2, len(CAVITIES), 2)]
        angles.append(q - ahead)
        lasts.append(last)
        held.append(own)
    q, m = np.concatenate(angles), len(setups)
    seat = np.random.default_rng(seed + 1).normal(0.0, NOISE_m, (m, 3))
    jacobian = np.array([_jacobian(true_dh, own) for own in q])
    q = q + np.linalg.solve(jacobian, seat[:, :, None])[..., 0]
    per_A = np.array([d.gear_ratio * d.torque_constant_Nm_A for d in ARM.drives])
    return make_points(
        setups,
        names,
        [1] * m,
        q,
        np.full((m, 3), np.nan),
        np.concatenate(lasts),
        np.concatenate(held) / per_A,
        8.0 * np.arange(m),
    )


def _placed(rng: np.random.Generator, board: int) -> np.ndarray:
    """The cavities of a board that stands up to 60 mm and 20 degrees elsewhere, (33, 3)."""
    centre = CAVITIES.mean(axis=0)
    turned = board_points(*rng.uniform(-0.35, 0.35, 2)) if board else CAVITIES
    return np.asarray(turned - centre + centre + rng.uniform(-0.06, 0.06, 3) * (board > 0))


def _jacobian(dh: np.ndarray, q: np.ndarray) -> np.ndarray:
    step = 1e-6 * np.eye(3)
    ends = REFERENCE.tips(dh, np.concatenate((q + step, q - step)))
    return np.asarray((ends[:3] - ends[3:]).T / 2e-6)
