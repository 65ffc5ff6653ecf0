"""How far the true tip is from where files put it, by the geometry that a scenario hides in the mock."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np

from control.kinematics.kinematics import ForwardKinematics
from control.model.arm import Arm, Tool
from control.model.description import load_arm
from hil_mocks.scenario import load_scenario

KEYS = ["d", "theta", "L", "alpha"]


def true_arm(built: Arm, scenario: str) -> Arm:
    """The arm as the mock has it."""
    dh = np.array(built.dh)
    for name, deviation in load_scenario(scenario).drawn_deviations(len(dh)).items():
        link, key = name.removeprefix("link").split("_")[:2]
        dh[int(link) - 1, KEYS.index(key)] += deviation
    return built.with_dh(dh)


def main() -> int:
    """Print the mean distances over the middle halves of the joints' ranges; status 1 where that of the file is not less."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("built", help="the file that the mock was built from")
    parser.add_argument("file")
    parser.add_argument("--scenario", default="demo")
    parser.add_argument("--any-place", action="store_true", help="wherever the base stands: after the best rigid motion")
    parser.add_argument("--times", type=float, default=1.0, help="how many times nearer the file must be")
    parser.add_argument("--below", type=float, default=np.inf, help="how far off the file may be, in mm")
    parser.add_argument("--target", type=float, nargs=3, help="what was seen instead of the tip, in the last link's frame, in m")
    args = parser.parse_args()
    built = load_arm(args.built)
    if args.target:
        built = replace(built, tool=Tool(position_m=tuple(args.target)))
    lower, upper = np.array(built.limits_rad).T
    middle, half = (lower + upper) / 2.0, (upper - lower) / 2.0
    q_rad = middle + 0.5 * half * np.random.default_rng(3).uniform(-1.0, 1.0, (300, built.joint_count))
    true_m = ForwardKinematics(true_arm(built, args.scenario)).tips(q_rad)
    off_mm = [
        1e3 * distance_m(ForwardKinematics(arm).tips(q_rad), true_m, args.any_place) for arm in (built, load_arm(args.file))
    ]
    print(f"{args.built}: {off_mm[0]:.3f} mm; {args.file}: {off_mm[1]:.3f} mm")
    return int(off_mm[1] > args.below or (off_mm[0] < args.times * off_mm[1] and np.isinf(args.below)))


def distance_m(tips_m: np.ndarray, true_m: np.ndarray, any_place: bool) -> float:
    """Mean distance, after the rotation and shift that bring the tips nearest (Kabsch) where the place does not count."""
    if any_place:
        centre_m, true_centre_m = tips_m.mean(axis=0), true_m.mean(axis=0)
        left, _, right = np.linalg.svd((true_m - true_centre_m).T @ (tips_m - centre_m))
        turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        tips_m = (tips_m - centre_m) @ turn.T + true_centre_m
    return float(np.linalg.norm(tips_m - true_m, axis=1).mean())


if __name__ == "__main__":
    sys.exit(main())
