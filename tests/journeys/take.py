"""Writes what motion capture would have recorded of the arm in an exported log, on its own clock and in its own frame."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from calib.capture.alignment import after_leaps, begins_s
from calib.gap.log import read_log
from control.kinematics.kinematics import ForwardKinematics
from control.model.description import load_arm
from tests.calib.capture.recordings import SYSTEM, Both, CAPTURE_Hz, MARKERS_m, NOISE_m, SYSTEM_m, c3d_bytes, vicon_csv
from tests.journeys.truth import true_arm

BEGUN_s = 2.3217  # after homing, at which the logged angles leap


def main(built: str, log: str, take: str, scenario: str) -> None:
    """`take`: a .csv as of Vicon Tracker, or a .c3d of markers M1 to M4 on the tool and B1 to B3 on the base."""
    arm, random = load_arm(built), np.random.default_rng(5)
    recorded, _ = read_log(Path(log), arm.joint_count)
    starts_s = begins_s(recorded.runs)
    t_s = np.concatenate([run.t_s + start_s for run, start_s in zip(recorded.runs, starts_s, strict=True)])
    q_rad = np.concatenate([run.q_rad for run in recorded.runs])
    begun_s = float(t_s[after_leaps(t_s, q_rad)]) + BEGUN_s
    tau_s = np.arange(round((t_s[-1] - begun_s - 1.0) * CAPTURE_Hz)) / CAPTURE_Hz
    seen_rad = np.column_stack([np.interp(begun_s + tau_s, t_s, q_rad[:, j]) for j in range(arm.joint_count)])
    true = true_arm(arm, scenario)
    links = ForwardKinematics(true).link_transforms(seen_rad)
    last, turn = links[:, -1, :3, 3], links[:, -1, :3, :3]
    at = np.add(arm.tool.position_m, (0.03, 0.02, 0.05))
    markers = np.stack([SYSTEM.apply(last + turn @ (at + marker)) + SYSTEM_m for marker in MARKERS_m])
    place_m = SYSTEM.apply(last + turn @ at) + SYSTEM_m
    made = Both(
        true,
        t_s,
        q_rad,
        tau_s,
        place_m + random.normal(0.0, NOISE_m, place_m.shape),
        SYSTEM.as_matrix() @ turn,
        markers + random.normal(0.0, NOISE_m, markers.shape),
    )
    if take.endswith(".csv"):
        Path(take).write_text(vicon_csv(made), encoding="utf-8")
        return
    base = np.stack([np.tile(SYSTEM.apply(marker) + SYSTEM_m, (len(tau_s), 1)) for marker in MARKERS_m[:3]])
    labels = ("M1", "M2", "M3", "M4", "B1", "B2", "B3")
    Path(take).write_bytes(c3d_bytes(np.concatenate([made.markers_m, base]), labels=labels))


if __name__ == "__main__":
    main(*sys.argv[1:])
