"""Simulated sessions of the reference arm, for the tests of what a calibration is worth."""

from __future__ import annotations

import numpy as np

from calib.arm_problem.arm_model import ArmModel
from calib.arm_problem.assembly import Choice, problem_of
from calib.arm_problem.problem import ArmProblem
from calib.identify.objective import LeastSquares, SumOfDistances
from calib.identify.solver import minimise
from calib.points.points import Points, make_points
from control.model.arm import Arm
from control.model.description import load_arm
from control.model.table import SETUPS, cavities, table_of

NOISE_m = 0.00014
RIGHT = load_arm("right")
SEED_POSE = np.array([0.0, -1.0, 0.0])


def seated(model: ArmModel, dh: np.ndarray, tips_m: np.ndarray, seed_rad: np.ndarray = SEED_POSE) -> np.ndarray:
    """Joint angles (m, n) that put the tip of an arm with parameters dh at tips_m, by Newton's steps."""
    q = np.tile(seed_rad, (len(tips_m), 1))
    for _ in range(40):
        slopes = model.slopes(dh, q)
        move = np.linalg.pinv(slopes.by_dh[:, :, list(model.theta_places)])
        step = np.einsum("mnk,mk->mn", move, tips_m - slopes.tips)
        q += step * np.minimum(1.0, 0.4 / np.maximum(1e-12, np.abs(step).max(axis=1, keepdims=True)))
        if np.abs(step).max() < 1e-9:  # the next one would be rounding
            break
    return q


def true_dh(rng: np.random.Generator, arm: Arm = RIGHT, size: float = 0.6) -> np.ndarray:
    """Deviations up to `size` times the default bounds."""
    bounds = np.array([0.005, np.radians(2.0)] * 2)
    return arm.dh + size * bounds * rng.uniform(-1.0, 1.0, arm.dh.shape)


def board_points(
    rng: np.random.Generator, dh: np.ndarray, setups: tuple[str, ...] = SETUPS, noise_m: float = NOISE_m, is_measured: bool = True
) -> Points:
    """All cavities of the given setups; the camera measures the tips, or nothing does and seating is as noisy."""
    places = [(s, name, place) for s in setups for name, place in cavities(table_of(RIGHT), s).items()]
    wanted = np.array([place for _, _, place in places])
    noise = rng.normal(0.0, noise_m, wanted.shape)
    q = seated(ArmModel(RIGHT), dh, wanted if is_measured else wanted + noise)
    tips = wanted + noise if is_measured else np.full_like(wanted, np.nan)
    return make_points([s for s, _, _ in places], [n for _, n, _ in places], [1] * len(places), q, tips)


def with_rows(points: Points, q_rad: np.ndarray | None = None, tip_m: np.ndarray | None = None) -> Points:
    """The same points with other angles or tips."""
    return make_points(
        points.setup,
        points.point,
        points.repeat,
        points.q_rad if q_rad is None else q_rad,
        points.tip_m if tip_m is None else tip_m,
    )


def solved(points: Points, choice: Choice | None = None, is_smooth: bool = False) -> tuple[ArmProblem, np.ndarray]:
    """The problem of the reference arm and its optimum x."""
    problem = problem_of(RIGHT, points, choice)
    return problem, minimise(problem, LeastSquares() if is_smooth else SumOfDistances(), starts_count=1).x
