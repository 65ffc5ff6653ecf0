"""Which poses are fitted and which only report: by recording, never by pose, wherever there are recordings to spare.

A recording is what was taken in one go: one setup, one payload, one approach. Poses of one recording share more than their
model, so a recording is never divided, unless recordings are too few or stand on boards whose places are unknown.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Mask
from calib.points.points import Points

POSES_LEAST = 4  # of a recording, on average: an approach of its own for every pose is no recording
RECORDINGS_LEAST = 4  # fewer cannot spare one for the report
EVERY = 4  # pose of a setup reports where no whole recording can


@dataclass(frozen=True, slots=True)
class Split:
    """Masks (m,) of the poses that are fitted and those that only report; `is_divided` is False where all do both.

    `is_by_pose`: no whole recording could be spared, and single poses of each setup report.
    """

    known: Mask
    report: Mask
    is_divided: bool
    recordings_count: int
    is_by_pose: bool = False

    def without(self, out: Mask) -> Split:
        """The same, some poses (m,) left out of everything."""
        return dataclasses.replace(self, known=self.known & ~out, report=self.report & ~out)


def split(points: Points) -> Split:
    """By recording, the last one of every setup that has two reports; else every fourth pose of each setup does. Last and fourth
    are as the poses were taken, whatever the order of the rows.

    A setup never reports as a whole where its board's place is unknown: a board that was not fitted has no place.
    """
    labels, order = recordings(points), in_turn(points)
    names = list(dict.fromkeys(labels[order].tolist()))
    if len(names) < RECORDINGS_LEAST or len(points) < POSES_LEAST * len(names):
        return _alternating(points)
    setups = np.array(points.setup)
    report = np.zeros(len(points), dtype=bool)
    for setup in dict.fromkeys(points.setup):
        of_setup = list(dict.fromkeys(labels[order[setups[order] == setup]].tolist()))
        report |= (labels == of_setup[-1]) & (len(of_setup) > 1)
    if not report.any():  # every setup is one recording
        report = labels == names[-1]
    for setup in unplaced_setups(points):
        if report[setups == setup].all():
            return _alternating(points)
    return Split(~report, report, True, len(names))


def unplaced_setups(points: Points) -> tuple[str, ...]:
    """Setups with poses whose reference is a board, which has to be placed by other poses of the same setup."""
    unmeasured = np.flatnonzero(np.isnan(points.tip_m).any(axis=1))
    return tuple(dict.fromkeys(points.setup[k] for k in unmeasured.tolist()))


def parts(points: Points, count: int) -> npt.NDArray[np.str_]:
    """What can be left out in turn, (m,) labels: recordings; of a setup on a board, one pose in `count`, as none places it."""
    labels = recordings(points).astype(object)
    setups, order = np.array(points.setup), in_turn(points)
    for setup in unplaced_setups(points):
        rows = order[setups[order] == setup]
        labels[rows] = [f"part {place % count + 1}" for place in range(len(rows))]
    return labels.astype(str)


def _alternating(points: Points) -> Split:
    setups, order = np.array(points.setup), in_turn(points)
    report = np.zeros(len(points), dtype=bool)
    for name in dict.fromkeys(points.setup):
        report[order[setups[order] == name][EVERY - 1 :: EVERY]] = True
    if not report.any():
        return Split(~report, ~report, False, len(set(points.setup)))
    return Split(~report, report, True, len(set(points.setup)), is_by_pose=True)


def recordings(points: Points) -> npt.NDArray[np.str_]:
    """The recording of every pose, (m,): setup, payload and directions of approach."""
    return np.array(
        [
            f"{setup}|{payload:g}|{''.join(f'{int(last):+d}' for last in direction)}"
            for setup, payload, direction in zip(points.setup, points.payload_kg, points.direction, strict=True)
        ]
    )


def in_turn(points: Points) -> npt.NDArray[np.intp]:
    """The rows as the poses were taken, (m,); where no time tells it, by what was measured: never by how a file has them."""
    time = np.nan_to_num(points.t_s, nan=np.inf)
    values = np.nan_to_num(np.column_stack((points.q_rad, points.tip_m, points.direction, points.payload_kg)))
    return np.lexsort((*values.T[::-1], time))
