"""Histories of arms that age, made without this project's kinematics: do intervals of the trend hold the truth?"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Sequence

import numpy as np

from benchmarks.calibration.chains import REFERENCE, REFERENCE_DH, TILTS, angles_for, board_points, deviations
from calib.arm_problem.assembly import Choice, problem_of
from calib.arrays import Array
from calib.design.candidates import workspace_poses
from calib.drift import YEAR_days
from calib.history import FORMAT, Entry, geometry_of
from calib.identify.identification import identify
from calib.identify.objective import objective_named
from calib.points.points import Points, make_points
from calib.trend import trend_of
from control.model.description import load_arm

ARM = load_arm("right")
NOISE_m = 1.4e-4
FREE = 15
SEED_rad = np.array([0.0, -1.0, 0.0])
BEGUN = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
TOLERANCE_m = 5e-4
# The column theta of the link that each joint turns, in the reference arm's table.
ZEROS = ((0, 1), (1, 1), (2, 1))


def measured(dh: Array, rng: np.random.Generator) -> Points:
    """A session of an arm of this geometry: two tilts of the board and free poses, seen by the camera."""
    setups, q = [], []
    for setup in ("normal", "roll"):
        q.append(angles_for(REFERENCE, dh, board_points(*TILTS[setup])[::3], SEED_rad))
        setups += [setup] * len(q[-1])
    spread = workspace_poses(ARM, (), 400)
    q.append(spread[rng.choice(len(spread), FREE, replace=False)])
    setups += ["free"] * FREE
    angles = np.vstack(q)
    tips = REFERENCE.tips(dh, angles) + rng.normal(0.0, NOISE_m, (len(angles), 3))
    return make_points(setups, [f"p{k}" for k in range(len(angles))], [1] * len(angles), angles, tips)


def history(days: Sequence[float], rate_rad_year: Array, seed: int, choice: Choice | None = None) -> tuple[Entry, ...]:
    """Calibrations on these days of an arm whose joints' zeros drift steadily (3,)."""
    rng = np.random.default_rng(seed)
    true = REFERENCE_DH + deviations(rng, 4)
    return tuple(entry_of(day, _drifted(true, day, rate_rad_year), rng, choice) for day in days)


def entry_of(day: float, dh: Array, rng: np.random.Generator, choice: Choice | None = None) -> Entry:
    """The line that `calibrate --history` would write."""
    problem = problem_of(ARM, measured(dh, rng), choice or Choice())
    identification = identify(problem, objective=objective_named("lsq"), starts_count=1)
    measured_on = BEGUN + datetime.timedelta(days=day)
    return Entry(FORMAT, measured_on, "calibrate", ARM.name, "test", {}, geometry_of(problem, identification))


def _drifted(dh: Array, day: float, rate_rad_year: Array) -> Array:
    now = dh.copy()
    for (link, column), rate in zip(ZEROS, rate_rad_year, strict=True):
        now[link, column] += rate * day / YEAR_days
    return now


def main() -> None:
    """Score rates, false drifts and due dates over histories."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=500)
    args = parser.parse_args()
    inside = drifting = named = false = still = rest = kept = told = 0
    poses = workspace_poses(ARM, (), 300)
    for seed in range(args.first_seed, args.first_seed + args.cases):
        rng = np.random.default_rng(seed)
        rates = np.where(rng.random(3) < 0.5, 0.0, rng.uniform(-8e-3, 8e-3, 3))
        days = np.sort(rng.uniform(0.0, 180.0, int(rng.integers(3, 7))))
        entries = history(days.tolist(), rates, seed)
        trend = trend_of(ARM, entries, TOLERANCE_m)
        assert trend.geometry is not None
        for one, true in zip(trend.geometry.zeros, rates, strict=True):
            inside += abs(one.change - true) <= one.half
            drifting, named = drifting + (true != 0.0), named + (true != 0.0 and one.drifts)
            still, false = still + (true == 0.0), false + (true == 0.0 and one.drifts)
        rest += trend.geometry.rest_drifts
        if trend.due is not None and 0.0 < trend.due.days < trend.due.furthest_days:
            told += 1
            start = REFERENCE_DH + deviations(np.random.default_rng(seed), 4)
            at_last, at_due = (_drifted(start, days[-1] + more, rates) for more in (0.0, trend.due.days))
            moved = REFERENCE.tips(at_due, poses) - REFERENCE.tips(at_last, poses)
            kept += float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))) <= TOLERANCE_m
    print(f"{inside} of {3 * args.cases} rates inside their 95 % intervals")
    print(f"{named} of {drifting} drifts named, {false} of {still} still joints called drifting")
    print(f"other geometry called drifting: {rest} of {args.cases}")
    print(f"{kept} of {told} keep {1e3 * TOLERANCE_m:g} mm until the due date")


if __name__ == "__main__":
    main()
