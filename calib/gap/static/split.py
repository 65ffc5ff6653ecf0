"""Which poses are fitted, which choose between explanations, and which only report: by recording, never by pose.

A recording is what was taken in one go: one setup, one payload, one approach. Poses of one recording share more than their
model, so a recording is never divided.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Mask
from calib.points.points import Points

RECORDINGS_LEAST = 4  # fewer cannot be divided in three


@dataclass(frozen=True, slots=True)
class Split:
    """Masks (m,) of the poses that fit, choose and report; `is_divided` is False where all do everything."""

    fit: Mask
    choose: Mask
    report: Mask
    is_divided: bool
    recordings_count: int

    def without(self, out: Mask) -> Split:
        """The same, some poses (m,) left out of everything."""
        return dataclasses.replace(
            self, fit=self.fit & ~out, choose=self.choose & ~out, report=self.report & ~out
        )

    @property
    def known(self) -> Mask:
        """All that may be looked at before the report: fit and choose."""
        return self.fit | self.choose


def split(points: Points) -> Split:
    """Of each setup's recordings one reports and one chooses, as far as it has two to spare."""
    labels = recordings(points)
    names = list(dict.fromkeys(labels.tolist()))
    if len(names) < RECORDINGS_LEAST:
        everything = np.ones(len(points), dtype=bool)
        return Split(everything, everything, everything, False, len(names))
    role = np.zeros(len(points), dtype=int)
    for setup in dict.fromkeys(points.setup):
        own = [name for name in names if name.split("|")[0] == setup]
        for name, number in zip(own[::-1][: max(0, len(own) - 1)], (2, 1), strict=False):
            role[labels == name] = number
    if not (role == 2).any():  # every setup is one recording
        role[labels == names[-1]] = 2
    return Split(role == 0, role == 1, role == 2, True, len(names))


def recordings(points: Points) -> npt.NDArray[np.str_]:
    """The recording of every pose, (m,): setup, payload and directions of approach."""
    return np.array(
        [
            f"{setup}|{payload:g}|{''.join(f'{int(last):+d}' for last in direction)}"
            for setup, payload, direction in zip(
                points.setup, points.payload_kg, points.direction, strict=True
            )
        ]
    )
