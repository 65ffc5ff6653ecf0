"""Small recordings made by formula: what reads .armlog files needs no plant to be tested."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from control.recording.record import Layout

PERIOD_s = 0.002
STARTED_s = 1_700_000_000.5
AHEAD_rad = 0.01  # of a gear: encoder j stands j times this before its joint
ERROR_rad = 0.001  # joint j follows j times this behind its set-point
BOOTED_s = 5000.0  # the loop's clock has run since the machine started, not since the recording did
MODES = ("OFF", "BRAKED", "HOLDING", "MOVING", "HOMING", "GUIDING", "STOPPING", "FAULT")


def row_of(k: int, joint_count: int, **changes: float) -> dict[str, float]:
    """Cycle k: every joint swings at 1 Hz and follows behind; a camera frame every fifth cycle."""
    t_s = k * PERIOD_s
    moving = k >= 10
    row: dict[str, float] = {
        "t_s": BOOTED_s + t_s,
        "cycle": k,
        "run": int(moving),
        "mode": MODES.index("MOVING" if moving else "HOLDING"),
        "missed": 0,
        "late_s": 1e-4,
        "busy_s": 3e-4,
        "payload_kg": 0.0,
        **dict.fromkeys(("x_m", "y_m", "z_m"), 0.3 if k % 5 == 0 else math.nan),
    }
    for j in range(1, joint_count + 1):
        wanted = 0.1 * j * math.sin(2 * math.pi * t_s)
        row |= {
            f"q{j}_rad": wanted - j * ERROR_rad,
            f"q{j}_set_rad": wanted,
            f"speed{j}_rad_s": 0.0,
            f"speed{j}_set_rad_s": 0.0,
            f"count{j}": 1000 * j,
            f"u{j}_V": 1.0,
            f"i{j}_A": 0.5 * j,
            f"supply{j}_V": 24.0,
            f"temperature{j}_C": 30.0,
            f"joint{j}_rad": wanted - j * (ERROR_rad + AHEAD_rad),
            f"joint{j}_set_rad": wanted - j * AHEAD_rad,
            f"statusword{j}": 0x37,
            f"drive_faults{j}": 0,
            f"flags{j}": 4,
        }
    return row | changes


def write_recording(
    path: Path,
    cycles: int,
    joint_count: int = 3,
    changes: Mapping[int, Mapping[str, float]] | None = None,
    has_joint_side: bool = False,
    **header: Any,
) -> Path:
    """A .armlog of so many cycles; `changes` replaces values of single cycles."""
    layout = Layout.of(joint_count, has_joint_side)
    about = {"arm": "right", "started_unix_s": STARTED_s, "period_s": PERIOD_s, **header}
    with path.open("wb") as file:
        file.write(layout.header(about))
        for k in range(cycles):
            row = row_of(k, joint_count, **(changes or {}).get(k, {}))
            file.write(layout.packing.pack(*(row.get(name, 0) for name in layout.names)))
    return path
