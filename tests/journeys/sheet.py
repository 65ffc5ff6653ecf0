"""Writes what a laboratory's own program would have: Latin-1, semicolons, decimal commas, degrees, millimetres, German names."""

import sys
from pathlib import Path

import numpy as np

from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from tests.journeys.truth import true_arm

NOISE_m = 1e-4


def main(built: str, file: str, count: str, seed: str) -> None:
    """Poses in the middle two thirds of the joints' ranges, and where the true tip is, as an instrument measures it."""
    arm, random = load_arm(built), np.random.default_rng(int(seed))
    lower, upper = np.array(arm.limits_rad).T
    q_rad = random.uniform(lower + (upper - lower) / 6.0, upper - (upper - lower) / 6.0, (int(count), arm.joint_count))
    tips_m = ForwardKinematics(true_arm(arm, "demo")).tips(q_rad) + random.normal(0.0, NOISE_m, (int(count), 3))
    names = ["Stelle", *(f"Achse {j} [°]" for j in range(1, arm.joint_count + 1)), "X [mm]", "Y [mm]", "Z [mm]", "Bemerkung"]
    rows = [
        [str(k), *(f"{value:.5f}".replace(".", ",") for value in (*np.degrees(q), *(1e3 * tip))), "geprüft"]
        for k, (q, tip) in enumerate(zip(q_rad, tips_m, strict=True), 1)
    ]
    Path(file).write_text("\n".join(";".join(row) for row in [names, *rows]) + "\n", encoding="latin-1")


if __name__ == "__main__":
    main(*sys.argv[1:])
