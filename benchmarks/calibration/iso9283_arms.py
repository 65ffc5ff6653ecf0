"""Do predicted ISO 9283 figures hold the measured ones? Poses of the programme, on many arms. `make iso9283-study`.

Arms as in benchmarks.calibration.trust_coverage. The poses P1 to P5 of the largest test cube are visited from random sides,
measured with the camera's noise, and compared with the 95 % intervals that `armwright trust --visits` gives.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.calibration.trust_coverage import AMONG, ROUGHNESS, Session, session
from benchmarks.gap.static.cases import ARM, NOISE_m
from benchmarks.gap.static.physics import Hidden
from benchmarks.gap.static.rough_cases import Rough, several
from benchmarks.studies import add_options
from calib.arrays import Array
from calib.calibration import CalibrationPlan, calibrate
from calib.errors import UnusablePointsError
from calib.iso9283.programme import Visit, largest_cube, pose_programme
from calib.points.points import make_points
from calib.studies import executor
from calib.trust.report import PoseFigures, pose_figures
from calib.trust.trust import MapRequest, trust_in
from control.kinematics.inverse import InverseKinematics

VISITS = 30
SERVO_ROUNDS = 3  # until encoders stand where they are commanded to; effects are milliradians


@dataclass(frozen=True)
class Cases:
    """Arms of one sort, the first of this seed; q_rad (poses, n) of P1 to P5."""

    sort: str
    first_seed: int
    q_rad: Array


def figures_of_case(cases: Cases, number: int) -> tuple[PoseFigures, ...]:
    """Predicted and measured figures of one arm, as a task of a study."""
    seed = cases.first_seed + number
    rng = np.random.default_rng(seed + 5)
    hidden = several(rng, int(rng.integers(3, 7)), AMONG) if cases.sort == "rough" else ()
    made = _commanded(seed, hidden, np.tile(cases.q_rad, (VISITS, 1)))
    arm = calibrate(ARM, made.points, CalibrationPlan(starts_count=2)).arm
    trust = trust_in(arm, made.points, MapRequest(poses_count=300, is_checked=False))
    names = [f"P{k + 1}" for k in range(len(cases.q_rad))] * VISITS
    repeats = [1 + k // len(cases.q_rad) for k in range(len(names))]
    at, seen_m = made.unseen, made.true_m + rng.normal(0.0, NOISE_m, made.true_m.shape)
    programme = make_points(["pose"] * len(names), names, repeats, at.q_rad, seen_m, at.direction, at.current_A)
    try:
        return pose_figures(trust.predictor, arm, programme, Path("points.csv"))
    except UnusablePointsError:  # few poses of an arm with effects may look like another arm's
        return ()


def _commanded(seed: int, hidden: tuple[Hidden, ...], encoder_rad: Array) -> Session:
    """The session whose visits have these encoder angles, as a servo brings them about; effects move the joints."""
    joint_rad = encoder_rad
    for _ in range(SERVO_ROUNDS):
        with Rough(seed, ROUGHNESS):
            made = session(seed, hidden, joint_rad)
        joint_rad = joint_rad + encoder_rad - made.unseen.q_rad
    return made


def poses_rad() -> Array:
    """Joint angles of P1 to P5 by the nominal arm."""
    inverse, here = InverseKinematics(ARM), np.zeros(3)
    found = []
    for step in pose_programme(largest_cube(ARM), 1):
        if isinstance(step, Visit):
            here = np.array(inverse.nearest(step.tip_m, tuple(here.tolist())))
            found.append(here)
    return np.array(found)


def main() -> None:
    """Print how many figures lie inside, for each sort of arms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=300)
    parser.add_argument("--sorts", nargs="+", choices=("exact", "rough"), default=("exact", "rough"))
    add_options(parser)
    args = parser.parse_args()
    with executor(args.cases, args.workers, args.cluster) as runs:
        for sort in args.sorts:
            cases, inside, refused = Cases(sort, args.first_seed, poses_rad()), [], 0
            for _, found in runs.results(figures_of_case, cases, range(args.cases)):
                refused += not found
                inside += [held(one) for one in found]
            accuracy, repeatability = 100.0 * np.mean(np.array(inside), axis=0)
            print(
                f"{sort}: AP_p of {accuracy:.0f} %, RP_l of {repeatability:.0f} % of {len(inside)} poses inside"
                f" their 95 % intervals; programmes of {refused} arms refused as another arm's"
            )


def held(one: PoseFigures) -> tuple[bool, bool]:
    """Whether the measured accuracy and repeatability of a pose lie in their predicted intervals."""
    accuracy, repeatability = one.measured_accuracy_m, one.measured_repeatability_m
    predicted = one.repeatability_m
    if accuracy is None or repeatability is None or predicted is None:
        raise ValueError(f"{one.where}: expected measured figures")
    return (one.accuracy_m.lower <= accuracy <= one.accuracy_m.upper, predicted.lower <= repeatability <= predicted.upper)


if __name__ == "__main__":
    main()
