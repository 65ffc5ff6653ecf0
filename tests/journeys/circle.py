"""Writes way-points: a level circle of 20 mm about the tip at rest."""

import math
import sys
from pathlib import Path

import numpy as np

from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm

arm = load_arm(sys.argv[1])
((x, y, z),) = ForwardKinematics(arm).tips(np.array([arm.rest.q_rad if arm.rest else [0.0] * arm.joint_count])).tolist()
turns = [2.0 * math.pi * k / 12 for k in range(13)]
rows = [f"{x + 0.02 * math.cos(a):.6f},{y + 0.02 * math.sin(a):.6f},{z:.6f}" for a in turns]
Path(sys.argv[2]).write_text("\n".join(["x_m,y_m,z_m", *rows]) + "\n", encoding="utf-8")
