"""Writes a script of operator's lines: poses all over the middle of the joints' ranges, with a rest of a second at each."""

import sys
from pathlib import Path

import numpy as np

from control.model.description import load_arm

arm, count = load_arm(sys.argv[1]), int(sys.argv[2])
rest = np.array(arm.rest.q_rad if arm.rest else np.zeros(arm.joint_count))
half = 0.35 * np.diff(np.array(arm.limits_rad), axis=1)[:, 0]
lower, upper = np.array(arm.limits_rad).T
poses = rest + half * np.random.default_rng(4).uniform(-1.0, 1.0, (count, arm.joint_count))
lines = []
for q_rad in np.clip(poses, lower + 0.05, upper - 0.05).tolist():
    lines += ["move --joints " + " ".join(f"{q:.3f}" for q in q_rad), "wait 1"]
Path(sys.argv[3]).write_text("\n".join(lines) + "\n", encoding="utf-8")
