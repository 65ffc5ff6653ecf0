"""Planned free poses against random and spread ones on the reference arm: accuracy of the identification.

`python -m benchmarks.calibration.design_trial [seeds]` prints the table of docs/plan_poses.md; the tests run a few seeds of it.

A trial: an arm whose DH parameters are off by up to 3 mm and 0.02 rad (so that tips are some 2 cm off), 33 cavities in
each of three setups, and free poses; every tip measured with 0.14 mm per axis. What is identified from them is held
against measured poses all over the workspace: the mean distance there over that of an arm known exactly, which is the
noise floor. The arm's true tips come from `chains`, which shares nothing with control.model.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.calibration.chains import REFERENCE, board_session
from calib.arm_problem.assembly import Choice, problem_of
from calib.design.candidates import workspace_poses
from calib.design.information import experiment_of, uncertainty_of
from calib.design.planning import Request, plan_poses
from calib.identify.identification import identify
from calib.identify.objective import LeastSquares, Objective, SumOfDistances
from calib.points.points import Points, make_points
from control.model.description import load_arm

NOISE_m = 0.00014
HELD_OUT_COUNT = 400
ARM = load_arm("right")


def measured(dh: np.ndarray, q: np.ndarray, rng: np.random.Generator, setup: str = "free") -> Points:
    """Poses q (m, n) measured by a camera on an arm with parameters dh."""
    tips = REFERENCE.tips(dh, q) + rng.normal(0.0, NOISE_m, (len(q), 3))
    return make_points([setup] * len(q), [f"{setup}{k}" for k in range(len(q))], [1] * len(q), q, tips)


def table_points(rng: np.random.Generator, setups: Sequence[str] = ("normal", "roll", "pitch")) -> tuple[np.ndarray, Points]:
    """True DH table and the points of a table session."""
    dh, q, tips, names = board_session(rng, setups, NOISE_m)
    cavities = [str(1 + k % 33) for k in range(len(q))]
    return dh, make_points(names, cavities, [1] * len(q), q, tips)


def both(first: Points, second: Points) -> Points:
    """Points of two sessions."""
    return make_points(
        [*first.setup, *second.setup],
        [*first.point, *second.point],
        [*first.repeat, *second.repeat],
        np.vstack((first.q_rad, second.q_rad)),
        np.vstack((first.tip_m, second.tip_m)),
    )


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Collision-free poses drawn uniformly from the joints' ranges."""
    pool = workspace_poses(ARM, [], 3000)
    return pool[rng.choice(len(pool), count, replace=False)]


def spread(count: int) -> np.ndarray:
    """Collision-free poses spread evenly: each the farthest from the previous ones."""
    pool = workspace_poses(ARM, [], 2000)
    span = np.ptp(pool, axis=0)
    chosen = [int(np.argmin(np.abs((pool - pool.mean(axis=0)) / span).max(axis=1)))]
    while len(chosen) < count:
        away = np.linalg.norm((pool[:, None] - pool[chosen]) / span, axis=2).min(axis=1)
        chosen.append(int(np.argmax(away)))
    return pool[chosen]


def held_out_ratio(points: Points, dh: np.ndarray, objective: Objective, rng: np.random.Generator) -> float:
    """Mean distance at poses never used, over the noise floor there."""
    identification = identify(problem_of(ARM, points), objective=objective)
    q = random_poses(rng, HELD_OUT_COUNT)
    noise = rng.normal(0.0, NOISE_m, (len(q), 3))
    missed = REFERENCE.tips(dh, q) + noise - REFERENCE.tips(identification.dh, q)
    return float(np.linalg.norm(missed, axis=1).mean() / np.linalg.norm(noise, axis=1).mean())


def planned(taken: Points | None, count: int, **request: Any) -> np.ndarray:
    """Poses of a plan."""
    return plan_poses(ARM, taken, Request(count=count, only="free", **request)).points.q_rad


def designs(rng: np.random.Generator, table: Points, dh: np.ndarray) -> dict[str, Points]:
    """The measurements that are compared."""

    def free(q: np.ndarray) -> Points:
        return measured(dh, q, rng)

    return {
        "table (99)": table,
        "table + 12 random": both(table, free(random_poses(rng, 12))),
        "table + 12 spread": both(table, free(spread(12))),
        "table + 12 planned, D": both(table, free(planned(table, 12))),
        "table + 12 planned, tip": both(table, free(planned(table, 12, criterion="tip"))),
        "table + 6 planned, tip": both(table, free(planned(table, 6, criterion="tip"))),
        "20 planned alone, tip": free(planned(None, 20, criterion="tip")),
        "20 random alone": free(random_poses(rng, 20)),
    }


def main(seeds: range) -> None:
    """Every design with both objectives."""
    ratios: dict[tuple[str, str], list[float]] = {}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        dh, table = table_points(rng)
        for name, points in designs(rng, table, dh).items():
            for label, objective in (("E2", SumOfDistances()), ("LSQ", LeastSquares())):
                ratio = held_out_ratio(points, dh, objective, np.random.default_rng(1000 + seed))
                ratios.setdefault((name, label), []).append(ratio)
        sys.stderr.write(f"seed {seed} of {seeds}: {ratios[name, label][-1]:.3f}\n")
    table_of(ratios)


def table_of(ratios: dict[tuple[str, str], list[float]]) -> None:
    """Print mean, worst and share within 1.15."""
    sys.stdout.write(f"{'':<26}{'':<5}{'mean':>7}{'worst':>8}{'at most 1.15':>14}\n")
    for (name, label), values in ratios.items():
        share = np.mean(np.array(values) <= 1.15)
        sys.stdout.write(f"{name:<26}{label:<5}{np.mean(values):>7.3f}{max(values):>8.3f}{share:>13.0%}\n")


def counts() -> None:
    """Print how few planned poses predict the same tip uncertainty as the table and twelve more poses."""
    rng = np.random.default_rng(0)
    dh, table = table_points(rng)
    everywhere = workspace_poses(ARM, [], 800)

    def tip_mm(points: Points) -> float:
        experiment = experiment_of(ARM, points, everywhere, NOISE_m, Choice())
        return 1e3 * uncertainty_of(experiment, np.arange(len(points))).tip_m

    random = [tip_mm(both(table, measured(dh, random_poses(rng, 12), rng))) for _ in range(20)]
    aims = {
        "table": tip_mm(table),
        "table + 12 random, median": float(np.median(random)),
        "table + 12 spread": tip_mm(both(table, measured(dh, spread(12), rng))),
        "table + 12 planned, D": tip_mm(both(table, measured(dh, planned(table, 12), rng))),
        "table + 12 planned, tip": tip_mm(both(table, measured(dh, planned(table, 12, criterion="tip"), rng))),
    }
    for criterion in ("D", "tip"):
        alone = [tip_mm(measured(dh, planned(None, n, criterion=criterion), rng)) for n in range(4, 41)]
        for name, aim in aims.items():
            least = next((n for n, reached in enumerate(alone, 4) if reached <= aim), None)
            sys.stdout.write(f"{name:<28}{aim:8.3f} mm: {least or 'more than 40'} planned poses alone ({criterion})\n")


if __name__ == "__main__":
    main(range(int(sys.argv[1]) if len(sys.argv) > 1 else 24))
    counts()
