"""Do 95 % ellipsoids of the tip's predicted error hold 95 % of true errors over the whole workspace? `make trust-study`.

Arms made without this project's kinematics and dynamics (benchmarks.gap.static). Each is calibrated from three tilts and 25
free poses of a narrower range; true tips without noise are then compared at poses over all joints' ranges. `exact`: geometry
alone is wrong. `rough`: three to six effects with laws that depart from the textbook's are hidden as well, and nothing is named.
`elsewhere`: other arms with rougher parts (rough_arms), every second of them recorded over half of each joint's range.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from benchmarks.calibration.chains import REFERENCE, TILTS, angles_for, board_points, deviations
from benchmarks.calibration.rough_arms import rough_arm
from benchmarks.gap.static.cases import ARM, LINK_SHARE, NOISE_A, RIGS, Design, NOISE_m, SEEDS_rad, visited
from benchmarks.gap.static.physics import Hidden, Poses, ahead_rad, gravity_torques, shifted_m
from benchmarks.gap.static.rough_cases import Rough, several
from benchmarks.studies import add_options
from calib.arm_problem.assembly import Choice
from calib.arrays import Array
from calib.calibration.calibrate import CalibrationPlan, calibrate
from calib.design.candidates import workspace_poses
from calib.points.points import Points, make_points
from calib.studies.cluster import executor
from calib.trust.discrepancy import Conditions
from calib.trust.prediction import TipError
from calib.trust.trust import ELLIPSOID_95, MapRequest, trust_in

AMONG = (
    "backlash",
    "joint_compliance",
    "encoder_scale",
    "encoder_eccentricity",
    "belt_coupling",
    "link_flexure",
)
FREE = 25
TESTED = 700
ROUGHNESS = 0.08
SORTS = ("exact", "rough", "elsewhere")


@dataclass(frozen=True)
class Session:
    """What was recorded, and poses that were not: conditions and true tips (t, 3) [m]."""

    points: Points
    unseen: Conditions
    true_m: Array


def session(
    seed: int, hidden: tuple[Hidden, ...], unseen_q: Array, unseen_direction: Array | None = None
) -> Session:
    """A recording of a real arm, and its true tips at joint angles `unseen_q` (t, n), approached from any side."""
    rng, rig, design = np.random.default_rng(seed), RIGS["reference"], Design(free=FREE)
    true_dh = ARM.dh + deviations(rng, len(ARM.links))
    rows = []
    for setup in design.tilts:
        angles = angles_for(REFERENCE, true_dh, board_points(*TILTS[setup])[:: design.step], SEEDS_rad)
        rows += visited(rig, setup, angles, design)
    rows += visited(rig, "free", rng.uniform(rig.lower, rig.upper, (FREE, 3)), design)
    k = len(rows)
    q = np.vstack((np.array([row[3] for row in rows]) + rng.normal(0.0, 1e-3, (k, 3)), unseen_q))
    sides = np.sign(rng.normal(size=unseen_q.shape)) if unseen_direction is None else unseen_direction
    last = np.vstack((np.array([row[4] for row in rows]), sides))
    payload = np.concatenate(([row[5] for row in rows], np.zeros(len(unseen_q))))
    gravity = gravity_torques(rig, true_dh, q, payload, {})
    held = gravity + rig.friction_Nm * last * rng.uniform(0.7, 1.0, q.shape)
    names = (*(row[0] for row in rows), *["unseen"] * len(unseen_q))
    t_s = np.arange(0.0, 8.0 * len(q), 8.0)
    poses = Poses(q, last, payload, t_s, gravity, gravity + LINK_SHARE * (held - gravity), names, rng)
    encoder, tip = q.copy(), rig.chain.tips(true_dh, q)
    for one in hidden:
        encoder -= ahead_rad(one, poses, rig)
        tip = tip + shifted_m(one, poses, rig, true_dh, tip)
    current = held / np.array([d.gear_ratio * d.torque_constant_Nm_A for d in ARM.drives])
    seen_m, seen_A = tip + rng.normal(0.0, NOISE_m, tip.shape), current + rng.normal(0.0, NOISE_A, q.shape)
    points = make_points(names[:k], [row[1] for row in rows], [row[2] for row in rows], encoder[:k], seen_m[:k], last[:k],
                         seen_A[:k], t_s[:k], payload[:k])  # fmt: skip
    return Session(points, Conditions(encoder[k:], last[k:], payload[k:], current[k:]), tip[k:])


def scored(sort: str, seed: int, unseen_q: Array) -> tuple[float, float, float]:
    """Share of true errors inside their ellipsoids; error of the calibrated arm, and what the prediction leaves, RMS [m]."""
    rng = np.random.default_rng(seed + 5)
    hidden = several(rng, int(rng.integers(3, 7)), AMONG) if sort == "rough" else ()
    with Rough(seed, ROUGHNESS):
        made = session(seed, hidden, unseen_q)
    arm = calibrate(ARM, made.points, CalibrationPlan(starts_count=2)).arm
    trust = trust_in(arm, made.points, MapRequest(poses_count=300, is_checked=False))
    error = trust.predictor.at(
        made.unseen
    )  # the arm's file has no effects: its encoder angles are joint angles
    return _inside(error, made.true_m)


def scored_elsewhere(seed: int) -> tuple[float, float, float]:
    """The same for an arm of benchmarks.calibration.rough_arms; every second is recorded over half of each range."""
    made = rough_arm(seed, is_half=seed % 2 == 1, unseen_count=TESTED)
    tied = Choice(fixed=("base",))
    arm = calibrate(made.rig.arm, made.points, CalibrationPlan(tied, starts_count=2)).arm
    trust = trust_in(arm, made.points, MapRequest(poses_count=300, is_checked=False, choice=tied))
    error = trust.predictor.at(made.unseen)
    return _inside(error, made.true_m)


def _inside(error: TipError, true_m: Array) -> tuple[float, float, float]:
    true = true_m - error.tip_m
    left = true - error.expected_m
    squares = np.einsum("mi,mi->m", left, np.linalg.solve(error.total_m2, left[:, :, None])[:, :, 0])
    return float(np.mean(squares < ELLIPSOID_95)), _rms_m(true), _rms_m(left)


def _rms_m(errors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


@dataclass(frozen=True)
class Cases:
    """Arms of one sort, the first of this seed."""

    sort: str
    first_seed: int
    unseen_q: Array


def scored_case(cases: Cases, number: int) -> tuple[float, float, float]:
    """As a task of a study."""
    if cases.sort == "elsewhere":
        return scored_elsewhere(cases.first_seed + number)
    return scored(cases.sort, cases.first_seed + number, cases.unseen_q)


def main() -> None:
    """Print a line a case, and the share of each sort."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--sorts", nargs="+", choices=SORTS, default=SORTS)
    add_options(parser)
    given = parser.parse_args()
    unseen_q = workspace_poses(ARM, (), TESTED)
    with executor(given.cases, given.workers, given.cluster) as runs:
        for sort in given.sorts:
            cases, shares = Cases(sort, given.first_seed, unseen_q), []
            for number, (share, error_m, left_m) in runs.results(scored_case, cases, range(given.cases)):
                shares.append(share)
                print(
                    f"{sort} {given.first_seed + number}: {100 * share:.1f} % inside, error {1e3 * error_m:.3f} mm,"
                    f" left {1e3 * left_m:.3f} mm",
                    flush=True,
                )
            print(f"{sort}: {100 * float(np.mean(shares)):.1f} % of true errors inside, {given.cases} arms")


if __name__ == "__main__":
    main()
