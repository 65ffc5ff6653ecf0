"""Which runs decide and which only report; repeats stay together, and no sample of a run goes elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calib.arrays import Array
from calib.gap.residuals.rows import RowTable
from calib.gap.signals.recording import EvenRun, RunSet

Picked = npt.NDArray[np.bool_]
MANY = 12  # groups of one load: more than one of them reports
ONE_WAY = 0.7  # of a joint's travel: a run that ends so far from its begin went one way
REPORT_SHARE = 0.34  # of the groups at most
WHOLE = 2.0 / 3.0  # of a run that is the only one, which decides
PIECES = 4  # of its time, of what decides: fewer are no cross-validation, more hold too little motion each


@dataclass(frozen=True, slots=True)
class RowSplit:
    """Rows that decide, in groups that are held out in turn; rows that report; the runs' names of the latter."""

    groups: tuple[Picked, ...]
    deciding: Picked
    reporting: Picked
    report_runs: tuple[str, ...]

    def only(self, rows: Picked) -> RowSplit:
        """The same without other rows."""
        groups = tuple(group & rows for group in self.groups)
        return RowSplit(groups, self.deciding & rows, self.reporting & rows, self.report_runs)


def split(recording: RunSet, table: RowTable) -> RowSplit:
    """Report on a group of repeats of middling speed and on one run of each load and way that others have too.

    So each load and each way of runs that go one way are among what decides, and among what reports. Of one run its last third
    reports; what decides without repeating anything is held out in pieces of its time.
    """
    if len(recording.runs) == 1:
        report, reporting = [0], _gone(recording, table) >= WHOLE
    else:
        report = _report_groups(recording, {int(k) for k in np.unique(table.run)})
        reporting = np.isin(table.run, [run for k in report for run in recording.repeats[k]])
    names = tuple(recording.runs[run].name for k in report for run in recording.repeats[k])
    groups = [np.isin(table.run, group) for k, group in enumerate(recording.repeats) if k not in report]
    if len(groups) < 2:
        gone = _gone(recording, table)
        piece = np.minimum(PIECES * gone / gone[~reporting].max(), PIECES - 1).astype(int)
        groups = [~reporting & (piece == k) for k in range(PIECES)]
    return RowSplit(tuple(groups), ~reporting, np.asarray(reporting), names)


def _gone(recording: RunSet, table: RowTable) -> Array:
    """Share of its run's time that is over at each row."""
    length_s = np.array([max(run.t_s[-1] - run.t_s[0], 1e-9) for run in recording.runs])
    return np.asarray(table.t_s / length_s[table.run])


def _report_groups(recording: RunSet, with_rows: set[int]) -> list[int]:
    """Places in `recording.repeats`, of groups whose runs have rows that count."""
    speeds = [float(np.mean([np.sqrt(np.mean(recording.runs[r].speed ** 2)) for r in group])) for group in recording.repeats]
    kinds = [_kind(recording.runs[group[0]]) for group in recording.repeats]
    most = max(1, int(REPORT_SHARE * len(speeds)))
    chosen: list[int] = []
    for kind in sorted(set(kinds), key=lambda kind: (-kinds.count(kind), kind)):
        groups = [k for k, value in enumerate(kinds) if value == kind and with_rows & {*recording.repeats[k]}]
        if len(groups) < 2 or len(chosen) >= most:
            continue
        groups.sort(key=lambda k: (speeds[k], recording.runs[recording.repeats[k][0]].name))
        if len(groups) >= MANY:  # every fourth, from slow to fast
            chosen += groups[1::4]
            continue
        middle = groups[len(groups) // 2]
        repeated = [k for k in groups[1:-1] if len(recording.repeats[k]) > 1]
        near = min(repeated, key=lambda k: abs(speeds[k] - speeds[middle])) if repeated else middle
        chosen.append(near)
    return chosen or [k for k in range(len(speeds)) if with_rows & {*recording.repeats[k]}][-1:]


def _kind(run: EvenRun) -> tuple[float, ...]:
    """Load, and the way of each joint that ends far from where it began, -1 or 1; 0 where it comes back."""
    gone, travel = run.q[-1] - run.q[0], np.ptp(run.q, axis=0)
    way = np.sign(gone) * (np.abs(gone) > ONE_WAY * np.maximum(travel, 1e-9))
    return round(float(np.median(run.payload_kg)), 4), *(way + 0.0).tolist()
