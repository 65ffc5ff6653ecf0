"""Writes what two draw wires read, from places that nobody knows to the tip of the arm."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from tests.journeys.truth import true_arm

NOISE_m = 1e-4


def main(built: str, file: str, count: str, seed: str, scenario: str) -> None:
    """`count` readings of each wire, at poses all over the joints' ranges."""
    arm, random = load_arm(built), np.random.default_rng(int(seed))
    lower, upper = np.array(arm.limits_rad).T
    joints = range(1, arm.joint_count + 1)
    lines = ["setup,point,repeat," + ",".join(f"q{j}_rad" for j in joints) + ",x_m,y_m,z_m,distance_of,distance_m"]
    for wire, at_m in (("A", (0.7, -0.5, 0.1)), ("B", (0.6, 0.6, 0.3))):
        q_rad = 0.5 * (lower + upper) + 0.35 * (upper - lower) * random.uniform(-1.0, 1.0, (int(count), arm.joint_count))
        tips_m = ForwardKinematics(true_arm(arm, scenario)).tips(q_rad)
        lengths_m = np.linalg.norm(tips_m - at_m, axis=1) + random.normal(0.0, NOISE_m, int(count))
        for k, (q, length_m) in enumerate(zip(q_rad.tolist(), lengths_m, strict=True), 1):
            angles = ",".join(f"{angle:.6f}" for angle in q)
            lines.append(f"free,{wire}{k},1,{angles},,,,wire:{wire},{length_m:.5f}")
    Path(file).write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
