"""Markers in the cavities of the calibration board, in the arm's base frame: what registers the board.

The base frame is known by the body on the base: a calibration has placed it (origin_m and orientation of [camera.stream]).
"""

from __future__ import annotations

import numpy as np

from calib.arrays import frozen, norms
from calib.boards import Markers
from calib.capture.tracks import BodyTrack, Capture, CaptureError, placed_m, relative
from control.model.arm import Arm
from control.model.table import board_cavities, table_of

STILL_m = 1e-3  # standard deviation of a marker that stands


def board_markers(arm: Arm, capture: Capture, setup: str, base_body: str) -> Markers:
    """Mean positions of the markers that are called as cavities are. CaptureError if the frame is not placed, or one moves."""
    stream = arm.camera.stream if arm.camera is not None else None
    if stream is None or stream.origin_m is None or stream.base_body != base_body:
        raise CaptureError(
            f"arm {arm.name}: markers of the board need the base frame: expected a calibrated arm.toml whose [camera.stream] has"
            f' base_body = "{base_body}" and origin_m'
        )
    base = capture.body(base_body) if base_body else None
    names, places = [], []
    cavities = board_cavities(table_of(arm))
    for full, track in capture.markers.items():
        name = full.rpartition(":")[2]
        if name not in cavities:
            continue
        seen = track if base is None else relative(BodyTrack(track), base).position_m
        seen = seen[np.isfinite(seen).all(axis=1)]
        if not len(seen):
            continue
        if float(norms(seen.std(axis=0)[None])[0]) > STILL_m:
            raise CaptureError(
                f"{capture.path}: marker {full} moves: expected markers that stand in the board's cavities"
            )
        names.append(name)
        places.append(placed_m(stream, seen.mean(axis=0)))
    if not names:
        there = ", ".join(capture.markers) or "none"
        raise CaptureError(
            f"{capture.path}: no marker is called like a cavity ({', '.join(list(cavities)[:3])}, ...): it has {there}"
        )
    return Markers((setup,) * len(names), tuple(names), frozen(places))
