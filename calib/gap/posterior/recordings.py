"""Which poses are fitted and which only report, where recordings are too small, or boards stand where nobody knows."""

from __future__ import annotations

import numpy as np

from calib.gap.static.split import Split, recordings, split
from calib.points.points import Points

POSES_LEAST = 6  # of a recording, on average: an approach of its own for every pose is none
EVERY = 4  # pose of a setup reports where nothing larger can be kept apart


def parted(points: Points) -> Split:
    """By recording (setup, payload, approach); else by setup; else every fourth pose of each setup.

    Setups are not kept apart where their boards' places are unknown: a board that was not fitted has no place.
    """
    labels = recordings(points)
    if len(points) >= POSES_LEAST * len(set(labels.tolist())):
        found = split(points)
        setups = np.array(points.setup)
        unplaced = np.asarray(np.isnan(points.tip_m).any(axis=1))
        alone = [
            name
            for name in dict.fromkeys(points.setup)
            if (found.report | ~(setups == name)).all() and unplaced[setups == name].any()
        ]
        return _alternating(points) if found.is_divided and alone else found
    return _alternating(points)


def _alternating(points: Points) -> Split:
    setups = np.array(points.setup)
    report = np.zeros(len(points), dtype=bool)
    for name in dict.fromkeys(points.setup):
        report[np.flatnonzero(setups == name)[EVERY - 1 :: EVERY]] = True
    return Split(~report, np.zeros_like(report), report, bool(report.any()), len(set(points.setup)))
