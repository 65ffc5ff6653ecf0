"""Writes a script of operator's lines: poses all over the middle of the joints' ranges, with a rest of a second at each."""

import sys
from pathlib import Path

import numpy as np

from calib.design.candidates import body_points, is_above_floor
from control.model.description import load_arm

arm, count = load_arm(sys.argv[1]), int(sys.argv[2])
rest = np.array(arm.rest.q_rad if arm.rest else np.zeros(arm.joint_count))
lower, upper = np.array(arm.limits_rad).T
random, here, lines = np.random.default_rng(4), rest, list[str]()
while len(lines) < 2 * count:
    there = np.clip(rest + 0.3 * (upper - lower) * random.uniform(-1.0, 1.0, len(rest)), lower + 0.05, upper - 0.05)
    way = here + np.linspace(0.0, 1.0, 12)[:, None] * (there - here)
    if is_above_floor(arm, body_points(arm, way) - [0.0, 0.0, 0.03]).all():
        lines += ["move --joints " + " ".join(f"{q:.3f}" for q in there), "wait 1"]
        here = there
Path(sys.argv[3]).write_text("\n".join(lines) + "\n", encoding="utf-8")
