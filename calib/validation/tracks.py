"""Planned and measured paths, and their errors: SpringerPlus 5:1771, Figs. 6, 7, 10, Table 6."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array, frozen, norms
from calib.errors import CalibrationError
from calib.validation.verify import Comparison, compare

# Errors of neighbouring camera frames are correlated: they are not independent measurements. A path counts as this
# many measurements, each the mean of one part.
PARTS = 12


@dataclass(frozen=True, slots=True)
class Track:
    """One run along a path: time_s (k,), planned_m and measured_m (k, 3) of the tip, base frame; NaN where not measured."""

    name: str
    time_s: Array
    planned_m: Array
    measured_m: Array

    def seen(self) -> Track:
        """The samples with a measured tip; CalibrationError if there are none."""
        rows = np.flatnonzero(np.isfinite(self.measured_m).all(axis=1))
        if not len(rows):
            raise CalibrationError(f"track {self.name}: the tip was never measured; omit it from the report")
        return self.chosen(rows)

    def chosen(self, rows: npt.NDArray[np.intp] | slice) -> Track:
        """The samples of these rows."""
        return Track(
            self.name,
            frozen(self.time_s[rows]),
            frozen(self.planned_m[rows]),
            frozen(self.measured_m[rows]),
        )


@dataclass(frozen=True, slots=True)
class TrackPair:
    """The same path by the nominal and by the calibrated model, above one setup of the board."""

    name: str
    setup: str
    before: Track
    after: Track


def compare_tracks(pairs: Sequence[TrackPair]) -> Comparison | None:
    """Errors along paths, the parts of a path as points; None without paths."""
    if not pairs:
        return None
    setup, point, tips, before, after = [], [], [], [], []
    for pair in pairs:
        planned_m, first = parts_of(pair.before)
        _, second = parts_of(pair.after)
        for part in np.flatnonzero(np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])):
            setup.append(pair.setup)
            point.append(f"{pair.name}, part {part + 1} of {PARTS}")
            tips.append(planned_m[part])
            before.append(first[part])
            after.append(second[part])
    return compare(setup, point, np.array(tips), np.array(before), np.array(after))


def parts_of(track: Track) -> tuple[Array, Array]:
    """Mean planned tip and mean error vector of each part of the path, (PARTS, 3); NaN where not measured."""
    seen = track.seen()
    steps = norms(np.diff(track.planned_m, axis=0))
    way = np.concatenate(([0.0], np.cumsum(steps)))
    rows = np.isfinite(track.measured_m).all(axis=1)
    share = way[rows] / max(float(way[-1]), 1e-12)
    part = np.minimum((share * PARTS).astype(int), PARTS - 1)
    planned, error = (np.full((PARTS, 3), np.nan) for _ in range(2))
    for k in np.unique(part):
        inside = part == k
        planned[k] = seen.planned_m[inside].mean(axis=0)
        error[k] = (seen.measured_m - seen.planned_m)[inside].mean(axis=0)
    return planned, error
